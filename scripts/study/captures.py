"""Run the real captures and a real splat through `gsfluent run` at reduced settings; write a table.

    python scripts/study/captures.py [-o captures_out] [--markdown docs/measured/captures.md]
        [--only apple ...]

Needs the data folder (GSFLUENT_DATA, or ../shared/data beside the checkout). Nothing is copied into
the repository but the figures.
"""

from __future__ import annotations

import argparse
import logging
import os
import sys
from pathlib import Path
from typing import Any

import torch

from gsfluent.config import Shot
from gsfluent.errors import GsfluentError
from gsfluent.figure.markdown import enter
from gsfluent.run.shot import run_shot

ROOT = Path(__file__).resolve().parents[2]
DATA = Path(os.environ.get("GSFLUENT_DATA", ROOT.parent / "shared" / "data"))
REDUCED = {"iterations": 1000, "max_gaussians": 40_000, "image_size": 320}
OUTPUT = {"fps": 30, "seconds": 1.2, "size": [640, 480]}
SHOTS: dict[str, dict[str, Any]] = {
    "apple": {
        "capture": "captures/apple",
        "size": 0.08,
        "reconstruct": REDUCED,
        "texture": {
            "method": "exemplar",
            "exemplar": "exemplars/apple_cross_sections/apple_cs_13.png",
            "cut": "across",
            "photo": {"stain": True},  # these apples were dipped in iodine
        },
        "objects": {"apple": {"material": "fruit.apple"}},
        "events": [{"type": "drop", "height": 1.0}],
    },
    "skull": {
        "capture": "captures/skull",
        "size": 0.2,
        "reconstruct": REDUCED,
        "texture": {"method": "procedural", "preset": "bone"},
        # as soft as a melon, so that a fall from a table breaks it within a short film
        "objects": {"skull": {"material": "fruit.watermelon"}},
        "events": [{"type": "drop", "height": 1.2}],
    },
    "playbot": {
        "splats": "splats/playbot/playbot_robot_lod1_sh3.ply",
        "size": 0.25,
        "texture": {"method": "color_copy"},
        "objects": {"robot": {"material": "chocolate"}},
        "events": [{"type": "drop", "height": 1.0}],
    },
    "plush_dog": {
        "splats": "splats/plush_dog/point_cloud_29999_clean.ply",
        "size": 0.3,
        "texture": {"method": "procedural", "preset": "stuffing"},
        "objects": {"dog": {"material": "plush"}},
        "events": [{"type": "drop", "height": 1.0}],
    },
}


def placed(values: dict[str, Any]) -> dict[str, Any]:
    """The shot with its paths below the data folder."""
    values = {"solve": {"quality": "preview"}, "output": OUTPUT} | values
    for key in ("capture", "splats"):
        if key in values:
            values[key] = str(DATA / values[key])
    texture = dict(values["texture"])
    if "exemplar" in texture:
        texture["exemplar"] = str(DATA / texture["exemplar"])
    return values | {"texture": texture}


def row(name: str, record: dict[str, Any]) -> str:
    reconstruction = record["reconstruction"] or {}
    simulation = record["simulation"]
    seconds = sum(stage["seconds"] for stage in record["stages"])
    psnr = f"{reconstruction['psnr']:.2f}" if reconstruction else "given"
    held = f"{reconstruction['held_out']} of {reconstruction['images']}" if reconstruction else "-"
    holes = record["render"]
    cells = [
        name,
        held,
        psnr,
        str(record["fill"]["interior_gaussians"]),
        str(simulation["particles"]),
        str(max(simulation["per_frame"]["fragments"])),
        f"{max(x for x in holes['hole_fraction_before'] if x is not None):.4f}",
        f"{max(filter(None, holes['hole_fraction']), default=0.0):.4f}",
        f"{seconds:.0f}",
        record["verdict"],
    ]
    return "| " + " | ".join(cells) + " |"


HEAD = (
    "| input | held out | PSNR (dB) | interior Gaussians | particles | fragments | holes before "
    "repair | after | seconds | verdict |\n" + "| --- " * 10 + "|"
)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, default=Path("captures_out"))
    parser.add_argument("--markdown", type=Path, help="page to enter the table into")
    parser.add_argument("--only", nargs="*", choices=sorted(SHOTS), default=sorted(SHOTS))
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    if not (DATA / "captures").is_dir():
        parser.error(f"no data at {DATA}; set GSFLUENT_DATA")
    rows, failed = [HEAD], 0
    for name in options.only:
        try:
            shot = Shot.from_dict(placed(SHOTS[name]))
            record = run_shot(shot, options.out / name, device=torch.device(options.device))
            rows.append(row(name, record))
        except GsfluentError as error:
            failed += 1
            sys.stderr.write(f"{name}: {error}\n")
    table = "\n".join(rows) + "\n"
    sys.stdout.write(table)
    if options.markdown:
        page = options.markdown
        old = page.read_text(encoding="utf-8") if page.exists() else ""
        page.write_text(enter(old, "captures", table.rstrip()), encoding="utf-8")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
