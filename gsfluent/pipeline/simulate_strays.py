"""Crumbs that flew far away: points without a grid.

A broken point carries no tension and, alone, no stress at all. When it is far from what is left of
the objects it moves as a free point, so that a few crumbs do not stretch the grid over metres of
empty space (or beyond its limit). It falls, and stays where it meets the floor.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gsfluent.data import Particles
from gsfluent.pipeline.particles import Matter

DISTANCE = 8.0
"""Distance from the middle of the unbroken matter, in extents of the largest body."""


def reach_of(matter: Matter) -> float:
    """Distance [m] beyond which a broken point is a stray."""
    extents = []
    for a, b in matter.ranges:
        low, high = torch.aminmax(matter.rest[a:b], dim=0)
        extents.append(float((high - low).max()))
    return DISTANCE * max(extents)


def find_strays(position: Tensor, peak: Tensor, candidate: Tensor, reach: float) -> Tensor:
    """Tell which candidates are broken and far from the unbroken matter, bool [N].

    Args:
        position: Positions [m], [N, 3].
        peak: Largest alpha so far, [N].
        candidate: Points on the grid, bool [N].
        reach: Distance that counts as far [m].
    """
    whole = candidate & (peak < 0)
    weight = torch.where(whole.any(), whole, candidate).to(position)[:, None]
    middle = (weight * position).sum(dim=0) / weight.sum().clamp(min=1.0)
    far = ((position - middle) ** 2).sum(dim=1) > reach * reach
    return candidate & far & (peak >= 0)


def drift(
    particles: Particles,
    rows: Tensor,
    dt: float,
    gravity: tuple[float, float, float],
    floor: float | None,
) -> tuple[Particles, Tensor]:
    """Move strays by one step, as the grid would move lone points.

    Args:
        particles: All points.
        rows: Rows of the strays, int64 [S].
        dt: Time step [s].
        gravity: Acceleration [m/s^2].
        floor: Height of the floor [m], or None.

    Returns:
        The points, and the impulse of the floor on the strays [N s], float64 [3].
    """
    pull = particles.velocity.new_tensor(gravity)
    velocity = particles.velocity[rows] + dt * pull
    position = particles.position[rows] + dt * velocity
    impulse = torch.zeros(3, dtype=torch.float64, device=position.device)
    if floor is not None:
        down = position[:, 2] <= floor
        stop = torch.where(down[:, None], velocity, torch.zeros_like(velocity))
        impulse = -(particles.mass[rows, None] * stop).to(torch.float64).sum(dim=0)
        velocity = velocity - stop
        position[:, 2] = position[:, 2].clamp(min=floor)
    moved = particles.replace(
        position=particles.position.index_copy(0, rows, position),
        velocity=particles.velocity.index_copy(0, rows, velocity),
        affine=particles.affine.index_fill(0, rows, 0.0),
    )
    return moved, impulse
