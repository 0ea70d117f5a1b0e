"""Textured solids cut open three ways, one row each, in one picture.

    python scripts/pictures/cut_views.py OUT.jpg melon.ply apple.ply=0.10,-0.77,-0.64

A solid is what ``gsfluent texture`` wrote; after ``=`` what is up in its own frame (+z without).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from PIL import Image  # noqa: TID253

from gsfluent.io.solid import load_solid
from gsfluent.pipeline.render.cuts import CutBody, cut_view

TILT = 25.0  # degrees that the viewer of the last cut stands above it


def row(path: Path, up: np.ndarray, size: int) -> np.ndarray:
    """Across, from above, and aslant, [size, 3 * size, 3]."""
    solid = load_solid(path)
    body = CutBody(solid)
    across = np.cross(up, [1.0, 0.0, 0.3])
    across /= np.linalg.norm(across)
    along = np.cross(up, across)
    asked = ((across, up, 0.0), (-up, along, 0.0), (0.8 * across + 0.6 * along, up, TILT))
    tiles = []
    for normal, top, tilt in asked:
        image = cut_view(body, normal, size=size - 10, up=top, tilt=tilt)
        tile = np.ones((size, size, 3), np.float32)
        high, wide = image.shape[:2]
        y, x = (size - high) // 2, (size - wide) // 2
        tile[y : y + high, x : x + wide] = image
        tiles.append(tile)
    return np.concatenate(tiles, axis=1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, help="picture to write")
    parser.add_argument("solids", nargs="+", help="SOLID.ply or SOLID.ply=X,Y,Z (up)")
    parser.add_argument("--size", type=int, default=310, help="side of a view [px]")
    given = parser.parse_args()
    rows = []
    for each in given.solids:
        path, _, up = each.partition("=")
        top = np.array([float(v) for v in (up or "0,0,1").split(",")])
        rows.append(row(Path(path), top / np.linalg.norm(top), given.size))
    pixels = (np.concatenate(rows) * 255.0).round().astype(np.uint8)
    Image.fromarray(pixels).save(given.out, quality=88)


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
