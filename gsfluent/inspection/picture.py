"""The picture of ``gsfluent inspect``: three views with box, axes and floor, and a photograph."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gsfluent.data import Frame, View

Array = NDArray[np.float64]
Project = Callable[[Array], Array]

_PANEL = 440
_MARGIN = 46
_INK = (30, 30, 34)
_FAINT = (176, 178, 186)
_PAPER = (250, 250, 248)
_BOX = (40, 110, 220)
_FLOOR = (150, 96, 40)
_FLOATER = (230, 0, 160)
_AXES = ((210, 40, 40), (30, 150, 60), (40, 80, 230))


@dataclasses.dataclass(frozen=True)
class Picture:
    """What is drawn, all in scene metres."""

    points: Array  # points [N, 3]
    colors: Array  # their colours in 0..1 [N, 3]
    radii: Array  # their radii [m], [N]
    marked: NDArray[np.bool_]  # points drawn as floaters, bool [N]
    low: Array  # lower corner of the object's box [3]
    high: Array  # upper corner [3]
    floor: float  # height of the floor
    cameras: Array  # camera positions [C, 3]; may be empty
    lines: list[str]  # text under the views
    # A photograph with the frame that the points are in, or None.
    photograph: tuple[View, Frame] | None = None


def draw(picture: Picture) -> torch.Tensor:
    """Draw the picture, float32 [H, W, 3] in 0..1."""
    from PIL import Image, ImageDraw

    text_height = 18 * len(picture.lines) + 24
    sheet = Image.new("RGB", (2 * _PANEL, 2 * _PANEL + text_height), _PAPER)
    views = (("front", (0, 2, 1)), ("side", (1, 2, 0)), ("top", (0, 1, 2)))
    for (name, axes), corner in zip(views, ((0, 0), (_PANEL, 0), (0, _PANEL)), strict=True):
        sheet.paste(_flat_view(picture, name, axes), corner)
    photograph = picture.photograph
    last = _oblique_view(picture) if photograph is None else _photo_view(picture, photograph)
    sheet.paste(last, (_PANEL, _PANEL))
    pen = ImageDraw.Draw(sheet)
    for index, line in enumerate(picture.lines):
        pen.text((14, 2 * _PANEL + 12 + 18 * index), line, fill=_INK)
    return torch.from_numpy(np.asarray(sheet, dtype=np.float32) / 255.0)


def _flat_view(picture: Picture, name: str, axes: tuple[int, int, int]) -> Any:
    """Parallel view along axis ``axes[2]`` with ``axes[0]`` to the right and ``axes[1]`` up."""
    across, up, along = axes
    middle = (picture.low + picture.high) / 2
    extent = float((picture.high - picture.low).max()) * 1.25
    scale = (_PANEL - 2 * _MARGIN) / extent

    def project(points: Array) -> Array:
        x = _PANEL / 2 + (points[:, across] - middle[across]) * scale
        y = _PANEL / 2 - (points[:, up] - middle[up]) * scale
        # The front is seen from -y and the side from +x; the top from +z.
        depth = points[:, along] * (1.0 if name == "front" else -1.0)
        return np.stack([x, y, depth], axis=1)

    image = _splat(picture, project, scale)
    pen = _pen(image)
    if up == 2:
        level = float(project(np.array([[0.0, 0.0, picture.floor]]))[0, 1])
        pen.line([(8, level), (_PANEL - 8, level)], fill=_FLOOR, width=2)
        pen.text((10, level + 3), "floor", fill=_FLOOR)
    _outline(pen, picture, project)
    _triad(pen, picture, project)
    _ruler(pen, scale)
    pen.text((12, 8), f"{name} ({'xyz'[across]} right, {'xyz'[up]} up)", fill=_INK)
    return image


def _oblique_view(picture: Picture) -> Any:
    """Parallel view from the front right, above."""
    turn, rise = np.radians(35.0), np.radians(25.0)
    right = np.array([np.cos(turn), np.sin(turn), 0.0])
    ahead = np.array([-np.sin(turn) * np.cos(rise), np.cos(turn) * np.cos(rise), -np.sin(rise)])
    upward = np.cross(right, ahead)
    middle = (picture.low + picture.high) / 2
    scale = (_PANEL - 2 * _MARGIN) / (float(np.linalg.norm(picture.high - picture.low)) * 1.1)

    def project(points: Array) -> Array:
        local = (points - middle) @ np.stack([right, upward, ahead], axis=1)
        return np.stack(
            [_PANEL / 2 + local[:, 0] * scale, _PANEL / 2 - local[:, 1] * scale, local[:, 2]],
            axis=1,
        )

    image = _splat(picture, project, scale)
    pen = _pen(image)
    _floor_square(pen, picture, project)
    _outline(pen, picture, project)
    _triad(pen, picture, project)
    pen.text((12, 8), "oblique", fill=_INK)
    return image


def _photo_view(picture: Picture, photograph: tuple[View, Frame]) -> Any:
    """The photograph with box, axes and floor projected into it."""
    from PIL import Image

    view, frame = photograph
    pixels = (view.image.numpy() * 255).astype(np.uint8)
    factor = _PANEL / max(pixels.shape[:2])
    size = (round(pixels.shape[1] * factor), round(pixels.shape[0] * factor))
    image = Image.new("RGB", (_PANEL, _PANEL), _PAPER)
    corner = np.array([(_PANEL - size[0]) / 2, (_PANEL - size[1]) / 2])
    image.paste(
        Image.fromarray(pixels).resize(size, Image.Resampling.LANCZOS), tuple(corner.astype(int))
    )
    back = frame.inverse()

    def project(points: Array) -> Array:
        place, depth = view.camera.project(back.apply(torch.from_numpy(points)))
        return np.concatenate([place.numpy() * factor + corner, depth.numpy()[:, None]], axis=1)

    pen = _pen(image)
    _floor_square(pen, picture, project)
    _outline(pen, picture, project)
    _triad(pen, picture, project)
    pen.text(
        (12, 8),
        f"photograph {view.camera.name}",
        fill=(255, 255, 255),
        stroke_width=2,
        stroke_fill=_INK,
    )
    return image


def _pen(image: Any) -> Any:
    from PIL import ImageDraw

    return ImageDraw.Draw(image)


def _splat(picture: Picture, project: Project, scale: float) -> Any:
    """Paint points as discs, far ones first."""
    from PIL import Image

    canvas = np.empty((_PANEL, _PANEL, 3), dtype=np.uint8)
    canvas[:] = _PAPER
    place = project(picture.points)
    order = np.argsort(-place[:, 2], kind="stable")
    x, y = np.floor(place[order, 0]).astype(int), np.floor(place[order, 1]).astype(int)
    colors = (picture.colors[order].clip(0, 1) * 255).astype(np.uint8)
    radius = np.clip(picture.radii[order] * scale, 1.0, 4.0)
    owner = np.full((_PANEL, _PANEL), -1, dtype=np.int64)
    for across, down in itertools.product(range(-4, 5), repeat=2):
        near = radius >= np.hypot(across, down)
        column, row = x + across, y + down
        near &= (column >= 0) & (column < _PANEL) & (row >= 0) & (row < _PANEL)
        np.maximum.at(owner, (row[near], column[near]), np.flatnonzero(near))
    covered = owner >= 0
    canvas[covered] = colors[owner[covered]]
    image = Image.fromarray(canvas)
    pen = _pen(image)
    for column, row, _ in project(picture.points[picture.marked])[:400]:
        pen.line([(column - 3, row - 3), (column + 3, row + 3)], fill=_FLOATER)
        pen.line([(column - 3, row + 3), (column + 3, row - 3)], fill=_FLOATER)
    for column, row, _ in project(picture.cameras):
        pen.rectangle([(column - 2, row - 2), (column + 2, row + 2)], outline=_INK)
    return image


def _segments(
    pen: Any, project: Project, start: Array, end: Array, color: tuple[int, int, int], width: int
) -> None:
    """Draw lines between rows of ``start`` and ``end`` that are in front of the viewer."""
    first, second = project(start), project(end)
    for a, b in zip(first, second, strict=True):
        if np.isfinite([*a, *b]).all() and max(np.abs([*a[:2], *b[:2]])) < 1e5:
            pen.line([(a[0], a[1]), (b[0], b[1])], fill=color, width=width)


def _outline(pen: Any, picture: Picture, project: Project) -> None:
    """The edges of the box."""
    corners = np.array(list(itertools.product(*zip(picture.low, picture.high, strict=True))))
    pairs = [(a, b) for a, b in itertools.combinations(range(8), 2) if bin(a ^ b).count("1") == 1]
    first, second = np.array(pairs).T
    _segments(pen, project, corners[first], corners[second], _BOX, 1)


def _floor_square(pen: Any, picture: Picture, project: Project) -> None:
    """A grid on the floor around the object."""
    middle, half = (
        (picture.low + picture.high) / 2,
        0.75 * float((picture.high - picture.low).max()),
    )
    ticks = np.linspace(-half, half, 7)
    ends = []
    for tick in ticks:
        ends.append(((tick, -half), (tick, half)))
        ends.append(((-half, tick), (half, tick)))
    flat = np.array(ends) + middle[:2]
    lifted = np.concatenate([flat, np.full((*flat.shape[:2], 1), picture.floor)], axis=2)
    _segments(pen, project, lifted[:, 0], lifted[:, 1], _FLOOR, 1)


def _triad(pen: Any, picture: Picture, project: Project) -> None:
    """The three axes from the origin of the scene."""
    length = 0.35 * float((picture.high - picture.low).max())
    origin = np.zeros((1, 3))
    for index in range(3):
        tip = np.zeros((1, 3))
        tip[0, index] = length
        _segments(pen, project, origin, tip, _AXES[index], 3)
        end = project(tip)[0]
        if np.isfinite(end).all():
            pen.text((end[0] + 4, end[1] - 6), "xyz"[index], fill=_AXES[index])


def _ruler(pen: Any, scale: float) -> None:
    """A bar of a round length in the lower right corner."""
    room = 0.3 * _PANEL / scale
    exponent = np.floor(np.log10(room))
    length = max(step for step in (1, 2, 5) if step * 10**exponent <= room) * 10**exponent
    right, level = _PANEL - 16, _PANEL - 16
    pen.line([(right - length * scale, level), (right, level)], fill=_INK, width=3)
    label = f"{length * 100:g} cm" if length < 1 else f"{length:g} m"
    pen.text((right - length * scale, level - 16), label, fill=_INK)
