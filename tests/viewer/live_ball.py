"""A ball with a green skin and a red inside, densely splatted, to be poked."""

from __future__ import annotations

import torch

from gsfluent.data import INTERIOR, SURFACE, Gaussians, Solid

RADIUS = 0.1


def ball(splats: int = 1500) -> Solid:
    """The ball, centred at the origin."""
    side, voxel = 18, 2 * RADIUS / 14
    axis = (torch.arange(side) + 0.5 - side / 2) * voxel
    grid = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1)
    level = grid.norm(dim=-1)
    depth = (RADIUS - level).clamp(min=0)
    green, red = torch.tensor([0.15, 0.55, 0.2]), torch.tensor([0.85, 0.12, 0.12])
    color = torch.where((depth < 0.01)[..., None], green, red)
    row = torch.arange(splats) + 0.5
    z = 1 - 2 * row / splats
    angle = row * 2.399963
    ring = (1 - z**2).sqrt()
    skin = RADIUS * torch.stack([ring * angle.cos(), ring * angle.sin(), z], 1)
    inside = grid[level < RADIUS - 0.012].reshape(-1, 3)
    inside = inside + 0.3 * voxel * (torch.rand(inside.shape) - 0.5)
    means = torch.cat([skin, inside])
    sizes = torch.full((len(means), 3), 0.45 * voxel)
    colors = torch.cat([green.expand(len(skin), 3), red.expand(len(inside), 3)])
    labels = torch.full((len(means),), INTERIOR, dtype=torch.int32)
    labels[: len(skin)] = SURFACE
    splat = Gaussians.from_colors(means, sizes, colors, opacities=0.95).replace(labels=labels)
    return Solid(splat, level <= RADIUS, depth, torch.full((3,), -side / 2 * voxel), voxel, color,
                 None, {}, None)  # fmt: skip
