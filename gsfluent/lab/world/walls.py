"""Planes along the axes as rows of colliders: floors, walls, the two sides of a slab."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from gsfluent.ops.collider import collider_row


def wall(axis: int, at: float = 0.0, side: int = 1, mode: str = "slip", **more: Any) -> Tensor:
    """Collider row of the half space below (``side`` 1) or above (-1) ``at`` [m] on an axis.

    Args:
        axis: 0, 1, 2.
        at: Where its face is [m].
        side: Sign of its normal.
        mode: ``sticky``, ``slip`` or ``separate``.
        **more: Of :func:`gsfluent.ops.collider.collider_row`.
    """
    point, normal = [0.0] * 3, [0.0] * 3
    point[axis], normal[axis] = at, float(side)
    return collider_row("plane", point=point, normal=normal, mode=mode, **more)


def between_planes(dx: float, axes: Sequence[int] = (2,), width: float | None = None) -> Tensor:
    """Frictionless planes at 0 and ``width`` (default ``dx``) on each axis, [2 len(axes), 32]."""
    far = dx if width is None else width
    return torch.stack(
        [wall(axis, at, side) for axis in axes for at, side in ((0.0, 1), (far, -1))]
    )


PLANE_STRAIN = wall(2, 1e6)
"""A slip plane so far up that every node is behind it: no motion along z."""
