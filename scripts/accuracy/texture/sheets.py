"""Held-out planes of a known interior side by side: truth, another draw, methods."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gsfluent.lab.truth.interiors_judge import Judge
from gsfluent.pipeline.texture.photo.metrics import Slice

SHOWN = (0, 2, 4, 6, 8)  # one plane across each axis, two oblique ones
COLUMNS = ("default", "full", "preview", "procedural", "color_copy", "telea", "diffusion")
HEADER = 18
LARGEST = 290_000  # bytes


def draw_sheet(path: Path, judge: Judge, volumes: dict[str, np.ndarray]) -> None:
    """Write the sheet of one class.

    Args:
        path: JPEG to write.
        judge: The solid, its truth and its other draws.
        volumes: Colours [X, Y, Z, 3] by method.
    """
    from PIL import Image, ImageDraw

    other = judge.others[0]
    columns = {"truth": judge.truth, "another draw": judge.slices(other, other.rgb)}
    columns |= {
        name: judge.slices(judge.known, volumes[name]) for name in COLUMNS if name in volumes
    }
    size = judge.truth[0][1].shape[0]
    zoom = max(1, round(128 / size))
    tile = size * zoom
    sheet = Image.new("RGB", (tile * len(columns), HEADER + tile * len(SHOWN)), "white")
    pen = ImageDraw.Draw(sheet)
    for place, (name, slices) in enumerate(columns.items()):
        pen.text((place * tile + 4, 3), name.replace("_", " "), fill="black")
        for row, number in enumerate(SHOWN):
            picture = Image.fromarray(_pixels(slices[number]))
            picture = picture.resize((tile, tile), Image.Resampling.NEAREST)
            sheet.paste(picture, (place * tile, HEADER + row * tile))
    if tile > 128:
        shrink = 128 / tile
        sheet = sheet.resize((round(sheet.width * shrink), round(sheet.height * shrink)))
    path.parent.mkdir(exist_ok=True)
    for quality in (92, 85, 75, 60):
        sheet.save(path, quality=quality)
        if path.stat().st_size <= LARGEST:
            return


def _pixels(plane: Slice) -> np.ndarray:
    image, mask = plane
    shown = np.where(mask[..., None], image, 1.0)
    return (shown.clip(0.0, 1.0) * 255).round().astype(np.uint8)
