"""How large a run gets in every format, and how long writing takes: docs/measured/export.md.

python scripts/bench/export_sizes.py demo_out --page docs/measured/export.md
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import torch

from gsfluent.export.write import FORMATS, ExportOptions, export
from gsfluent.figure.markdown import enter
from gsfluent.results.frames import count_frames, load_frame

CASES: list[tuple[str, str, dict[str, Any]]] = [
    ("`ply-seq --sh 3`", "ply-seq", {"sh": 3}),
    ("`ply-seq`", "ply-seq", {}),
    ("`ply-seq --compressed`", "ply-seq", {"compressed": True}),
    ("`spz`", "spz", {}),
    ("`splat`", "splat", {}),
    ("`glb`", "glb", {}),
    ("`delta`", "delta", {}),
    ("`usd`", "usd", {}),
    ("`usd --usd-parts splats`", "usd", {"usd_parts": ("splats",)}),
    ("`vtk`", "vtk", {}),
    ("`points`", "points", {}),
    ("`vti`", "vti", {}),
    ("`meshes`", "meshes", {}),
]
PICTURES: list[tuple[str, str, dict[str, Any]]] = [
    ("`mp4`", "mp4", {}),
    ("`gif --size 480x270`", "gif", {"size": (480, 270)}),
    ("`webp --size 480x270`", "webp", {"size": (480, 270)}),
]


def measure(
    run: Path, kind: str, options: dict[str, Any], device: torch.device
) -> tuple[int, float]:
    """Bytes on disk and seconds of the process's own time."""
    folder = Path(tempfile.mkdtemp(prefix="export_sizes_"))
    try:
        start = time.process_time()
        export(run, [kind], device=device, to=folder, options=ExportOptions(**options))
        seconds = time.process_time() - start
        return sum(p.stat().st_size for p in folder.rglob("*") if p.is_file()), seconds
    finally:
        shutil.rmtree(folder)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("run", type=Path, help="folder of a finished run")
    parser.add_argument("--page", type=Path, help="page whose table is to be replaced")
    parser.add_argument("--pictures", action="store_true", help="also videos, which are rendered")
    parser.add_argument("--device", default="cpu", help="where pictures are rendered")
    given = parser.parse_args()
    folder = given.run / "stages" / "simulate"
    count = count_frames(folder)
    frames = [load_frame(folder, index) for index in (0, count - 1)]
    splats = [frame.gaussians.count for frame in frames]
    # imports are not part of the work
    for kind in FORMATS.values():
        __import__(f"gsfluent.pipeline.{kind.module}")
    degree = frames[0].gaussians.sh_degree
    rows = []
    for name, kind, options in CASES + (PICTURES if given.pictures else []):
        if options.get("sh", 0) > degree:
            continue  # the same file as without
        size, seconds = measure(given.run, kind, options, torch.device(given.device))
        rows.append({"format": name, "bytes": size, "seconds": seconds})
        sys.stderr.write(json.dumps(rows[-1]) + "\n")
    plain = next(row["bytes"] for row in rows if row["format"] == "`ply-seq`")
    lines = [
        f"{count} frames, {splats[0]} to {splats[1]} splats (SH degree {degree}), "
        f"{len(frames[0].positions)} material points; one core:",
        "",
        "| format | MB | of `ply-seq` | bytes a splat and frame | s a frame |",
        "|---|---|---|---|---|",
    ]
    total = sum(load_frame(folder, index).gaussians.count for index in range(count))
    for row in rows:
        lines.append(
            f"| {row['format']} | {row['bytes'] / 1e6:.2f} | {row['bytes'] / plain:.1%} "
            f"| {row['bytes'] / total:.2f} | {row['seconds'] / count:.3f} |"
        )
    text = "\n".join(lines)
    sys.stdout.write(text + "\n")
    if given.page is not None:
        old = given.page.read_text(encoding="utf-8")
        given.page.write_text(enter(old, "export_sizes", text, "## Sizes"), encoding="utf-8")


if __name__ == "__main__":
    main()
