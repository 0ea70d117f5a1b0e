"""Structure that follows the object's axis: a photographed cross-section swept through the solid.

A cut across the middle of an apple or an orange shows a star or segments that depth alone does not
know about. Every voxel is given the place in the photograph with the same azimuth about the axis
and the same relative depth: the middle plane repeats the photograph, and towards the poles its core
narrows with the solid. In a solid of constant cross-section (a trunk, a sausage) depth is measured
across the axis instead, so that rings run through to the ends.

A photograph cut along the axis is turned about it: every voxel is given the place with the same
elevation above the middle and the same relative depth, on the right half of the photograph on one
side of the object and on the left half on the other, blended in between.
"""

from __future__ import annotations

import numpy as np

from gsfluent.errors import InputError

from .domain import axis_frame
from .photo import Exemplar

__all__ = ["CUTS", "axial_depth", "is_prism", "swept_color"]

CUTS = ("across", "along")
"""How a photograph for ``guide="axis"`` was cut, relative to the object's axis."""

_TURNS = 360
_STEPS = 96
_PRISM = 0.85  # volume over (largest cross-section times length): ball 0.67, cylinder 1


def swept_color(
    inside: np.ndarray,
    depth: np.ndarray,
    axis: np.ndarray,
    photo: Exemplar,
    cut: str = "across",
) -> np.ndarray:
    """Sweep a photograph about an axis.

    Args:
        inside: Voxels, bool [X, Y, Z].
        depth: Distance below the surface [voxels], [X, Y, Z]; for a prism :func:`axial_depth`.
        axis: Unit vector [3], the object's axis.
        photo: Photograph with an outline. Cut along, its upper edge is where the axis points.
        cut: ``across`` or ``along`` the axis.

    Returns:
        Colours float32 [X, Y, Z, 3]; zero outside.

    Raises:
        InputError: Unknown cut.
    """
    if cut not in CUTS:
        raise InputError(
            f"texture: cut must be one of {', '.join(CUTS)}, got {cut!r}", mend="leave it at across"
        )
    table = _ray_table(photo)
    index = np.argwhere(inside)
    relative = depth[inside] / max(float(depth.max()), 1e-6)
    core = index[relative > 0.9].mean(0)
    local = (index - core) @ axis_frame(axis).T
    # image rows run down, the second object axis up
    azimuth = np.arctan2(local[:, 1], local[:, 0])
    rgb = np.zeros((*inside.shape, 3), np.float32)
    if cut == "across":
        rgb[inside] = _look_up(photo, table, azimuth, relative)
        return rgb
    elevation = np.arctan2(local[:, 2], np.hypot(local[:, 0], local[:, 1]))
    right = _look_up(photo, table, elevation, relative)
    left = _look_up(photo, table, np.pi - elevation, relative)
    # a narrow seam: half-way between two halves that differ there is only a blur of both
    share = np.clip(0.5 + 1.5 * np.cos(azimuth), 0.0, 1.0)[:, None]
    rgb[inside] = share * right + (1.0 - share) * left
    return rgb


def _look_up(
    photo: Exemplar, table: np.ndarray, angle: np.ndarray, relative: np.ndarray
) -> np.ndarray:
    """Colours [n, 3] of the photograph at angles [n] and relative depths [n]."""
    from scipy import ndimage

    turn = (angle / (2 * np.pi) * _TURNS) % _TURNS
    step = np.clip(relative, 0.0, 1.0) * (_STEPS - 1)
    coordinates = np.stack([turn, step])
    wrapped = np.concatenate([table, table[:1]])
    place = [
        ndimage.map_coordinates(wrapped[..., k], coordinates, order=1, mode="nearest")
        for k in range(2)
    ]
    channels = [
        ndimage.map_coordinates(photo.image[..., c], place, order=1, mode="nearest")
        for c in range(3)
    ]
    return np.stack(channels, 1)


def is_prism(inside: np.ndarray, axis: np.ndarray) -> bool:
    """Whether the cross-section across the axis hardly changes (trunk, loaf, disc)."""
    height = np.argwhere(inside) @ (axis / np.linalg.norm(axis))
    low, high = np.quantile(height, [0.005, 0.995])
    bins = max(4, min(32, int(high - low)))
    area = np.histogram(height, bins, (low, high))[0]
    # the mean of the upper half rather than the maximum: one slice with a branch decides nothing
    return bool(area.mean() > _PRISM * np.sort(area)[bins // 2 :].mean())


def axial_depth(inside: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Distance to the outline within the planes across the axis [voxels], [X, Y, Z].

    Axes along the grid are exact; for others the voxels are turned there and back.
    """
    from scipy import ndimage

    unit = axis / np.linalg.norm(axis)
    nearest = int(np.abs(unit).argmax())
    if abs(unit[nearest]) > 0.999:
        return _plane_depth(inside, nearest)
    rotation = axis_frame(unit)
    size = int(np.ceil(np.linalg.norm(inside.shape))) + 2
    middle = (np.array(inside.shape) - 1) / 2.0
    center = np.full(3, (size - 1) / 2.0)
    turned = ndimage.affine_transform(
        inside.astype(np.float32),
        rotation.T,
        offset=middle - rotation.T @ center,
        output_shape=(size,) * 3,
        order=1,
    )
    deep = _plane_depth(turned > 0.5, 2)
    back = ndimage.affine_transform(
        deep, rotation, offset=center - rotation @ middle, output_shape=inside.shape, order=1
    )
    return np.where(inside, np.maximum(back, 0.5), 0.0).astype(np.float32)


def _plane_depth(inside: np.ndarray, axis: int) -> np.ndarray:
    """Distance to the outline within each slice across a grid axis."""
    from scipy import ndimage

    depth = np.zeros(inside.shape, np.float32)
    slices, result = np.moveaxis(inside, axis, 0), np.moveaxis(depth, axis, 0)
    for k, plane in enumerate(slices):
        if plane.any():
            result[k] = ndimage.distance_transform_edt(np.pad(plane, 1))[1:-1, 1:-1] - 0.5
    return np.where(inside, depth, 0.0).astype(np.float32)


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
