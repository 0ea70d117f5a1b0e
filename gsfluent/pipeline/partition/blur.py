"""Sums over boxes of voxels: the same bits on every device and in any order.

Three box filters one after another are a Gaussian to a few per cent (their kernel is a quadratic
B-spline along each axis). On indicators they count whole numbers, so no rounding comes in.
"""

from __future__ import annotations

import math

from torch import Tensor

from gsfluent import ops

TIMES = 3
"""Box filters that make one blur."""


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
    return ops.box_blur(indicator, width, TIMES)
