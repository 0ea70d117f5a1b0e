"""A coarse visual hull of a masked capture, for ``inspect`` where there are no sparse points."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from gsfluent.data import Capture, View

Array = NDArray[np.float64]

_SIZE = 128
"""Longest side at which masks are read [pixels]: finer than a voxel of the hull."""

_VOXELS = 40
_VIEWS = 24
_AGREE = 0.9
"""Share of the views that must agree on a voxel; one bad mask must not cut the object."""


def masked_views(capture: Capture) -> list[View]:
    """Read evenly chosen photographs, small, those that come with a mask."""
    step = max(1, len(capture) // _VIEWS)
    views = [capture.view(index, _SIZE) for index in range(0, len(capture), step)]
    return [view for view in views if view.mask is not None]


def inside_masks(views: list[View], points: torch.Tensor) -> Array:
    """Share of the views with each point [N, 3] inside their mask, [N]; out of view is outside."""
    votes = torch.zeros(len(points), dtype=torch.float64)
    for view in views:
        if view.mask is None:
            continue
        pixels, depth = view.camera.project(points)
        place = pixels.floor().long()
        limit = torch.tensor([view.camera.width, view.camera.height])
        seen = (depth > 0) & (place >= 0).all(dim=1) & (place < limit).all(dim=1)
        votes[seen] += (view.mask[place[seen, 1], place[seen, 0]] > 0.5).double()
    return np.asarray((votes / max(1, len(views))).numpy())


def hull_points(capture: Capture, focus: Array) -> tuple[Array, Array]:
    """Surface of the visual hull: points [M, 3] and their colours [M, 3]; empty without masks.

    Args:
        capture: Photographs with masks.
        focus: Point the cameras look at [3].
    """
    views = masked_views(capture)
    grid, inside = hull_grid(views, capture, focus)
    if not inside.any():
        return np.zeros((0, 3)), np.zeros((0, 3))
    points = grid[_surface(inside)]
    return points, _colors(views, points)


def hull_grid(
    views: list[View], capture: Capture, focus: Array, voxels: int = _VOXELS
) -> tuple[Array, NDArray[np.bool_]]:
    """Lattice around the visual hull.

    Args:
        views: From :func:`masked_views`; fewer than three see nothing.
        capture: Photographs they are of.
        focus: Point the cameras look at [3].
        voxels: Points of the lattice along each axis, V.

    Returns:
        Its points [V, V, V, 3], and which of them lie in the hull, bool [V, V, V]; where nothing
        does the lattice may be coarser.
    """
    reach = float(np.median(np.linalg.norm(capture.centers().numpy() - focus, axis=1)))
    low, high = focus - 0.6 * reach, focus + 0.6 * reach
    grid, inside = np.zeros((*(voxels,) * 3, 3)), np.zeros((voxels,) * 3, dtype=bool)
    # each round fits the grid to what the last left; only the last has to be fine
    for count in (voxels // 2, voxels // 2, voxels) if len(views) >= 3 else ():
        axes = [np.linspace(a, b, count) for a, b in zip(low, high, strict=True)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        shares = inside_masks(views, torch.from_numpy(grid.reshape(-1, 3)))
        inside = (shares >= _AGREE).reshape((count,) * 3)
        if not inside.any():
            break
        occupied = grid[inside]
        margin = 1.5 * (high - low) / (count - 1)
        low, high = occupied.min(axis=0) - margin, occupied.max(axis=0) + margin
    return grid, inside


def _surface(inside: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Voxels of a solid with an empty neighbour."""
    padded = np.pad(inside, 1)
    buried = inside.copy()
    for axis in range(3):
        for shift in (-1, 1):
            buried &= np.roll(padded, shift, axis=axis)[1:-1, 1:-1, 1:-1]
    return inside & ~buried


def _colors(views: list[View], points: Array) -> Array:
    """Colour of each point in the view that faces it most."""
    outward = torch.from_numpy(points - points.mean(axis=0))
    best = torch.full((len(points),), -np.inf, dtype=torch.float64)
    colors = torch.full((len(points), 3), 0.5, dtype=torch.float64)
    for view in views:
        facing = outward @ (view.camera.center() - torch.from_numpy(points.mean(axis=0)))
        pixels, _ = view.camera.project(torch.from_numpy(points))
        limit = torch.tensor([view.camera.width - 1, view.camera.height - 1])
        place = torch.minimum(pixels.floor().long().clamp_min(0), limit)
        better = facing > best
        colors[better] = view.image[place[better, 1], place[better, 0]].double()
        best = torch.maximum(best, facing)
    return np.asarray(colors.numpy())
