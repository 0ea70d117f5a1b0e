"""Structure that follows the object's axis: a photographed cross-section swept through the solid.

A cut across the middle of an apple or an orange shows a star or segments that depth alone does not
know about. Every voxel is given the place in the photograph with the same azimuth about the axis
and the same relative depth: the middle plane repeats the photograph, and towards the poles its core
narrows with the solid.
"""

from __future__ import annotations

import numpy as np

from .domain import axis_frame
from .photo import Exemplar

__all__ = ["swept_color"]

_TURNS = 360
_STEPS = 96


def swept_color(
    inside: np.ndarray, depth: np.ndarray, axis: np.ndarray, photo: Exemplar
) -> np.ndarray:
    """Sweep a cross-section about an axis.

    Args:
        inside: Voxels, bool [X, Y, Z].
        depth: Distance below the surface [voxels], [X, Y, Z].
        axis: Unit vector [3] across which the photograph was cut.
        photo: Photograph with an outline.

    Returns:
        Colours float32 [X, Y, Z, 3]; zero outside.
    """
    from scipy import ndimage

    table = _ray_table(photo)
    index = np.argwhere(inside)
    relative = depth[inside] / max(float(depth.max()), 1e-6)
    core = index[relative > 0.9].mean(0)
    local = (index - core) @ axis_frame(axis).T
    # image rows run down, the second object axis up
    turn = np.arctan2(local[:, 1], local[:, 0]) / (2 * np.pi) * _TURNS
    step = np.clip(relative, 0.0, 1.0) * (_STEPS - 1)
    coordinates = np.stack([turn % _TURNS, step])
    rgb = np.zeros((*inside.shape, 3), np.float32)
    wrapped = np.concatenate([table, table[:1]])
    place = [
        ndimage.map_coordinates(wrapped[..., k], coordinates, order=1, mode="nearest")
        for k in range(2)
    ]
    channels = [
        ndimage.map_coordinates(photo.image[..., c], place, order=1, mode="nearest")
        for c in range(3)
    ]
    rgb[inside] = np.stack(channels, 1)
    return rgb


def _ray_table(photo: Exemplar) -> np.ndarray:
    """Photograph position (row, column) per azimuth and relative depth, [_TURNS, _STEPS, 2]."""
    from scipy import ndimage

    smooth = ndimage.gaussian_filter(photo.depth, 1.0)
    rows, columns = np.nonzero(photo.depth >= 0.95 * photo.max_depth)
    center = np.array([rows.mean(), columns.mean()])
    reach = float(np.hypot(*photo.mask.shape))
    radius = np.linspace(0.0, reach, 4 * int(reach))
    table = np.zeros((_TURNS, _STEPS, 2))
    wanted = np.linspace(0.0, 1.0, _STEPS)
    for k in range(_TURNS):
        angle = 2 * np.pi * k / _TURNS
        direction = np.array([-np.sin(angle), np.cos(angle)])
        line = center[:, None] + direction[:, None] * radius
        profile = ndimage.map_coordinates(smooth, line, order=1, mode="constant")
        inner = np.flatnonzero(profile > 0)
        last = int(inner[-1]) + 1 if len(inner) else 1
        # depth grows inward; small dents on the way are levelled so that it can be inverted
        rising = np.maximum.accumulate(profile[:last][::-1])
        rising = rising / max(float(rising[-1]), 1e-6) + 1e-9 * np.arange(last)
        distance = np.interp(wanted, rising, radius[:last][::-1])
        table[k] = center + distance[:, None] * direction
    return table
