"""Blades that part matter: blade_rows, blade_sides, merged_fields.

A blade is a straight edge that moves along a polyline. Particles near the sheet that the edge has
swept get a side once and keep it; a field is a body and its sides. Fields of one body move as one,
except two on opposite sides of a blade, which are in contact. The mathematics is
``csrc/core/collider/blade.h``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from gsfluent._check import check_tensor
from gsfluent.ops._register import fakes

BLADE_COLUMNS = 16
MAX_BLADES = 15
START, EDGE, WAY, LENGTH, HALF_WIDTH, FROM, TO, NUMBER, JOINTS = 0, 3, 6, 9, 10, 11, 12, 13, 14


def blade_rows(
    path: Sequence[Sequence[float]] | Tensor,
    edge: Sequence[float],
    width: float,
    *,
    swept: tuple[float, float] = (0.0, math.inf),
    number: int = 0,
) -> Tensor:
    """Rows of one blade, one per leg of its path.

    Args:
        path: Where the middle of the edge goes [m], [P, 3] with P >= 2.
        edge: Direction of the edge, [3]; not along the path.
        width: Length of the edge [m].
        swept: Arc length of the edge at the last look and now [m].
        number: Which blade, 0 to 14.

    Returns:
        float64 [P - 1, 16]; see ``csrc/core/collider/blade.h``.

    Raises:
        ValueError: A path that does not move, an edge along the path, or a number out of range.
    """
    op = "blade_rows"
    points = torch.as_tensor(path, dtype=torch.float64)
    line = torch.as_tensor(edge, dtype=torch.float64)
    if points.ndim != 2 or points.shape[0] < 2 or points.shape[1] != 3:
        raise ValueError(f"{op}: path must have shape [P >= 2, 3], got {list(points.shape)}")
    if line.shape != (3,) or not bool(line.norm() > 0):
        raise ValueError(f"{op}: edge must be a direction of three numbers, got {edge}")
    if not width > 0:
        raise ValueError(f"{op}: width must be > 0, got {width}")
    if not 0 <= number < MAX_BLADES:
        raise ValueError(f"{op}: number must be 0 to {MAX_BLADES - 1}, got {number}")
    legs = points[1:] - points[:-1]
    lengths = legs.norm(dim=1)
    line = line / line.norm()
    if not bool(
        (torch.linalg.cross(legs, line.expand_as(legs)).norm(dim=1) > 1e-3 * lengths).all()
    ):
        raise ValueError(f"{op}: every leg of path must move across the edge")
    rows = torch.zeros(len(legs), BLADE_COLUMNS, dtype=torch.float64)
    rows[:, START:EDGE], rows[:, EDGE:WAY] = points[:-1], line
    rows[:, WAY:LENGTH], rows[:, LENGTH] = legs / lengths[:, None], lengths
    rows[:, HALF_WIDTH], rows[:, NUMBER] = 0.5 * width, number
    begin = torch.cumsum(lengths, dim=0) - lengths
    low, high = swept
    rows[:, FROM] = torch.minimum((low - begin).clamp(min=0.0), lengths)
    rows[:, TO] = torch.minimum((high - begin).clamp(min=0.0), lengths)
    index = torch.arange(len(legs))
    rows[:, JOINTS] = (index > 0).double() + 2.0 * (
        begin + lengths < min(high, float(lengths.sum()))
    )
    return rows


def blade_sides(position: Tensor, blades: Tensor, cut: Tensor, reach: float) -> Tensor:
    """Give particles near what the edges have just swept their side.

    Args:
        position: Positions [m], [N, 3].
        blades: Rows of all blades, legs of one blade together, [L, 16], same dtype.
        cut: Sides so far, int32 [N]: bits 2 n and 2 n + 1 for above and below blade n.
        reach: Distance from the sheet within which a side is given [m]. 3 cells: then particles
            without a side never share a node with particles of the other side.

    Returns:
        The sides, int32 [N]. A side once given stays.

    Raises:
        TypeError: Wrong type or dtype.
        ValueError: Wrong shape or device, or a negative ``reach``.
    """
    op = "blade_sides"
    check_tensor(op, "position", position, shape=(None, 3))
    check_tensor(op, "blades", blades, shape=(None, BLADE_COLUMNS), like=position)
    shape = (position.shape[0],)
    check_tensor(op, "cut", cut, shape=shape, dtype=torch.int32, like=position)
    if not 0.0 <= reach < math.inf:
        raise ValueError(f"{op}: reach must be >= 0 and finite, got {reach}")
    sides: Tensor = torch.ops.gsfluent.blade_sides(position.detach(), blades, cut, float(reach))
    return sides


def merged_fields(parent: Tensor, cut: Tensor) -> Tensor:
    """Pairs of fields that move as one: of one body and on no two sides of a blade.

    Args:
        parent: Body of each field, integer [K].
        cut: Sides of each field, int32 [K].

    Returns:
        bool [K, K], the ``merged`` of :func:`gsfluent.ops.grid_update`.
    """
    return (parent[:, None] == parent[None, :]) & ~cut_apart(cut[:, None], cut[None, :])


def cut_apart(a: Tensor, b: Tensor) -> Tensor:
    """Whether sides ``a`` and ``b`` lie on opposite sides of some blade, bool of their shape."""
    a, b = a.to(torch.int64), b.to(torch.int64)
    return (((a << 1) & b) | ((b << 1) & a)) & 0x2AAAAAAA != 0


fakes(blade_sides=lambda position, blades, cut, reach: torch.empty_like(cut))
