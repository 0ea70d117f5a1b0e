"""Points of a liquid as it is poured: blue noise, another in every slice.

A lattice would leave its rows in the picture: a jet of its columns falls apart into strands where
it spreads. Every slice is a disc of equal shares by the golden angle, turned at random; then the
points push each other apart until they keep their distance in the slices beside theirs, too.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gsfluent.spatial.neighbours import nearest_rows

_GOLDEN = math.pi * (3.0 - math.sqrt(5.0))
_ROUNDS = 6
_NEIGHBOURS = 12
_PUSH = 0.25
_APART = 1.0
"""Distance below which points push, in spacings; a close packing could have 1.12."""
_SKIN = 0.35
"""Nearest a point may come to the wall of the cylinder, in spacings."""


def blue_cylinder(radius: float, length: float, step: float, seed: int) -> Tensor:
    """Points that fill a cylinder along z around the origin evenly, without rows.

    Args:
        radius: Of the cylinder [m].
        length: Of the cylinder [m].
        step: Distance of the points [m]: there is one for every ``step^3`` of the volume.
        seed: The same seed gives the same points, on every device.

    Returns:
        Points [m], float64 [N, 3] on the CPU, slice by slice from below.
    """
    layers = max(1, round(length / step))
    total = max(layers, round(math.pi * radius**2 * length / step**3))
    generator = torch.Generator().manual_seed(seed)
    ends = (torch.arange(layers + 1) * total) // layers  # shares that differ by one at most
    layer = torch.repeat_interleave(torch.arange(layers), ends.diff())
    within = torch.arange(total) - ends[layer]
    share = (within.double() + 0.5) / ends.diff()[layer]
    turn = 2.0 * math.pi * torch.rand(layers, generator=generator, dtype=torch.float64)
    angle = within * _GOLDEN + turn[layer]
    jitter = torch.rand(total, generator=generator, dtype=torch.float64) - 0.5
    height = (layer + 0.5 + 0.5 * jitter) / layers - 0.5
    across = radius * share.sqrt()
    points = torch.stack([across * angle.cos(), across * angle.sin(), height * length], dim=1)
    for _ in range(_ROUNDS):
        points = _inside(_pushed(points, step), radius, length, _SKIN * step)
    return points


def _pushed(points: Tensor, step: float) -> Tensor:
    """Points that are too near each other, a little farther apart."""
    count = min(_NEIGHBOURS + 1, points.shape[0])
    distance, index = nearest_rows(points, points, count, step)
    way = points[:, None] - points[index]
    near = (1.0 - distance / (_APART * step)).clamp(min=0.0)
    push = (near / distance.clamp(min=1e-9 * step))[..., None] * way
    return points + _PUSH * _APART * step * push.sum(dim=1)


def _inside(points: Tensor, radius: float, length: float, skin: float) -> Tensor:
    """Points held inside the cylinder, a skin away from its wall."""
    across = points[:, :2].norm(dim=1, keepdim=True)
    widest, highest = max(radius - skin, 0.5 * radius), max(0.5 * length - skin, 0.25 * length)
    held = points[:, :2] * (widest / across.clamp(min=widest))
    return torch.cat([held, points[:, 2:].clamp(-highest, highest)], dim=1)
