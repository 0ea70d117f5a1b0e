"""Hollow objects: what a cavity holds, and walls that nobody could see all of."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
import torch

from gsfluent.spatial.voxels import distance_transform, grown

_log = logging.getLogger(__name__)

_SKIN = 1.5  # voxels: less is a difference of opinion about the skin, no cavity
_HIDDEN = 0.15  # share of a cavity's wall that nobody saw, from which it goes on behind
_ROUGH = 300_000  # voxels
_SEEN = 30  # voxels of wall that must have been seen before its thickness is known


def cavity_volume(occupied: np.ndarray, voxel: float) -> float:
    """The most water that an object holds with one axis of its grid upwards [world units cubed].

    Water stays in an empty voxel when every way out of the grid leads over a higher one. Of the six
    ways to set the object down the one that holds most counts; enclosed voids always count.

    Args:
        occupied: Matter, bool [X, Y, Z].
        voxel: Edge of a voxel, world units.
    """
    best, way = 0, (0, False)
    coarse: np.ndarray = occupied
    while coarse.size > _ROUGH:  # which way up shows on a coarse copy as well
        coarse = _halved(coarse)
    for axis in range(3):
        for flip in (False, True):
            found = _held(_layers(coarse, axis, flip))
            if found > best:
                best, way = found, (axis, flip)
    if coarse is not occupied:
        best = _held(_layers(occupied, *way))
    return best * voxel**3


def _halved(occupied: np.ndarray) -> np.ndarray:
    """Half as many voxels a side; one is matter when any of its eight is, so that walls hold."""
    even = np.pad(occupied, [(0, n % 2) for n in occupied.shape])
    x, y, z = (n // 2 for n in even.shape)
    return np.asarray(even.reshape(x, 2, y, 2, z, 2).any(axis=(1, 3, 5)))


def _layers(occupied: np.ndarray, axis: int, flip: bool) -> np.ndarray:
    moved: np.ndarray = np.moveaxis(occupied, axis, 0)
    return moved[::-1] if flip else moved


def _held(layers: np.ndarray) -> int:
    """Empty voxels of layers [Z, X, Y], lowest first, that are not drained at their own height."""
    from scipy import ndimage

    parent = [0]  # component 0 is the outside

    def root(i: int) -> int:
        while parent[i] != i:
            parent[i] = parent[parent[i]]
            i = parent[i]
        return i

    below = np.zeros((layers.shape[1] + 2, layers.shape[2] + 2), dtype=np.int64)
    held = 0
    for layer in layers:
        label, count = ndimage.label(np.pad(~layer, 1, constant_values=True))
        first = len(parent)
        parent.extend(range(first, first + count))
        part = np.where(label > 0, label + (first - 1), -1)
        parent[root(int(part[0, 0]))] = root(0)
        both = (part >= 0) & (below >= 0)
        scale = len(parent)
        for pair in np.unique(part[both] * scale + below[both]).tolist():
            a, b = root(pair // scale), root(pair % scale)
            if a != b:  # the outside stays a root
                parent[max(a, b)] = min(a, b)
        sizes = np.bincount(label.ravel(), minlength=count + 1)
        held += sum(int(sizes[i + 1]) for i in range(count) if root(first + i) != root(0))
        below = part
    return held


def hidden_cavity(
    body: np.ndarray,
    closed: np.ndarray,
    seen: np.ndarray,
    device: torch.device | None = None,
) -> tuple[np.ndarray, dict[str, Any]]:
    """What of a body is probably hollow behind an opening that shows only part of the inside.

    A vase shows its wall at the mouth and hides the rest. Where a cavity that was looked into ends
    at matter that nobody saw, the wall goes on as thick as it was where it was seen.

    Args:
        body: Matter so far, bool [X, Y, Z].
        closed: The object with its openings closed.
        seen: Voxels at which a camera saw a surface.
        device: Where distances are computed.

    Returns:
        Voxels to take out, and ``{}`` or ``wall`` (thickness [voxels]), ``spread`` (its 75 % over
        its 25 % quantile), ``seen`` and ``hidden`` (voxels of the cavity's wall), ``free`` (voxels
        that were looked into).
    """
    from scipy import ndimage

    none = np.zeros_like(body)
    free = closed & ~body
    deep = distance_transform(free, device) > _SKIN if free.any() else none
    if not deep.any():
        return none, {}
    free = grown(deep, 2) & free
    depth = distance_transform(np.pad(closed, 1), device)[1:-1, 1:-1, 1:-1]
    wall = body & ndimage.binary_dilation(free) & (depth > 1.0)
    known = wall & seen
    hidden = wall & ~seen
    counts = {"seen": int(known.sum()), "hidden": int(hidden.sum())}
    if counts["seen"] < _SEEN or counts["hidden"] < _HIDDEN * (counts["seen"] + counts["hidden"]):
        return none, {}
    low, thickness, high = (float(q) for q in np.quantile(depth[known], (0.25, 0.5, 0.75)))
    behind = body & ~seen & (depth > thickness)
    label, _ = ndimage.label(behind)
    touched = np.unique(label[ndimage.binary_dilation(hidden, iterations=2) & behind])
    taken = np.isin(label, touched[touched > 0])
    if not taken.any():
        return none, {}
    return taken, {
        "wall": thickness,
        "spread": high / max(low, 1e-9),
        "free": int(free.sum()),
        **counts,
    }
