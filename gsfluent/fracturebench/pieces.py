"""Pieces of a broken body, from positions alone: neighbour pairs, which of them parted, components.

Nothing here asks a method how it models damage: two neighbours at rest that are more than
``STRETCH`` times as far apart as they were have parted, and a piece is what hangs together by
the pairs that are left. NumPy only.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .scene import Floats, SceneError

REACH = 1.5
"""Points closer than this many spacings at rest are neighbours (edges and face diagonals of a
cubic lattice, not its space diagonals)."""
STRETCH = 1.5
Index = NDArray[np.int64]
# half of the 27 cells about a cell: every pair of cells is met once
_HALF = [(0, 0, 0)] + [
    (i, j, k) for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1) if (i, j, k) > (0, 0, 0)
]


def neighbours(x: Floats, distance: float) -> Index:
    """All pairs of points closer than a distance.

    Args:
        x: Positions [m], [N, 3].
        distance: Largest distance [m].

    Returns:
        Rows of the two, int64 [P, 2], the smaller first, sorted.

    Raises:
        SceneError: The distance is not a positive number.
    """
    if not 0.0 < distance < np.inf:
        raise SceneError(f"neighbours: the distance must be positive, got {distance}")
    cell = np.floor((x - x.min(axis=0)) / distance).astype(np.int64) + 1
    size = cell.max(axis=0) + 2
    key = (cell[:, 0] * size[1] + cell[:, 1]) * size[2] + cell[:, 2]
    order = np.argsort(key, kind="stable")
    sorted_key = key[order]
    found = []
    for i, j, k in _HALF:
        other = key + (i * size[1] + j) * size[2] + k
        first = np.searchsorted(sorted_key, other, side="left")
        count = np.searchsorted(sorted_key, other, side="right") - first
        a = np.repeat(np.arange(x.shape[0]), count)
        step = np.arange(a.shape[0]) - np.repeat(np.cumsum(count) - count, count)
        b = order[np.repeat(first, count) + step]
        near = ((x[a] - x[b]) ** 2).sum(axis=1) < distance * distance
        if (i, j, k) == (0, 0, 0):
            near &= a < b
        found.append(np.stack([np.minimum(a, b), np.maximum(a, b)], axis=1)[near])
    pairs = np.concatenate(found)
    return pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]


def parted(rest: Floats, x: Floats, pairs: Index, stretch: float = STRETCH) -> NDArray[np.bool_]:
    """Which pairs are more than ``stretch`` times as far apart as at rest, bool [P].

    A pair with a point that is not finite has parted.
    """
    a, b = pairs[:, 0], pairs[:, 1]
    before = np.linalg.norm(rest[a] - rest[b], axis=1)
    now = np.linalg.norm(x[a] - x[b], axis=1)
    return ~(now <= stretch * before)


def components(count: int, pairs: Index) -> Index:
    """Connected components: the smallest row of the piece of every point, int64 [count]."""
    label = np.arange(count)
    a, b = pairs[:, 0], pairs[:, 1]
    while True:
        low = np.minimum(label[a], label[b])
        new = label.copy()
        # the roots of both ends learn of the smaller root
        np.minimum.at(new, label[a], low)
        np.minimum.at(new, label[b], low)
        while True:
            further = new[new]
            if np.array_equal(further, new):
                break
            new = further
        if np.array_equal(new, label):
            return label
        label = new


def piece_masses(mass: Floats, pairs: Index) -> Floats:
    """Masses of the pieces that pairs hold together, rising, as shares of the whole, [F]."""
    label = components(mass.shape[0], pairs)
    sums = np.bincount(label, weights=mass, minlength=mass.shape[0])
    return np.sort(sums[np.unique(label)]) / mass.sum()
