"""A cube and its points, for the partition."""

from __future__ import annotations

import torch

from gsfluent.data import INTERIOR, Gaussians, Solid
from gsfluent.pipeline.matter.points import sample_points

EDGE = 0.1


def cube(voxels: int = 24) -> Solid:
    """A cube of edge 0.1 m around the origin, an empty rim of two voxels around it."""
    voxel, rim = EDGE / voxels, 2
    size = voxels + 2 * rim
    occupancy = torch.zeros(size, size, size, dtype=torch.bool)
    occupancy[rim:-rim, rim:-rim, rim:-rim] = True
    axis = (torch.arange(size) + 0.5 - 0.5 * size).abs() * voxel
    x, y, z = torch.meshgrid(axis, axis, axis, indexing="ij")
    depth = (0.5 * EDGE - torch.maximum(torch.maximum(x, y), z)).clamp(min=0.0)
    splats = Gaussians.from_colors(
        torch.zeros(1, 3), torch.full((1,), voxel), torch.ones(1, 3), label=INTERIOR
    )
    origin = torch.full((3,), -0.5 * size * voxel)
    return Solid(splats, occupancy, depth, origin, voxel)


def points_of(solid: Solid, spacing: float = EDGE / 16) -> tuple[torch.Tensor, float]:
    """Points of a solid, jittered, and their spacing."""
    points = sample_points(solid, spacing).to(torch.float32)
    return points, spacing


def slabs(rest: torch.Tensor, count: int) -> torch.Tensor:
    """Pieces between tilted planes, of different sizes, int64 [N]."""
    tilted = rest[:, 0] + 0.3 * rest[:, 1] - 0.2 * rest[:, 2]
    ranks = tilted.argsort().argsort().double() / len(rest)
    return (count * ranks**1.4).long().clamp(max=count - 1)


def ball(hollow: bool, voxels: int = 24) -> Solid:
    """A ball of diameter 0.1 m, or a shell of it three eighths of its radius thick."""
    voxel, size = EDGE / voxels, voxels + 4
    axis = (torch.arange(size) + 0.5 - 0.5 * size) * voxel
    x, y, z = torch.meshgrid(axis, axis, axis, indexing="ij")
    radius = (x * x + y * y + z * z).sqrt()
    depth = 0.5 * EDGE - radius
    if hollow:
        depth = torch.minimum(depth, radius - 0.625 * 0.5 * EDGE)
    splats = Gaussians.from_colors(
        torch.zeros(1, 3), torch.full((1,), voxel), torch.ones(1, 3), label=INTERIOR
    )
    origin = torch.full((3,), -0.5 * size * voxel)
    return Solid(splats, depth > 0, depth.clamp(min=0.0), origin, voxel)
