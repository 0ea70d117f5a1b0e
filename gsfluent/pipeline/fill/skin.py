"""Splats for a skin that has none: a solid from masks or a mesh, to be drawn like the others."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from gsfluent.data import SURFACE, Capture, Gaussians
from gsfluent.pipeline.solid.colors import surface_colors
from gsfluent.pipeline.solid.field import SignedDistance
from gsfluent.pipeline.solid.tsdf import depth_views
from gsfluent.spatial.neighbours import nearest
from gsfluent.spatial.voxels import surface

_GREY = 0.6
_FLAT = 0.2  # thickness of a splat over its radius
_MOST = 60_000
_VIEWS = 24
_SIZE = 400  # pixels
_FACES = 0.9  # cosine to a side within which a skin belongs to it
_BELOW = 0.25  # voxels below the skin: what lies in it is seen beside the object
_OPAQUE = 0.5
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


@torch.no_grad()
def unseen_skin(field: SignedDistance, gaussians: Gaussians, side: Sequence[float]) -> Gaussians:
    """Flat splats on a side that nobody saw, in the colours of the skin around it.

    What photographs contradict at its rim is taken away from the inside, and nothing stands before
    what is left: the side would be seen some voxels too deep.

    Args:
        field: The solid.
        gaussians: Splats of the skin that were seen.
        side: Unit vector that the side faces.

    Returns:
        One splat for each voxel of the skin there that has no opaque splat of the skin beside it.
    """
    index = np.argwhere(surface(field.inside.cpu().numpy()))
    values = field.values.cpu()
    slopes = torch.stack(torch.gradient(values), -1)[tuple(index.T)]
    normal = torch.nn.functional.normalize(slopes, dim=1)
    toward = torch.tensor(side, dtype=normal.dtype)
    there = (normal @ toward > _FACES).nonzero()[:, 0]
    index, normal = index[there.numpy()], normal[there]
    center = field.origin.cpu() + (torch.from_numpy(index) + 0.5) * field.voxel
    depth = values[tuple(index.T)] + _BELOW * field.voxel
    points = (center - depth[:, None] * normal).float()
    seen = gaussians.opacities > _OPAQUE
    if gaussians.labels is not None:
        seen &= gaussians.labels == SURFACE
    firm = gaussians.means[seen].detach()
    if len(firm) and len(points):
        away = nearest(firm, points.double().numpy(), 1, float(field.voxel))[0][:, 0]
        bare = torch.from_numpy(away > field.voxel)
        points, normal = points[bare], normal[bare]
    size = 0.7 * field.voxel
    scales = torch.tensor([size, size, _FLAT * size]).repeat(len(points), 1)
    colors = torch.zeros(0, 3)
    if len(points):
        found = surface_colors(gaussians, points.double().numpy(), float(field.voxel))
        colors = torch.from_numpy(found).float()
    made = Gaussians.from_colors(
        points, scales, colors, opacities=0.95, quats=facing(normal), label=SURFACE
    )
    return made.to(gaussians.means.device)


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
