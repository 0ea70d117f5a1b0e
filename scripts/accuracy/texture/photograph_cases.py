"""The classes of photographs.py: the pictures, how they are divided, and the solids."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2  # noqa: TID253
import numpy as np
from scipy import ndimage  # noqa: TID253

from gsfluent.pipeline.texture.photo.exemplar import Exemplar, PhotoOptions, load_exemplar
from gsfluent.pipeline.texture.volume.domain import SHELL, InteriorDomain

ROOT = Path(__file__).resolve().parents[3]
Photographs = tuple[Exemplar, list[Exemplar], np.ndarray]
"""Exemplar, held-out ones, and the exemplar's picture as it came."""


def data_folder() -> Path:
    return Path(os.environ.get("GSFLUENT_DATA", ROOT.parent / "shared" / "data"))


@dataclass(frozen=True)
class Case:
    """A class of real interiors.

    Attributes:
        name: Of the class.
        read: Photographs from the exemplar folder.
        shape: Implicit function of points [..., 3] in -1..1, negative inside.
        skin: Colour of the surface, or None for the photographed material itself.
        judged: Axes across which cuts are compared with the photographs.
        cut: Of the texture (structure follows the axis), or None.
        settings: Keyword arguments of the exemplar method that a user would choose.
    """

    name: str
    read: Callable[[Path], Photographs]
    shape: Callable[[np.ndarray], np.ndarray]
    skin: tuple[float, float, float] | None
    judged: tuple[int, ...] = (0, 1, 2)
    cut: str | None = None
    settings: dict[str, Any] = field(default_factory=dict)

    def photographs(self, folder: Path) -> Photographs:
        return self.read(folder / "exemplars")

    def solid(self, size: int, photo: Exemplar) -> InteriorDomain:
        """The solid with its surface colours."""
        axis = (np.arange(size) + 0.5) / size * 2 - 1
        points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1) * size / (size - 4)
        inside = self.shape(points) < 0
        distance = ndimage.distance_transform_edt(inside)
        depth = np.where(inside, distance - 0.5, 0.0).astype(np.float32)
        shell = inside & (depth <= SHELL)
        if self.skin is not None:
            color = np.broadcast_to(np.array(self.skin, np.float32), (*inside.shape, 3)).copy()
        else:
            color = _wrapped(points, photo)
        nearest = ndimage.distance_transform_edt(
            ~shell, return_distances=False, return_indices=True
        )
        skin = color[tuple(nearest)]
        up = np.array([0.0, 0.0, 1.0])
        return InteriorDomain(inside, depth, shell, skin, up, 1.0 / size, np.zeros(3))


def _wrapped(points: np.ndarray, photo: Exemplar) -> np.ndarray:
    """The photographed material on the surface, projected along the nearest axis."""
    height, width = photo.mask.shape
    pixels = cv2.resize(photo.image, (96, round(96 * height / width)), interpolation=cv2.INTER_AREA)
    side = np.abs(points).argmax(-1)
    color = np.zeros((*points.shape[:3], 3), np.float32)
    for axis in range(3):
        u, v = (i for i in range(3) if i != axis)
        rows = np.clip(((points[..., v] + 1) / 2 * pixels.shape[0]).astype(int), 0, None)
        columns = np.clip(((points[..., u] + 1) / 2 * pixels.shape[1]).astype(int), 0, None)
        rows, columns = np.minimum(rows, len(pixels) - 1), np.minimum(columns, 95)
        color[side == axis] = pixels[rows, columns][side == axis]
    return color


def _ball(points: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points / [0.97, 0.97, 0.9], axis=-1) - 1


def _apple(points: np.ndarray) -> np.ndarray:
    x, y, z = np.moveaxis(points / [0.96, 0.96, 0.86], -1, 0)
    flat = np.hypot(x, y)
    top = 0.42 * np.exp(-((flat / 0.30) ** 2))
    bottom = 0.18 * np.exp(-((flat / 0.22) ** 2))
    return np.sqrt(flat**2 + z**2) - 1 + np.where(z > 0, top, bottom)


def _block(points: np.ndarray) -> np.ndarray:
    return np.abs(points / [0.95, 0.8, 0.75]).max(-1) - 1


def _log(points: np.ndarray) -> np.ndarray:
    return (
        np.maximum(np.linalg.norm(points[..., :2], axis=-1) / 0.92, np.abs(points[..., 2]) / 0.97)
        - 1
    )


def _raw(path: Path) -> np.ndarray:
    picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
    return np.asarray(picture[..., ::-1].astype(np.float32) / 255.0)


_APPLES = ("09", "03", "04", "01", "06", "12", "13", "15")
"""Cross-sections: the one that goes in, then those held out."""


def _apples(**options: Any) -> Callable[[Path], Photographs]:
    def read(folder: Path) -> Photographs:
        where = folder / "apple_cross_sections"
        first, *others = (where / f"apple_cs_{n}.png" for n in _APPLES)
        chosen = PhotoOptions(**options)
        held = [load_exemplar(path, options=chosen) for path in others]
        return load_exemplar(first, options=chosen), held, _raw(first)

    return read


def _halves(name: str) -> Callable[[Path], Photographs]:
    """Left half of a picture of material in, right half held out."""

    def read(folder: Path) -> Photographs:
        whole = _raw(folder / name)
        middle = whole.shape[1] // 2
        left, right = (np.ascontiguousarray(h) for h in (whole[:, :middle], whole[:, middle:]))
        options = PhotoOptions("none")
        return load_exemplar(left, options=options), [load_exemplar(right, options=options)], left

    return read


def _disc(
    picture: np.ndarray, center: np.ndarray, right: np.ndarray, up: np.ndarray, both: bool
) -> Exemplar:
    """A whole round cut from a half or a quarter of one, mirrored.

    Args:
        picture: Photograph.
        center: Row and column of the middle.
        right: Way from there to the outline that is mirrored left and right.
        up: The same, up and down when ``both``.
        both: Mirror across both.
    """
    size = 2 * round(float(np.linalg.norm(right)))
    v, u = (np.mgrid[:size, :size] + 0.5) / size * 2 - 1
    u, v = np.abs(u), np.abs(v) if both else -v
    place = center[:, None, None] + right[:, None, None] * u + up[:, None, None] * v
    image = np.stack(
        [
            ndimage.map_coordinates(picture[..., c], place, order=1, mode="nearest")
            for c in range(3)
        ],
        -1,
    )
    # pictures of one light and no ground: what is left to do is the glints
    options = PhotoOptions("auto", False, False, True, False, "none")
    return load_exemplar(image.clip(0, 1), np.hypot(u, v) < 1.0, options)


def _pine(folder: Path) -> Photographs:
    path = folder / "pine_trunk" / "F02c_segmented.jpg"
    whole = load_exemplar(path)
    rows, columns = np.nonzero(whole.mask)
    center = np.array([rows.mean(), columns.mean()])
    radius = 0.93 * float(np.sqrt(whole.mask.sum() / np.pi))  # without the ragged bark
    up = np.array([-radius, 0.0])
    halves = [_disc(whole.image, center, np.array([0.0, s * radius]), up, False) for s in (-1, 1)]
    return halves[0], [halves[1]], _raw(path)


def _kiwi(folder: Path) -> Photographs:
    """The quarter above the middle of the kiwi in, the quarter below held out."""
    fruits = _raw(folder / "citrus_kiwi_opencv" / "fruits.jpg")
    center, right = np.array([382.0, 10.0]), np.array([0.0, 100.0])
    quarters = [_disc(fruits, center, right, np.array([s * 98.0, 0.0]), True) for s in (-1, 1)]
    return quarters[0], [quarters[1]], fruits[270:480, :130]


def _orange(folder: Path) -> Photographs:
    """The quarter above the middle of the orange in, flesh below it held out."""
    fruits = _raw(folder / "citrus_kiwi_opencv" / "fruits.jpg")
    center, left = np.array([258.0, 262.0]), np.array([8.0, -186.0])
    photo = _disc(fruits, center, left, np.array([-214.0, -12.0]), True)
    held = fruits[318:430, 185:320]
    options = PhotoOptions("none", shading=False)
    return photo, [load_exemplar(held, options=options)], fruits[40:480, 70:350]


def _cake(folder: Path) -> Photographs:
    """Two cut faces of the slice, each made upright from its four corners."""
    corners = {
        "149": [(274, 132), (410, 214), (390, 308), (286, 224)],
        "112": [(297, 156), (484, 111), (453, 203), (297, 253)],
    }
    size = (200, 120)
    target = np.array([(0, 0), (size[0], 0), size, (0, size[1])], np.float32)
    faces = []
    for frame, quad in corners.items():
        picture = _raw(folder / "cake_co3d" / f"frame000{frame}.jpg")
        turn = cv2.getPerspectiveTransform(np.array(quad, np.float32), target)
        face = cv2.warpPerspective(picture, turn, size, flags=cv2.INTER_AREA)
        full = np.ones(face.shape[:2], bool)
        faces.append(load_exemplar(face.clip(0, 1), full, PhotoOptions(rim=False, holes=False)))
    raw = _raw(folder / "cake_co3d" / "frame000149.jpg")[70:320, 260:480]
    return faces[0], faces[1:], raw


_MATERIAL = {"guide": "none"}
CASES = {
    c.name: c
    for c in (
        Case("apple", _apples(), _apple, (0.70, 0.12, 0.10), (2,), "across", {"guide": "depth"}),
        Case(
            "apple, stain removed",
            _apples(stain=True),
            _apple,
            (0.70, 0.12, 0.10),
            (2,),
            "across",
            {"guide": "depth"},
        ),
        Case("kiwi", _kiwi, _ball, (0.35, 0.25, 0.13), (2,)),
        Case("orange", _orange, _ball, (0.93, 0.50, 0.08), (2,), None, {"guide": "axis"}),
        Case(
            "pine",
            _pine,
            _log,
            (0.30, 0.22, 0.16),
            (2,),
            None,
            {"guide": "axis", "inclusions": False},
        ),
        Case(
            "bread, white",
            _halves("bread_crumb/white_control.jpg"),
            _block,
            (0.55, 0.32, 0.13),
            settings=_MATERIAL,
        ),
        Case(
            "bread, 10 % grain",
            _halves("bread_crumb/bsg10.jpg"),
            _block,
            (0.42, 0.22, 0.08),
            settings=_MATERIAL,
        ),
        Case(
            "cake",
            _cake,
            _block,
            (0.90, 0.86, 0.82),
            (0, 1),
            settings={"guide": "height", "directional": True},
        ),
        Case(
            "marble",
            _halves("marble_ambientcg/Marble006_1K_Color.jpg"),
            _block,
            None,
            settings=_MATERIAL,
        ),
    )
}
"""Classes by name."""
