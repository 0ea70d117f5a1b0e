"""How far the inside of a filled, textured demo object is from the truth."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsfluent.data import SURFACE, Solid
from gsfluent.demo.objects import DemoObject
from gsfluent.demo.truth import grid_points
from gsfluent.errors import InputError
from gsfluent.geometry import ascending
from gsfluent.spatial.neighbours import nearest_rows

_PATCH = 7
_WIDE = 12.0  # voxels: most of the inside is far from the skin


def interior_error(
    solid: Solid, truth: DemoObject, *, bins: int = 24, planes: int = 6, seed: int = 0
) -> dict[str, Any]:
    """Compare the colours inside a solid with the true object, and the colour copy with it too.

    All figures are distances in CIE Lab (D65), zero is perfect:

    * ``profile``: mean over depth bins of the distance between the mean colours at that depth.
    * ``histogram``: mean distance between the sorted values of each Lab channel over all voxels.
    * ``patch``: sliced Wasserstein distance between 7 x 7 patches of axis-aligned slices (128
      projections, 512 quantiles), divided by 7 so that a constant offset reads as its Lab size.

    Only voxels that are inside both objects count. Per-voxel colour differences are not reported: a
    right texture in another place is as good, and a blurred mean would win.

    Args:
        solid: A textured solid in the capture's world frame (colour volume or coloured interior).
        truth: The object the photographs were made of.
        bins: Depth bins of the profile.
        planes: Slices per axis for the patches.
        seed: Seed of the random projections.

    Returns:
        ``profile``, ``histogram``, ``patch``, ``voxels``, ``iou`` (occupancy against the truth) and
        ``color_copy``: the same three figures for copying the nearest surface colour.

    Raises:
        InputError: The solid has no colours, or does not overlap the truth.
    """
    if solid.color is None:
        raise InputError("interior_error: the solid has no colours", "texture it first")
    occupied = solid.occupancy.cpu()
    index = occupied.nonzero()
    centers = solid.voxel_centers(index).cpu().double()
    true_inside = truth.inside(centers)
    if int(true_inside.sum()) < 1000:
        raise InputError(
            f"interior_error: only {int(true_inside.sum())} voxels of the solid lie in the truth",
            "give the solid in the world frame of the capture and the truth of the same capture",
        )
    index, centers = index[true_inside], centers[true_inside]
    true_color = _volume(occupied.shape, index, truth.interior(centers))
    given = _volume(occupied.shape, index, solid.color.cpu()[tuple(index.T)])
    copied = _volume(occupied.shape, index, surface_copy(solid, centers))
    depth = truth.depth(centers).float()
    figures = [
        _distances(colors, true_color, index, depth, bins, planes, seed)
        for colors in (given, copied)
    ]
    true_volume = float(_true_count(truth, solid.voxel))
    both = len(index)
    union = int(occupied.sum()) + true_volume - both
    return figures[0] | {"voxels": both, "iou": both / union, "color_copy": figures[1]}


def surface_copy(solid: Solid, points: Tensor) -> Tensor:
    """The baseline: colour of the nearest surface Gaussian at each point [N, 3]."""
    labels = solid.gaussians.labels
    assert labels is not None  # Solid checks it; narrows the type
    surface = solid.gaussians.select(labels == SURFACE)
    if surface.count == 0:
        raise InputError("interior_error: the solid has no surface Gaussians", "fill it again")
    width = _WIDE * solid.voxel
    nearest = nearest_rows(surface.means, points.to(surface.device), 1, width)[1][:, 0]
    return surface.colors().clamp(0.0, 1.0)[nearest].to(points.device)


def _true_count(truth: DemoObject, voxel: float) -> int:

    lower, upper = truth.bounds()
    shape = [int(n) for n in ((upper - lower) / voxel).ceil()]
    return int(truth.inside(grid_points(lower, voxel, (shape[0], shape[1], shape[2]))).sum())


def _volume(shape: torch.Size, index: Tensor, color: Tensor) -> Tensor:
    """Lab colours on the grid, NaN where nothing is compared, float32 [X, Y, Z, 3]."""
    import cv2

    lab = cv2.cvtColor(color.float().numpy()[None], cv2.COLOR_RGB2LAB)[0]
    volume = torch.full((*shape, 3), float("nan"))
    volume[tuple(index.T)] = torch.from_numpy(np.ascontiguousarray(lab))
    return volume


def _distances(
    given: Tensor, true: Tensor, index: Tensor, depth: Tensor, bins: int, planes: int, seed: int
) -> dict[str, float]:
    mine, theirs = given[tuple(index.T)], true[tuple(index.T)]
    slot = (depth / (depth.max() + 1e-9) * bins).long().clamp(0, bins - 1)
    count = torch.bincount(slot, minlength=bins).clamp_min(1).float()
    offset = torch.zeros(bins, 3).index_add_(0, slot, mine - theirs) / count[:, None]
    filled = torch.bincount(slot, minlength=bins) > 0
    profile = offset[filled].norm(dim=1).mean()
    histogram = (ascending(mine) - ascending(theirs)).abs().mean()
    return {
        "profile": round(float(profile), 4),
        "histogram": round(float(histogram), 4),
        "patch": round(_patch_distance(given, true, index, planes, seed), 4),
    }


def _patch_distance(given: Tensor, true: Tensor, index: Tensor, planes: int, seed: int) -> float:
    """Sliced Wasserstein-1 distance between the patches of axis-aligned slices."""
    generator = torch.Generator().manual_seed(seed)
    directions = torch.randn(3 * _PATCH * _PATCH, 128, generator=generator)
    directions /= directions.norm(dim=0, keepdim=True)
    levels = (torch.arange(512) + 0.5) / 512
    sides = []
    for volume in (given, true):
        patches = []
        for axis in range(3):
            low, high = int(index[:, axis].min()), int(index[:, axis].max())
            for step in range(planes):
                at = low + round((high - low) * (step + 1) / (planes + 1))
                image = volume.select(axis, at)
                windows = image.unfold(0, _PATCH, 2).unfold(1, _PATCH, 2).flatten(0, 1).flatten(1)
                patches.append(windows[~windows.isnan().any(dim=1)])
        sides.append(torch.cat(patches))
    rows = [(levels * len(side)).long() for side in sides]
    if min(len(side) for side in sides) == 0:
        return float("nan")
    sorted_sides = [
        ascending(side @ directions)[row] for side, row in zip(sides, rows, strict=True)
    ]
    return float((sorted_sides[0] - sorted_sides[1]).abs().mean()) / _PATCH
