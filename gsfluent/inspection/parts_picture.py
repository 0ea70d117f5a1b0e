"""The picture of a solid's parts: from outside and cut open, beside the true colours."""

from __future__ import annotations

import colorsys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gsfluent.data import SURFACE, Camera, Gaussians
from gsfluent.draw import draw
from gsfluent.inspection.parts import PartMap
from gsfluent.io import save_image
from gsfluent.pipeline.regions.vote import Skin, find_skin

_SIDE = 230
_GAP = 10
_PAPER = (250, 250, 248)
_INK = (30, 30, 34)
_GREY = (0.62, 0.62, 0.62)
_VIEWS = (("front", (0.35, -1.0, 0.45)), ("back", (-0.35, 1.0, 0.45)), ("below", (0.5, -0.6, -1.0)))


def part_colors(count: int) -> NDArray[np.float32]:
    """Colours that differ, the rest's grey first, float32 [count, 3]."""
    found = [_GREY]
    for index in range(count - 1):
        hue = (0.02 + 0.381966 * index) % 1.0  # the golden angle: neighbours stay far apart
        found.append(
            colorsys.hsv_to_rgb(hue, 0.80 if index % 2 else 0.62, 0.93 - 0.18 * (index % 3))
        )
    return np.array(found[:count], np.float32)


def save_parts_picture(parts: PartMap, path: str | Path, title: str = "") -> None:
    """Draw the parts (upper row) and the true colours (lower row), the table below.

    Views: outside from three sides, cuts through the middle across the scene's x, y and z.

    Raises:
        RunError: The disk is full.
    """
    from PIL import Image, ImageDraw

    palette = part_colors(len(parts.rows))
    skin = find_skin(parts.solid)
    upper = [_outside(parts, skin, palette, toward) for _, toward in _VIEWS]
    lower = [_outside(parts, skin, None, toward) for _, toward in _VIEWS]
    for axis in range(3):
        upper.append(_section(parts, axis, palette))
        lower.append(_section(parts, axis, None))
    names = [name for name, _ in _VIEWS] + [f"cut across {axis}" for axis in "xyz"]
    wide = len(upper) * (_SIDE + _GAP) + _GAP
    tall = 2 * (_SIDE + _GAP) + 40 + 18 * (len(parts.rows) + len(parts.warnings) + 1)
    sheet = Image.new("RGB", (wide, tall), _PAPER)
    pen = ImageDraw.Draw(sheet)
    pen.text((_GAP, 6), title, fill=_INK)
    for column, (name, first, second) in enumerate(zip(names, upper, lower, strict=True)):
        left = _GAP + column * (_SIDE + _GAP)
        for place, image in enumerate((first, second)):
            picture = Image.fromarray((image.clip(0, 1) * 255 + 0.5).astype(np.uint8))
            sheet.paste(picture, (left, 24 + place * (_SIDE + _GAP)))
        pen.text((left + 4, 26), name, fill=_INK)
    top = 2 * (_SIDE + _GAP) + 30
    columns = (30, 250, 640, 750, 850, 960, 1090)
    head = ("part", "material", "volume", "share", "particles", "mean depth", "agreement")
    for place, word in zip(columns, head, strict=True):
        pen.text((place, top), word, fill=_INK)
    for number, row in enumerate(parts.rows):
        level = top + 18 * (number + 1)
        swatch = tuple(int(255 * part) for part in palette[number])
        pen.rectangle([(_GAP, level + 1), (_GAP + 12, level + 12)], fill=swatch)
        for place, word in zip(columns, _cells(row), strict=True):
            pen.text((place, level), word, fill=_INK)
    for number, warning in enumerate(parts.warnings, len(parts.rows) + 1):
        pen.text((_GAP, top + 18 * number), f"! {warning}", fill=(190, 30, 30))
    save_image(torch.from_numpy(np.asarray(sheet, dtype=np.float32) / 255.0), path)


def _cells(row: dict[str, Any]) -> tuple[str, ...]:
    """One line of the table as text."""

    def shown(value: float | None, form: str) -> str:
        return "-" if value is None else form.format(value)

    mean = row["mean_depth"]
    return (
        str(row["part"])[:34],
        str(row["material"])[:62],
        shown(row["volume"] * 1e6, "{:.4g} cm3"),
        shown(row["share"] * 100, "{:.1f} %"),
        shown(row["particles"], "{:d}"),
        shown(None if mean is None else mean * 1000, "{:.1f} mm"),
        shown(None if row["agreement"] is None else row["agreement"] * 100, "{:.0f} % of votes"),
    )


def _outside(
    parts: PartMap, skin: Skin, palette: NDArray[np.float32] | None, toward: tuple[float, ...]
) -> NDArray[np.float32]:
    """The solid from outside: skin voxels in part colours, or its surface splats."""
    frame, solid = parts.frame, parts.solid
    placed = frame.apply(torch.from_numpy(skin.centers).double())
    low, high = placed.amin(dim=0), placed.amax(dim=0)
    middle, reach = 0.5 * (low + high), 0.5 * float((high - low).norm())
    direction = torch.tensor(toward, dtype=torch.float64)
    eye = middle + direction / direction.norm() * 0.85 * reach / np.sin(np.radians(15.0))
    camera = Camera.look_at(eye, middle, width=_SIDE, height=_SIDE, fov=30.0)
    camera = camera.transformed(frame.inverse())
    if palette is None:
        chosen = solid.gaussians
        if chosen.labels is not None and bool((chosen.labels == SURFACE).any()):
            chosen = chosen.select(chosen.labels == SURFACE)
        drawn = draw(chosen, camera)
    else:
        light = frame.inverse().apply_vector(torch.tensor([[0.4, -0.5, 0.8]]).double())[0]
        facing = skin.normals @ (light / light.norm()).numpy()
        shade = 0.72 + 0.28 * facing[:, None]
        row = parts.label[tuple(skin.index.T)].clip(min=0)
        colors = np.zeros((skin.splats.count, 3), np.float32)
        colors[: len(skin)] = palette[row] * shade
        first = Gaussians.select(skin.splats, torch.arange(skin.splats.count) < len(skin))
        drawn = draw(first, camera, colors=torch.from_numpy(colors[: len(skin)]).to(first.means))
    paper = torch.tensor(_PAPER, dtype=torch.float32) / 255.0
    image = drawn.image.float().cpu() + (1 - drawn.alpha.float().cpu())[..., None] * paper
    result: NDArray[np.float32] = image.numpy()
    return result


def _section(parts: PartMap, axis: int, palette: NDArray[np.float32] | None) -> NDArray[np.float32]:
    """The cut face through the middle, across an axis of the scene; sharp between parts."""
    solid, frame = parts.solid, parts.frame
    placed = frame.apply(solid.voxel_centers().double().cpu())
    low, high = placed.amin(dim=0), placed.amax(dim=0)
    middle, reach = 0.5 * (low + high), 0.56 * float((high - low).max())
    across, up = [k for k in range(3) if k != axis]
    line = (torch.arange(_SIDE, dtype=torch.float64) + 0.5) / _SIDE * 2 - 1
    points = middle.repeat(_SIDE * _SIDE, 1)
    points[:, across] += (reach * line).repeat(_SIDE)
    points[:, up] -= (reach * line).repeat_interleave(_SIDE)
    index, inside = solid.voxel_index(frame.inverse().apply(points).to(solid.origin))
    place = tuple(index.cpu().numpy().T)
    row = np.where(inside.cpu().numpy(), parts.label[place], -1)
    image = np.full((_SIDE * _SIDE, 3), np.array(_PAPER) / 255.0, np.float32)
    matter = row >= 0
    if palette is not None:
        image[matter] = palette[row[matter]]
    elif solid.color is None:
        image[matter] = 0.55
    else:
        image[matter] = solid.color.float().cpu().numpy()[place][matter]
    return image.reshape(_SIDE, _SIDE, 3)
