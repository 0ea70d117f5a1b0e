"""Reconstructed captures filled, textured and cut open; one picture per object in docs/images.

    python scripts/accuracy/texture/real_cuts.py --apple apple.ply [--skull skull.ply]
        [--dog] [--resolution 112]

APPLE and SKULL are splats that ``gsfluent reconstruct`` made of the captures of that name; the dog
is the trained splat of the data folder. The apple gets the inside of a photographed apple slice,
skull and dog that of a preset. Needs the data folder (GSFLUENT_DATA, or ../shared/data).
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Any

import cv2  # noqa: TID253
import numpy as np
from photograph_cases import data_folder

import gsfluent as gf
from gsfluent.pipeline.capture.orient import make_frame
from gsfluent.pipeline.render.cuts import cut_view

IMAGES = Path(__file__).resolve().parents[3] / "docs" / "images"
VIEWS: tuple[Any, ...] = ("x", "y", "z", (0.55, 0.55, -0.63))
SLICE = "exemplars/apple_cross_sections/apple_cs_{}.png"


def solid(path: Path, capture: Path | None, resolution: int) -> gf.data.Solid:
    """The object's splats, standing upright, filled."""
    gaussians = gf.load(path)
    if gaussians.labels is not None:
        gaussians = gaussians.select(gaussians.labels == gf.data.SURFACE)
    photographs = None if capture is None else gf.load_capture(capture)
    upright = gaussians.transformed(make_frame(gaussians, photographs))
    filled: gf.data.Solid = gf.pipeline.Fill(resolution=resolution, down=(0.0, 0.0, -1.0))(upright)
    return filled


def strip(textured: gf.data.Solid, size: int = 330) -> np.ndarray:
    """Cut views side by side on white."""
    tiles = []
    for view in VIEWS:
        image = cut_view(textured, view, size=size - 10)
        tile = np.ones((size, size, 3), np.float32)
        top, left = (size - image.shape[0]) // 2, (size - image.shape[1]) // 2
        tile[top : top + image.shape[0], left : left + image.shape[1]] = image
        tiles.append(tile)
    return np.concatenate(tiles, 1)


def show(name: str, shell: gf.data.Solid, **settings: Any) -> None:
    began = time.process_time()
    textured = gf.pipeline.Texture(**settings)(shell)
    keys = ("method", "guide", "cut", "swept", "core", "skin_mended", "exemplar_mask")
    figures = {k: textured.report[k] for k in keys if k in textured.report}
    sys.stdout.write(f"{name}: {time.process_time() - began:.1f} CPU s {figures}\n")
    pixels = (strip(textured)[..., ::-1] * 255).round().astype(np.uint8)
    cv2.imwrite(str(IMAGES / f"real_{name}.jpg"), pixels, [cv2.IMWRITE_JPEG_QUALITY, 85])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--apple", type=Path, help="reconstructed splats of captures/apple")
    parser.add_argument("--slice", default="13", help="number of the apple's cross-section (13)")
    parser.add_argument("--skull", type=Path, help="reconstructed splats of captures/skull")
    parser.add_argument("--dog", action="store_true", help="the plush dog of the data folder")
    parser.add_argument("--resolution", type=int, default=112, help="voxels (112)")
    options = parser.parse_args()
    data = data_folder()
    if not (data / "exemplars").is_dir():
        sys.exit(f"no data at {data}; set GSFLUENT_DATA to the data folder")
    if options.apple:
        shell = solid(options.apple, data / "captures" / "apple", options.resolution)
        photo = {"exemplar": data / SLICE.format(options.slice), "photo": {"stain": True}}
        show("apple", shell, method="exemplar", cut="across", **photo)
    if options.skull:
        shell = solid(options.skull, data / "captures" / "skull", options.resolution)
        show("skull", shell, method="procedural", preset="bone")
    if options.dog:
        path = data / "splats" / "plush_dog" / "point_cloud_29999_clean.ply"
        show("plush_dog", solid(path, None, options.resolution), preset="stuffing")


if __name__ == "__main__":
    main()
