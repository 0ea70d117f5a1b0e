"""Rows sorted along a space-filling curve, so that neighbours in a file are neighbours in space."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

_BITS = 10  # per axis: finer than any block of rows that shares limits


def morton_order(points: NDArray[Any]) -> NDArray[np.int64]:
    """Order of points along the Z-order curve of their bounding box (Morton 1966).

    Args:
        points: [N, 3], any unit.

    Returns:
        Row numbers [N]; equal codes keep their order.
    """
    if len(points) == 0:
        return np.zeros(0, dtype=np.int64)
    low, high = points.min(axis=0), points.max(axis=0)
    span = np.where(high > low, high - low, 1.0)
    cell = np.clip((points - low) / span * (1 << _BITS), 0, (1 << _BITS) - 1).astype(np.uint64)
    code = np.zeros(len(points), dtype=np.uint64)
    for bit in range(_BITS):
        for axis in range(3):
            code |= (cell[:, axis] >> np.uint64(bit) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return np.argsort(code, kind="stable")
