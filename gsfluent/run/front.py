"""Which side of a thing is its front: the one with the most to see."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_SIDES = 12
_PIXELS = 40  # of a picture along the longest side: features, not the grain of single splats
_AREA = 0.05  # what a pixel of silhouette counts, in units of one whole step of colour beside it
_BETTER = 1.15  # times more to see than from the usual side, for which a thing is turned


def front_side(points: Array, colors: Array, up: Array, usual: Array) -> tuple[Array, float]:
    """Choose the side that a film should show.

    From twelve sides around the upward axis, what is nearest is drawn small; a side counts the
    steps of colour between neighbouring pixels, and a little its area.

    Args:
        points: Points on the surface [N, 3], evenly spread.
        colors: Their RGB in 0..1, [N, 3].
        up: Upward direction, unit vector [3].
        usual: Direction from the thing to who looks at its front by custom, across ``up``, unit
            vector [3]. It is kept where no side shows clearly more.

    Returns:
        Unit vector [3] from the thing to who looks, and how many times more is seen from there than
        from the usual side.
    """
    side = np.cross(up, usual)
    turns = 2.0 * np.pi * np.arange(_SIDES) / _SIDES
    ways = [np.cos(turn) * usual + np.sin(turn) * side for turn in turns]
    seen = np.array([_seen(points, colors, up, way) for way in ways])
    best = int(seen.argmax())
    if seen[best] <= _BETTER * seen[0]:
        return usual, 1.0
    return ways[best], float(seen[best] / max(seen[0], 1e-12))


def _seen(points: Array, colors: Array, up: Array, toward: Array) -> float:
    """How much there is to see from a side."""
    flat = points @ np.stack([np.cross(up, toward), up]).T
    low = flat.min(axis=0)
    pixel = max(float((flat.max(axis=0) - low).max()) / _PIXELS, 1e-12)
    place = np.minimum(((flat - low) / pixel).astype(np.int64), _PIXELS - 1)
    order = np.argsort(points @ toward, kind="stable")  # the nearest is written last
    picture = np.full((_PIXELS, _PIXELS, 3), np.nan)
    picture[place[order, 0], place[order, 1]] = colors[order]
    steps = [np.abs(np.diff(picture, axis=axis)).sum(axis=-1) for axis in (0, 1)]
    detail = sum(float(np.nansum(step)) for step in steps)
    return detail + _AREA * float(np.isfinite(picture[..., 0]).sum())
