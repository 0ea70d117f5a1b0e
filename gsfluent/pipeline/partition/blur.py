"""Sums over boxes of voxels: the same bits on every device and in any order.

Three box filters one after another are a Gaussian to a few per cent (their kernel is a quadratic
B-spline along each axis). On indicators they count whole numbers, so no rounding comes in.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional

TIMES = 3
"""Box filters that make one blur."""
_SMALL = 32767  # largest int16


def box_width(sigma: float) -> int:
    """Odd width [voxels] of the box whose three passes have the standard deviation ``sigma``."""
    wanted = math.sqrt(12.0 * sigma * sigma / TIMES + 1.0)
    return max(1, 2 * round((wanted - 1.0) / 2.0) + 1)


def reach(width: int) -> int:
    """Voxels beyond which a blur of this width does not see."""
    return TIMES * (width // 2)


def blur(indicator: Tensor, width: int) -> Tensor:
    """How often each voxel is counted by three passes of a box, along every axis.

    Args:
        indicator: 0 and 1, bool [X, Y, Z]; outside of the grid is 0.
        width: Odd width of the box [voxels], at most 9.

    Returns:
        int32 [X, Y, Z], at most ``width^9``.

    Raises:
        ValueError: The width is even, or its sums do not fit.
    """
    if width % 2 == 0 or not 1 <= width <= 9:
        raise ValueError(f"blur: width must be odd and 1 to 9, got {width}")
    field, most = indicator.to(torch.int16), 1
    for axis in (2, 1, 0):
        for _ in range(TIMES):
            most *= width
            if most > _SMALL:
                field = field.to(torch.int32)
            field = _window(field, width, axis)
    return field.to(torch.int32)


def _window(field: Tensor, width: int, axis: int) -> Tensor:
    """Sums over ``width`` neighbours along an axis, by doubling."""
    count, half = field.shape[axis], width // 2
    pad = [0] * 6
    pad[4 - 2 * axis] = pad[5 - 2 * axis] = half
    part = functional.pad(field, pad)
    total, start, size = None, 0, 1
    while True:
        if width & size:
            piece = part.narrow(axis, start, count)
            total = piece if total is None else total + piece
            start += size
        if 2 * size > width:
            break
        length = part.shape[axis] - size
        part = part.narrow(axis, 0, length) + part.narrow(axis, size, length)
        size *= 2
    assert total is not None  # width is at least 1
    return total
