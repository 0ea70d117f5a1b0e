"""Hair on a silhouette: train a real capture, count the Gaussians that stick out of its hull.

    python scripts/study/silhouette.py [--capture apple] [--iterations 1000] [--size 320]
                                       [--sh-degree 2]

Every run is a line of docs/measured/data/silhouette.jsonl and a row of docs/measured/silhouette.md.
The hull is carved anew from the silhouettes of the result in all photographs, those held out as
well, twice as fine as that of the training. Needs the data folder (GSFLUENT_DATA, or ../shared/data
beside the checkout).
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path

import torch

from gsfluent.data import BACKGROUND, SURFACE
from gsfluent.figure.markdown import enter
from gsfluent.io import load_capture
from gsfluent.io.atomic import atomic_path
from gsfluent.pipeline import Reconstruct
from gsfluent.pipeline.capture import read_views, visual_hull
from gsfluent.pipeline.reconstruct.evaluate import hair
from gsfluent.pipeline.reconstruct.masks import object_views

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "measured" / "silhouette.md"
LINES = PAGE.parent / "data" / "silhouette.jsonl"
HEAD = ("capture", "steps", "pixels", "sh_degree", "psnr", "psnr_inside", "object_gaussians",
        "sticking_out", "needles", "slivers")  # fmt: skip
DATA = Path(os.environ.get("GSFLUENT_DATA", ROOT.parent / "shared" / "data"))
FINE = 192  # voxels along the longest side of the hull


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--capture", default="apple")
    parser.add_argument("--iterations", type=int, default=1000)
    parser.add_argument("--size", type=int, default=320, help="longer side of a photograph [px]")
    parser.add_argument("--gaussians", type=int, default=40_000, help="at most")
    parser.add_argument("--sh-degree", type=int, default=0, help="of view-dependent colours")
    parser.add_argument("--device", default="cpu")
    given = parser.parse_args()
    capture = load_capture(DATA / "captures" / given.capture)
    stage = Reconstruct(
        given.iterations, given.gaussians, image_size=given.size, sh_degree=given.sh_degree,
        device=given.device,
    )  # fmt: skip
    result = stage(capture)
    views = read_views(capture, given.size, torch.device(given.device), crop=True)
    if result.labels is None:
        parser.error(f"{given.capture}: the object was not told from its background")
    found = result.select(result.labels == SURFACE)
    if views[0].mask is None:
        rest = result.select(result.labels == BACKGROUND)
        views, _ = object_views(views, found, rest)
    figures = {name: result.report[name] for name in ("psnr", "psnr_inside", "object_gaussians")}
    figures |= hair(found, visual_hull(views, FINE))
    key = {"capture": given.capture, "steps": given.iterations, "pixels": given.size,
           "sh_degree": given.sh_degree}  # fmt: skip
    rows = [json.loads(line) for line in LINES.read_text().splitlines()] if LINES.exists() else []
    rows = [row for row in rows if any(row[name] != key[name] for name in key)]
    rows.append(key | figures)
    with atomic_path(LINES) as part:
        part.write_text("".join(json.dumps(row) + "\n" for row in rows))
    table = ["| " + " | ".join(HEAD) + " |", "|" + " --- |" * len(HEAD)]
    table += ["| " + " | ".join(f"{row[name]:.5g}" if isinstance(row[name], float) else
              str(row[name]) for name in HEAD) + " |" for row in rows]  # fmt: skip
    text = enter(PAGE.read_text(encoding="utf-8"), "silhouette", "\n".join(table))
    with atomic_path(PAGE) as part:
        part.write_text(text, encoding="utf-8")
    sys.stdout.write(json.dumps(figures) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
