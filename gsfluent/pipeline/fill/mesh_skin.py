"""Splats on the surface of a textured mesh, drawn like those of any other skin."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch

from gsfluent.data import SURFACE, Gaussians
from gsfluent.pipeline.fill.skin import facing
from gsfluent.spatial.mesh_surface import surface_points

SPLATS = 60_000
"""Splats of a mesh's skin: those of a trained object of such a size."""
_COVER = 0.7
"""Standard deviation over the distance of the fourth neighbour: splats are larger where points lie
farther apart, so that no gap of the even, but random, points shows what is behind."""
_WIDEST = 2.0  # times the mean distance of neighbours
_FLAT = 0.15  # thickness of a splat over its radius


def mesh_gaussians(path: str | Path, count: int = SPLATS, *, seed: int = 0) -> Gaussians:
    """Flat splats on the surface of a mesh file, in its colours, lying along the surface.

    Args:
        path: Any file that trimesh reads.
        count: How many, about.
        seed: Seed of their places.

    Returns:
        Gaussians with normals, in the coordinates of the file; ``report`` says ``colored``.

    Raises:
        InputError: The file cannot be read, or holds no triangles.
    """
    found = surface_points(path, count, seed=seed)
    points = torch.from_numpy(found.points).float()
    normals = torch.nn.functional.normalize(torch.from_numpy(found.normals).float(), dim=1)
    size = _sizes(found.points, found.area)
    scales = torch.stack([size, size, _FLAT * size], dim=1)
    colors = torch.from_numpy(found.colors).float()
    made = Gaussians.from_colors(
        points, scales, colors, opacities=0.95, quats=facing(normals), label=SURFACE
    )
    return made.replace(normals=normals, report={"colored": found.colored})


def _sizes(points: np.ndarray, area: float) -> torch.Tensor:
    """Standard deviation of every splat along the surface [N]."""
    from scipy.spatial import cKDTree

    mean = math.sqrt(area / len(points))
    distance, _ = cKDTree(points).query(points, k=min(5, len(points)))
    fourth = np.asarray(distance).reshape(len(points), -1)[:, -1]
    return torch.from_numpy(_COVER * np.clip(fourth, 0.5 * mean, _WIDEST * mean)).float()
