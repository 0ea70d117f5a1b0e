"""Splats for a skin that has none: a solid from masks or a mesh, to be drawn like the others."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from gsfluent.data import Capture, Gaussians
from gsfluent.pipeline.solid.field import SignedDistance
from gsfluent.pipeline.solid.tsdf import depth_views
from gsfluent.spatial.voxels import surface

_GREY = 0.6
_FLAT = 0.2  # thickness of a splat over its radius
_MOST = 60_000
_VIEWS = 24
_SIZE = 400  # pixels
_SLACK = 1.5  # voxels behind the first surface that still count as seen


@torch.no_grad()
def skin_gaussians(field: SignedDistance, capture: Capture | None = None) -> Gaussians:
    """Flat splats on the surface of a solid.

    Args:
        field: The solid.
        capture: Photographs that colour it: the mean over those that see a place, weighted by how
            directly they look at it. Grey without, and where none sees it.

    Returns:
        One splat for each voxel of the skin (at most 60 000), with normals.
    """
    inside = field.inside.cpu().numpy()
    index = np.argwhere(surface(inside))
    count = len(index)
    if count > _MOST:
        index = index[np.random.default_rng(0).choice(len(index), _MOST, replace=False)]
    values = field.values.cpu()
    slopes = torch.stack(torch.gradient(values), -1)[tuple(index.T)]
    normal = torch.nn.functional.normalize(slopes, dim=1)
    center = field.origin.cpu() + (torch.from_numpy(index) + 0.5) * field.voxel
    points = center - values[tuple(index.T)][:, None] * normal
    size = 0.7 * field.voxel * math.sqrt(max(1.0, float(count) / len(index)))
    scales = torch.tensor([size, size, _FLAT * size]).repeat(len(points), 1)
    colors = torch.full((len(points), 3), _GREY)
    made = Gaussians.from_colors(
        points, scales, colors, opacities=0.95, quats=facing(normal)
    ).replace(normals=normal)
    if capture is None:
        return made
    seen = _photographed(made, normal, capture, _SLACK * field.voxel)
    return Gaussians.from_colors(points, scales, seen, opacities=0.95, quats=made.quats).replace(
        normals=normal
    )


def _photographed(made: Gaussians, normal: Tensor, capture: Capture, slack: float) -> Tensor:
    """Colours [N, 3] that photographs show of splats."""
    total = torch.zeros(made.count, 3)
    weight = torch.zeros(made.count)
    for index in range(0, len(capture), max(1, len(capture) // _VIEWS)):
        view = capture.view(index, _SIZE)
        depth = depth_views(made, [view.camera])[0].depth
        pixel, z = view.camera.project(made.means.double())
        column, row = pixel.floor().clamp(-1, 1e6).long().unbind(1)
        on = (z > 0) & (column >= 0) & (column < view.camera.width)
        on &= (row >= 0) & (row < view.camera.height)
        row, column = row.clamp(0, depth.shape[0] - 1), column.clamp(0, depth.shape[1] - 1)
        toward = view.camera.center().float() - made.means
        facing = (torch.nn.functional.normalize(toward, dim=1) * normal).sum(1).clamp_min(0.0)
        facing *= on & (z <= depth[row, column] + slack)
        total += facing[:, None] * view.image[row, column]
        weight += facing
    grey = torch.full_like(total, _GREY)
    return torch.where(weight[:, None] > 1e-3, total / weight.clamp_min(1e-9)[:, None], grey)


def facing(normal: Tensor) -> Tensor:
    """Quaternions [N, 4] that turn z to unit vectors [N, 3]."""
    zero = torch.zeros_like(normal[:, 0])
    quats = torch.stack([1.0 + normal[:, 2], -normal[:, 1], normal[:, 0], zero], 1)
    quats[normal[:, 2] < -0.999] = torch.tensor([0.0, 1.0, 0.0, 0.0])
    return quats
