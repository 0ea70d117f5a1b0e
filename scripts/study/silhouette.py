"""Hair on a silhouette: train a real capture, count the Gaussians that stick out of its hull.

    python scripts/study/silhouette.py [--capture apple] [--iterations 1000] [--size 320]

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
from gsfluent.io import load_capture
from gsfluent.pipeline import Reconstruct
from gsfluent.pipeline.capture import read_views, visual_hull
from gsfluent.pipeline.reconstruct.evaluate import hair
from gsfluent.pipeline.reconstruct.masks import object_views

ROOT = Path(__file__).resolve().parents[2]
DATA = Path(os.environ.get("GSFLUENT_DATA", ROOT.parent / "shared" / "data"))
FINE = 192  # voxels along the longest side of the hull


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--capture", default="apple")
    parser.add_argument("--iterations", type=int, default=1000)
    parser.add_argument("--size", type=int, default=320, help="longer side of a photograph [px]")
    parser.add_argument("--gaussians", type=int, default=40_000, help="at most")
    parser.add_argument("--device", default="cpu")
    given = parser.parse_args()
    capture = load_capture(DATA / "captures" / given.capture)
    stage = Reconstruct(
        given.iterations, given.gaussians, image_size=given.size, device=given.device
    )
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
    sys.stdout.write(json.dumps(figures) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
