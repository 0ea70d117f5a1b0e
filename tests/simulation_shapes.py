"""Small solids with known shape for the simulation tests."""

from __future__ import annotations

import torch

from gsfluent.data import INTERIOR, SURFACE, Frame, Gaussians, Solid


def ellipsoid(
    radii=(0.1, 0.1, 0.1),
    *,
    voxels: int = 24,
    splats: int = 300,
    seed: int = 0,
    frame: Frame | None = None,
) -> Solid:
    """An ellipsoid centred at the origin, green outside and red inside, with splats on its
    surface and in its inside.
    """
    half = torch.tensor(radii, dtype=torch.float32)
    voxel = float(2 * half.max()) / voxels
    counts = torch.ceil(2 * half / voxel).to(torch.int64) + 2
    origin = -0.5 * counts * voxel
    axes = [origin[d] + (torch.arange(int(counts[d])) + 0.5) * voxel for d in range(3)]
    grid = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1)
    level = (grid / half).norm(dim=-1)
    depth = ((1 - level) * half.min()).clamp(min=0)
    green, red = torch.tensor([0.1, 0.5, 0.1]), torch.tensor([0.9, 0.2, 0.2])
    color = torch.where((depth < 0.1 * half.min())[..., None], green, red)
    generator = torch.Generator().manual_seed(seed)
    direction = torch.nn.functional.normalize(torch.randn(splats, 3, generator=generator), dim=1)
    radius = torch.ones(splats, 1)
    inner = torch.arange(splats) >= splats // 2
    radius[inner] = torch.rand(int(inner.sum()), 1, generator=generator) ** (1 / 3) * 0.9
    means = direction * radius * half
    size = torch.full((splats, 3), float(half.min()) * 0.08)
    gaussians = Gaussians.from_colors(
        means, size, torch.where(inner[:, None], red, green), opacities=0.9
    )
    labels = torch.where(inner, INTERIOR, SURFACE).to(torch.int32)
    return Solid(
        gaussians.replace(labels=labels), level <= 1, depth, origin, voxel, color, None, {}, frame
    )
