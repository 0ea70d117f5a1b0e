"""What the plane-strain fracture cases share: thin slabs between frictionless planes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..scene import Floats
from ..shapes import elastic, plane

HEAVY = 30.0
"""Density and stiffness of grips over those of what they hold."""


def edge_points(per_cell: int) -> int:
    """Points along each edge of a cell for so many points per cell: 1, 2 for 8, 3 for 27."""
    return max(1, round(per_cell ** (1.0 / 3.0)))


def sheet(lower: Sequence[float], size: Sequence[float], dx: float, per_cell: int) -> Floats:
    """One layer of points in the x-y plane, in the middle of the cell 0 <= z <= dx, [N, 3].

    Args:
        lower: Lower x and y [m].
        size: Extents in x and y [m].
        dx: Node spacing [m].
        per_cell: As in a body of three dimensions: 8 gives 2 x 2 points in the cell of a slab.
    """
    step = dx / edge_points(per_cell)
    x, y = (
        low + (np.arange(round(edge / step)) + 0.5) * step
        for low, edge in zip(lower, size, strict=True)
    )
    flat = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    return np.column_stack([flat, np.full(flat.shape[0], 0.5 * dx)])


def slab_volume(dx: float, per_cell: int) -> float:
    """Volume of a point of :func:`sheet` [m^3]."""
    return dx**3 / edge_points(per_cell) ** 2


def walls(dx: float, axes: Sequence[int] = (2,)) -> tuple[dict[str, Any], ...]:
    """Frictionless planes at 0 and ``dx`` on each axis: a slab, or with two axes a bar."""
    return tuple(plane(axis, at, n) for axis in axes for at, n in ((0.0, 1.0), (dx, -1.0)))


def heavy(row: Mapping[str, Any], weight: float = HEAVY) -> dict[str, Any]:
    """A row for grips: as many times as stiff and dense, so that waves in it are as fast.

    A method that sets the velocity of points before a step, and not that of nodes, moves what is
    held with a force of at most about ``density dx speed / dt`` per area: the grip gives way, and
    more so with long steps. A heavy grip raises that bound.
    """
    young, density = float(row["young_modulus"]), float(row["density"])
    return elastic(weight * young, float(row["poisson_ratio"]), weight * density)
