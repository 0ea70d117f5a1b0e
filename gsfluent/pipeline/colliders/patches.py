"""Shapes as flat splats that end where the shape ends: props are drawn with clean edges.

A splat reaches beyond its middle, so that a face of even splats has a rim of fuzz as wide as one of
them. Cells here get narrower towards every edge, down to :data:`FINEST` of the longest side.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

FINEST = 1.0 / 500.0
"""Narrowest cell, at an edge, over the longest side."""
_WIDEST = 1.0 / 8.0
_GROWTH = 1.5
# Standard deviations per cell: neighbours of unlike width leave no chinks.
_COVER = 0.7
_THICK = 0.08
_AROUND = 96  # splats around a cylinder
_BALL = 3000
_GOLDEN = math.pi * (3.0 - math.sqrt(5.0))


class Patches(NamedTuple):
    """Flat splats in float64.

    Attributes:
        points: Middles [m], [P, 3].
        turn: Rotations [P, 3, 3]: columns are two axes along the surface and the outward normal.
        sizes: Standard deviations along those axes [m], [P, 3].
    """

    points: Tensor
    turn: Tensor
    sizes: Tensor

    def moved(self, turn: Tensor, by: Tensor) -> Patches:
        """Turned by a rotation [3, 3], then moved by [3]."""
        return Patches(self.points @ turn.T + by, turn @ self.turn, self.sizes)


def joined(parts: list[Patches]) -> Patches:
    """All of them; at least one."""
    return Patches(*(torch.cat(columns) for columns in zip(*parts, strict=True)))


def rectangle(half: tuple[float, float], finest: float) -> Patches:
    """A rectangle in the plane z = 0 whose narrowest cells are ``finest`` wide [m]."""
    (a, wide), (b, high) = (_graded(side, finest) for side in half)
    x, y = (part.reshape(-1) for part in torch.meshgrid(a, b, indexing="ij"))
    w, h = (part.reshape(-1) for part in torch.meshgrid(wide, high, indexing="ij"))
    points = torch.stack([x, y, torch.zeros_like(x)], 1)
    turn = torch.eye(3, dtype=torch.float64).expand(len(x), 3, 3)
    return Patches(points, turn, _sizes(w, h))


def box(half: tuple[float, float, float]) -> Patches:
    """A box of half edges [m] around the origin."""
    finest = 2.0 * max(half) * FINEST
    unit = torch.eye(3, dtype=torch.float64)
    faces = []
    for axis in range(3):
        a, b = (axis + 1) % 3, (axis + 2) % 3
        face = rectangle((half[a], half[b]), finest)
        for sign in (1.0, -1.0):
            turn = torch.stack([unit[a], sign * unit[b], sign * unit[axis]], 1)
            faces.append(face.moved(turn, sign * half[axis] * unit[axis]))
    return joined(faces)


def sphere(radius: float) -> Patches:
    """A sphere around the origin."""
    row = torch.arange(_BALL, dtype=torch.float64) + 0.5
    z = 1.0 - 2.0 * row / _BALL
    ring = (1.0 - z * z).sqrt()
    out = torch.stack([ring * (row * _GOLDEN).cos(), ring * (row * _GOLDEN).sin(), z], 1)
    cell = torch.full_like(row, radius * math.sqrt(4.0 * math.pi / _BALL))
    return Patches(radius * out, upright(out), _sizes(cell, cell))


def cylinder(radius: float, half: float) -> Patches:
    """A cylinder of half length [m] along z around the origin."""
    finest = 2.0 * max(radius, half) * FINEST
    angle = torch.arange(_AROUND, dtype=torch.float64) * (2.0 * math.pi / _AROUND)
    arc = 2.0 * math.pi / _AROUND
    z, high = _graded(half, finest)
    turned, height = (part.reshape(-1) for part in torch.meshgrid(angle, z, indexing="ij"))
    out = torch.stack([turned.cos(), turned.sin(), torch.zeros_like(turned)], 1)
    along = torch.zeros_like(out)
    along[:, 2] = 1.0
    side = torch.stack([torch.linalg.cross(along, out), along, out], 2)
    points = radius * out + height[:, None] * along
    wide = torch.full_like(height, arc * radius)
    parts = [Patches(points, side, _sizes(wide, high.repeat(_AROUND)))]
    # the rings of a cap: cells from the middle outward, narrow at the rim
    ring, deep = _graded(radius, finest)
    ring, deep = ring[ring > 0.0], deep[ring > 0.0]
    turned, r = (part.reshape(-1) for part in torch.meshgrid(angle, ring, indexing="ij"))
    out = torch.stack([turned.cos(), turned.sin(), torch.zeros_like(turned)], 1)
    for sign in (1.0, -1.0):
        up = sign * torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand_as(out)
        cap = torch.stack([out, torch.linalg.cross(up, out), up], 2)
        points = r[:, None] * out + half * up
        parts.append(Patches(points, cap, _sizes(deep.repeat(_AROUND), arc * r)))
    return joined(parts)


def upright(normal: Tensor) -> Tensor:
    """Rotations [P, 3, 3] whose third column is a unit normal [P, 3]."""
    helper = torch.zeros_like(normal)
    steep = normal[:, 2].abs() > 0.9
    helper[:, 0], helper[:, 2] = steep.to(normal), (~steep).to(normal)
    u = torch.nn.functional.normalize(torch.linalg.cross(helper, normal), dim=1)
    return torch.stack([u, torch.linalg.cross(normal, u), normal], 2)


def _graded(half: float, finest: float) -> tuple[Tensor, Tensor]:
    """Middles and widths of cells from -half to half, narrowest at both ends."""
    widths, left, wide = [], half, min(finest, 0.5 * half)
    while wide < 2.0 * half * _WIDEST and wide < 0.5 * left:
        widths.append(wide)
        left -= wide
        wide *= _GROWTH
    count = max(1, math.ceil(2.0 * left / wide))
    edge = torch.tensor(widths, dtype=torch.float64)
    inner = torch.full((count,), 2.0 * left / count, dtype=torch.float64)
    cells = torch.cat([edge, inner, edge.flip(0)])
    return cells.cumsum(0) - 0.5 * cells - half, cells


def _sizes(a: Tensor, b: Tensor) -> Tensor:
    """Standard deviations of flat splats in cells of sides a and b [P]."""
    return torch.stack([_COVER * a, _COVER * b, _THICK * torch.minimum(a, b)], 1)
