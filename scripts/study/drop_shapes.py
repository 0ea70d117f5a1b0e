"""Bodies of ``drop_heights.py``: signed distances, and solids made of them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import torch
from torch import Tensor

from gsfluent.data import SURFACE, Gaussians, Solid

Distance = Callable[[Tensor], Tensor]
"""Signed distance [m] of points [N, 3], negative inside, [N]."""


@dataclasses.dataclass(frozen=True)
class Shape:
    """A body in its own coordinates.

    Attributes:
        distance: Its signed distance.
        half: Half extents of a box around the origin that holds it [m].
        wall: Thickness of its wall [m], or None where it is solid.
    """

    distance: Distance
    half: tuple[float, float, float]
    wall: float | None = None


def ball(diameter: float) -> Shape:
    """A ball."""
    radius = 0.5 * diameter
    return Shape(lambda x: x.norm(dim=1) - radius, (radius,) * 3)


def box(size: tuple[float, float, float]) -> Shape:
    """A box; one that is thin has a wall."""
    half = torch.tensor(size, dtype=torch.float64) / 2

    def distance(x: Tensor) -> Tensor:
        away = x.abs() - half
        return away.clamp(min=0.0).norm(dim=1) + away.amax(dim=1).clamp(max=0.0)

    a, b, c = half.tolist()
    return Shape(distance, (a, b, c), min(size) if min(size) < 0.1 * max(size) else None)


def egg(length: float, diameter: float, wall: float) -> Shape:
    """The shell of an ellipsoid of revolution about z."""
    half = torch.tensor([0.5 * diameter, 0.5 * diameter, 0.5 * length], dtype=torch.float64)

    def distance(x: Tensor) -> Tensor:
        # The level over its slope: a distance to second order near the surface, where it counts.
        level, slope = (x / half).norm(dim=1), (x / half**2).norm(dim=1)
        outer = level * (level - 1.0) / slope.clamp(min=1e-9)
        return torch.maximum(outer, -(outer + wall))

    a, b, c = half.tolist()
    return Shape(distance, (a, b, c), wall)


def tumbler(diameter: float, length: float, wall: float, base: float) -> Shape:
    """A cylinder about z, open at its top, with a base."""

    def cylinder(x: Tensor, radius: float, low: float, high: float) -> Tensor:
        side = x[:, :2].norm(dim=1) - radius
        return torch.maximum(side, torch.maximum(low - x[:, 2], x[:, 2] - high))

    def distance(x: Tensor) -> Tensor:
        inner = cylinder(x, 0.5 * diameter - wall, base - 0.5 * length, length)
        return torch.maximum(cylinder(x, 0.5 * diameter, -0.5 * length, 0.5 * length), -inner)

    return Shape(distance, (0.5 * diameter, 0.5 * diameter, 0.5 * length), wall)


def bowl(diameter: float, height: float, wall: float) -> Shape:
    """A spherical cap, open at its top."""
    radius = (0.25 * diameter**2 + height**2) / (2.0 * height)

    def distance(x: Tensor) -> Tensor:
        middle = x - x.new_tensor([0.0, 0.0, radius - 0.5 * height])
        away = middle.norm(dim=1) - radius
        return torch.maximum(torch.maximum(away, -(away + wall)), x[:, 2] - 0.5 * height)

    return Shape(distance, (0.5 * diameter, 0.5 * diameter, 0.5 * height), wall)


def turned(shape: Shape, axis: str, degrees: float) -> Shape:
    """The shape turned about the x or y axis."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    rows = {"x": [[1, 0, 0], [0, c, -s], [0, s, c]], "y": [[c, 0, s], [0, 1, 0], [-s, 0, c]]}
    turn = torch.tensor(rows[axis], dtype=torch.float64)
    half = (turn.abs() @ torch.tensor(shape.half, dtype=torch.float64)).tolist()
    return Shape(lambda x: shape.distance(x @ turn), (half[0], half[1], half[2]), shape.wall)


def solid(shape: Shape, voxel: float) -> Solid:
    """The voxels whose centre lies in a shape, cut to what they fill, its lowest one on z = 0.

    The splat is there because a solid has one; no picture is made.
    """
    counts = [2 * math.ceil(h / voxel) + 2 for h in shape.half]
    axes = [(torch.arange(n, dtype=torch.float64) + 0.5 - n / 2) * voxel for n in counts]
    layers = []
    for x in axes[0]:  # layer by layer: a shell has many empty voxels
        y, z = torch.meshgrid(axes[1], axes[2], indexing="ij")
        points = torch.stack([x.expand_as(y), y, z], dim=-1).reshape(-1, 3)
        layers.append(shape.distance(points).reshape(y.shape).to(torch.float32))
    level = torch.stack(layers)
    filled = (level <= 0.0).nonzero()
    low, high = filled.amin(dim=0).tolist(), (filled.amax(dim=0) + 1).tolist()
    level = level[tuple(slice(a, b) for a, b in zip(low, high, strict=True))].contiguous()
    origin = torch.tensor([-0.5 * n * voxel for n in level.shape[:2]] + [0.0])
    splat = Gaussians.from_colors(
        origin[None], torch.full((1, 3), voxel), torch.full((1, 3), 0.5), label=SURFACE
    )
    return Solid(splat, level <= 0.0, (-level).clamp(min=0.0), origin, voxel)
