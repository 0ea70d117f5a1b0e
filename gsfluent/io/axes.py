"""A Gaussian's axes have no names: 24 quaternions with permuted scales are the same ellipsoid.

Eigen-decompositions pick any of them, another one in the next frame perhaps. What is stored as
differences, or interpolated by a player, wants the one that turned least. numpy only.
"""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsfluent.io.splats.delta import hamilton


def _cube() -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Quaternions ``wxyz`` [24, 4] of the cube's rotations; what each new axis was, [24, 3]."""
    half = np.sqrt(0.5)
    found: dict[tuple[float, ...], NDArray[np.float64]] = {}
    for parts in itertools.product((-1.0, -half, -0.5, 0.0, 0.5, half, 1.0), repeat=4):
        quat = np.array(parts)
        if abs(quat @ quat - 1.0) > 1e-9:
            continue
        w, x, y, z = quat
        matrix = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        if np.abs(matrix - np.rint(matrix)).max() < 1e-9:
            found.setdefault(tuple(np.rint(matrix).reshape(-1)), quat)
    quats = np.stack(list(found.values()))
    matrices = np.array(list(found)).reshape(-1, 3, 3)
    return quats, np.abs(matrices).argmax(axis=1)


_QUATS, _SOURCE = _cube()
_CONJUGATE = np.array([1.0, -1.0, -1.0, -1.0])


def nearest_axes(
    quats: NDArray[Any], scales: NDArray[Any], wanted: NDArray[Any]
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Rename the axes of ellipsoids so that they are turned as little as possible.

    Args:
        quats: Unit quaternions ``wxyz`` [N, 4].
        scales: Sizes along the axes [N, 3].
        wanted: Quaternions to come near to, [N, 4].

    Returns:
        Quaternions (of the sign nearest to ``wanted``) and scales of the same ellipsoids.
    """
    # (q c) . r = c . (conj(q) r)
    score = hamilton(quats * _CONJUGATE, wanted) @ _QUATS.T
    best = np.abs(score).argmax(axis=1)
    turned = hamilton(quats, _QUATS[best])
    sign = np.where(score[np.arange(len(best)), best] < 0, -1.0, 1.0)[:, None]
    return turned * sign, np.take_along_axis(scales, _SOURCE[best], axis=1)
