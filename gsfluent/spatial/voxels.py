"""Distances and neighbourhoods of the voxels of NumPy arrays."""

from __future__ import annotations

from contextlib import AbstractContextManager

import numpy as np
import torch
from torch import Tensor

from gsfluent.ops.spatial import distance_transform as _transform


def distance_transform(occupied: np.ndarray, device: torch.device | None = None) -> np.ndarray:
    """Distance [voxels] from every occupied voxel's centre to the nearest empty centre.

    Args:
        occupied: bool [X, Y, Z] or [X, Y]; at least one voxel must be empty.
        device: Where to compute; None is the CPU.

    Returns:
        float32 as ``occupied``; 0 where empty.
    """
    squared, _ = _transform(_volume(occupied, device))
    return _distance(squared, occupied)


def nearest_empty(
    occupied: np.ndarray, device: torch.device | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """As :func:`distance_transform`, and which empty voxel is nearest; of several, the first.

    Returns:
        Distances float32, as ``occupied``, and voxel indices int32 [3, X, Y, Z] or [2, X, Y].
    """
    squared, flat = _transform(_volume(occupied, device), indices=True)
    index = []
    for size in reversed(occupied.shape):
        index.append(flat % size)
        flat = flat.div(size, rounding_mode="floor")
    found = torch.stack(index[::-1]).cpu().numpy()
    return _distance(squared, occupied), found.reshape(-1, *occupied.shape)


def _volume(occupied: np.ndarray, device: torch.device | None) -> Tensor:
    held = torch.from_numpy(np.ascontiguousarray(occupied)).to(device or "cpu")
    return held.reshape((1,) * (3 - held.ndim) + held.shape)


def _distance(squared: Tensor, like: np.ndarray) -> np.ndarray:
    result: np.ndarray = squared.float().sqrt().cpu().numpy().reshape(like.shape)
    return result


def grown(occupied: np.ndarray, steps: int) -> np.ndarray:
    """Dilation of bool [X, Y, Z] by ``steps`` voxels in all 26 directions, one axis at a time."""
    from scipy import ndimage

    found = np.ascontiguousarray(occupied).view(np.uint8)
    result: np.ndarray = ndimage.maximum_filter(found, 2 * steps + 1, mode="constant")
    return result.view(bool)


def surface(occupied: np.ndarray) -> np.ndarray:
    """Occupied voxels with an empty neighbour across a face, bool [X, Y, Z]; around is empty."""
    from scipy import ndimage

    result: np.ndarray = occupied & ~ndimage.binary_erosion(occupied)
    return result


def small_convolutions() -> AbstractContextManager[None]:
    """Where convolutions do without cuDNN: to load it costs half a second of a process.

    Theirs are few and small. They are also exact in float32, which cuDNN rounds to TF32.
    """
    return torch.backends.cudnn.flags(enabled=False)
