"""Which side of a thing is its front: where it is alike left and right, and most is to see."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from gsfluent.data import Camera, Gaussians

Array = NDArray[np.float64]

_VIEWED, _FEW = 20_000, 200  # splats that are looked at, and fewest that tell
_SOLID = 0.3  # opacity from which a splat counts
_AROUND = 0.3  # mean of the directions to the photographers below which they stood all around

_SIDES = 24
_PIXELS = 40  # of a picture along the longest side: features, not the grain of single splats
_AREA = 0.05  # what a pixel of silhouette counts, in units of one whole step of colour beside it
_RELIEF = 0.05  # what a bend of a pixel in depth counts, likewise; a jump in depth is one pixel
_BETTER = 1.15  # times more to see than from the usual side, for which a thing is turned
_ALIKE = 0.75  # of the median asymmetry: a plane below it is one of mirror symmetry
_END = 2 / 3  # of the largest width: what is narrower is seen end on
_COLOR = 0.3  # what a step of colour counts, in diagonals of the thing
_FAR = 0.2  # of the diagonal: a mirrored point that misses by more than this just misses
_SAMPLE, _NEAR, _EVERY = 4000, 24, 4  # points compared, those that share a colour, and a stride
_SHIFTS = np.linspace(-0.06, 0.06, 5)  # of the mirror from the middle, in diagonals


def photographers_side(cameras: Sequence[Camera], up: Array) -> tuple[Array | None, str]:
    """The middle of where photographers stood.

    Args:
        cameras: Theirs.
        up: Upward direction, unit vector [3].

    Returns:
        Unit vector [3] from the thing to them, or None where they stood all around; and words.
    """
    ahead = np.stack([camera.forward().double().numpy() for camera in cameras])
    ahead -= (ahead @ up)[:, None] * up
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True).clip(1e-9)
    middle = -ahead.mean(axis=0)
    if (length := float(np.linalg.norm(middle))) < _AROUND:
        return None, "where the first photograph was taken, since they go all around"
    return middle / length, "the side from which most photographs were taken"


def splats_side(splats: Gaussians, up: Array, usual: Array) -> tuple[Array | None, str]:
    """The side of splats on a surface that :func:`front_side` chooses.

    Args:
        splats: Some or all of them; up to 20 000 of the solid ones are looked at.
        up: Upward direction, unit vector [3].
        usual: As of :func:`front_side`.

    Returns:
        Unit vector [3] from the thing to who looks, or None where the usual side will do; and
        words.
    """
    solid = splats.opacities > _SOLID
    if int(solid.sum()) >= _FEW:
        splats = splats.select(solid)
    splats = splats.select(torch.arange(0, splats.count, max(1, splats.count // _VIEWED)))
    if splats.count < _FEW:
        return None, "that by the custom of its axes, since there are too few points to judge"
    points = splats.means.double().numpy()
    colors = splats.colors().clamp(0.0, 1.0).double().numpy()
    way, why = front_side(points, colors, up, usual)
    if not why:
        return None, "that by the custom of its axes, since no side shows clearly more"
    return way, why


def front_side(points: Array, colors: Array, up: Array, usual: Array) -> tuple[Array, str]:
    """Choose the side that a film should show.

    Figures, animals and tools are alike left and right of a plane that holds the upward axis, and
    one looks at them along it. If the usual side lies in such a plane, its two ends are compared,
    else those of the best plane, unless the thing is seen end on there, as a teapot is from its
    spout. A thing without such a plane is compared from all sides around. That side wins which has
    the most to see: what is nearest is drawn small, and the steps of colour between neighbouring
    pixels are counted, and a little how its depth bends, and the area.

    Args:
        points: Points on the surface [N, 3], evenly spread.
        colors: Their RGB in 0..1, [N, 3].
        up: Upward direction, unit vector [3].
        usual: Direction from the thing to who looks at its front by custom, across ``up``, unit
            vector [3]. It is kept where no side shows clearly more.

    Returns:
        Unit vector [3] from the thing to who looks, and what it was chosen by, in words; these are
        empty where it is the usual side.
    """
    side = np.cross(up, usual)
    turns = 2.0 * np.pi * np.arange(_SIDES) / _SIDES
    ways = np.cos(turns)[:, None] * usual + np.sin(turns)[:, None] * side
    seen = np.array([_seen(points, colors, up, way) for way in ways])
    half = _SIDES // 2
    unlike = _asymmetry(points, colors, np.cross(up, ways[:half]))
    width = np.ptp(points @ np.cross(up, ways[:half]).T, axis=0)
    alike = (unlike < _ALIKE * np.median(unlike)) & (width >= _END * width.max())
    if alike.any() and not alike[0]:
        plane = int(np.where(alike, unlike, np.inf).argmin())
        best = plane if seen[plane] >= seen[plane + half] else plane + half
        return ways[best], "the side with the most to see of the two along its plane of symmetry"
    best = half if alike[0] else int(seen.argmax())
    more = float(seen[best] / max(seen[0], 1e-12))
    if more <= _BETTER:
        return usual, ""
    return ways[best], f"the side with the most to see ({more:.2g} times the usual front)"


def _asymmetry(points: Array, colors: Array, across: Array) -> Array:
    """How far a thing is from its mirror image [M], for unit normals of mirrors [M, 3].

    Mean distance from the image to the thing in diagonals, and of the colours there, at the best of
    five places of the mirror around the median of the points.
    """
    from scipy.spatial import cKDTree

    stride = max(1, len(points) // _SAMPLE)
    low, high = np.quantile(points, (0.01, 0.99), axis=0)
    diagonal = max(float(np.linalg.norm(high - low)), 1e-12)
    place = (points[::stride] - np.median(points, axis=0)) / diagonal
    tree = cKDTree(place)
    # single splats differ from their neighbours in colour where the thing does not
    _, near = tree.query(place, k=min(_NEAR, len(place)))
    shade = colors[::stride][near].mean(axis=1)
    found = np.full(len(across), np.inf)
    for number, normal in enumerate(across):
        for shift in _SHIFTS:
            some = place[::_EVERY]
            image = some - 2.0 * (some @ normal - shift)[:, None] * normal
            miss, at = tree.query(image)
            change = np.abs(shade[at] - shade[::_EVERY]).mean()
            found[number] = min(found[number], np.minimum(miss, _FAR).mean() + _COLOR * change)
    return found


def _seen(points: Array, colors: Array, up: Array, toward: Array) -> float:
    """How much there is to see from a side."""
    flat = points @ np.stack([np.cross(up, toward), up]).T
    low = flat.min(axis=0)
    pixel = max(float((flat.max(axis=0) - low).max()) / _PIXELS, 1e-12)
    place = np.minimum(((flat - low) / pixel).astype(np.int64), _PIXELS - 1)
    order = np.argsort(points @ toward, kind="stable")  # the nearest is written last
    picture = np.full((_PIXELS, _PIXELS, 4), np.nan)
    picture[place[order, 0], place[order, 1], :3] = colors[order]
    picture[place[order, 0], place[order, 1], 3] = (points @ toward)[order] / pixel
    detail = 0.0
    for axis in (0, 1):
        step = np.abs(np.diff(picture[..., :3], axis=axis)).sum(axis=-1)
        bend = np.abs(np.diff(picture[..., 3], 2, axis=axis))
        detail += float(np.nansum(step)) + _RELIEF * float(np.nansum(np.minimum(bend, 1.0)))
    return detail + _AREA * float(np.isfinite(picture[..., 0]).sum())
