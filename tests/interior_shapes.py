"""Analytic splat shells for the tests of filling and texturing."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from gsfluent import geometry
from gsfluent.data import Gaussians, Solid

RADII = (1.0, 0.8, 0.7)


def ellipsoid_shell(
    count: int = 2500,
    radii: tuple[float, float, float] = RADII,
    keep: Callable[[Tensor], Tensor] | None = None,
    color: Callable[[Tensor], Tensor] | None = None,
) -> Gaussians:
    """Flat splats on an ellipsoid, evenly spread (Fibonacci spiral), turned along the normal."""
    r = torch.tensor(radii, dtype=torch.float64)
    index = torch.arange(count, dtype=torch.float64) + 0.5
    z = 1 - 2 * index / count
    angle = index * math.pi * (3 - math.sqrt(5))
    ring = (1 - z * z).sqrt()
    unit = torch.stack([ring * angle.cos(), ring * angle.sin(), z], 1)
    points = unit * r
    normal = torch.nn.functional.normalize(unit / r, dim=1)
    # half-way quaternion from +z to the normal
    quats = torch.stack([1 + normal[:, 2], -normal[:, 1], normal[:, 0], 0 * normal[:, 0]], 1)
    size = 0.75 * math.sqrt(4 * math.pi * float(r.prod()) ** (2 / 3) / count)
    scales = torch.tensor([size, size, 0.3 * size], dtype=torch.float64).repeat(count, 1)
    colors = torch.full_like(points, 0.5) if color is None else color(points)
    chosen = torch.ones(count, dtype=torch.bool) if keep is None else keep(points)
    return Gaussians.from_colors(
        points[chosen].float(),
        scales[chosen].float(),
        colors[chosen].float(),
        opacities=0.95,
        quats=geometry.normalize_quaternions(quats)[chosen].float(),
    )


def ellipsoid_truth(solid: Solid, radii: tuple[float, float, float] = RADII) -> np.ndarray:
    """Voxels whose centre lies in the ellipsoid."""
    grid = np.meshgrid(*(np.arange(s) for s in solid.occupancy.shape), indexing="ij")
    points = solid.origin.numpy() + (np.stack(grid, -1) + 0.5) * solid.voxel
    return np.asarray(((points / np.array(radii)) ** 2).sum(-1) <= 1.0)


def iou(a: np.ndarray, b: np.ndarray) -> float:
    """Intersection over union of two voxel sets."""
    return float((a & b).sum() / (a | b).sum())
