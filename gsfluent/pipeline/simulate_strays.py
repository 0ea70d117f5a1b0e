"""Crumbs that flew far away: points without a grid.

A broken point carries no tension and, alone, no stress at all. When it is far from what is left of
the objects it moves as a free point, so that a few crumbs do not stretch the grid over metres of
empty space (or beyond its limit). It falls, and stays where it meets the floor.
"""

from __future__ import annotations

import torch
from torch import Tensor

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
    position: Tensor,
    velocity: Tensor,
    mass: Tensor,
    rows: Tensor,
    span: float,
    gravity: tuple[float, float, float],
    floor: float | None,
) -> Tensor:
    """Let strays fall, in place; they stay where they meet the floor.

    Args:
        position: Positions of all points [m], float64 [N, 3]; rows of strays are written.
        velocity: Velocities of all points [m/s], [N, 3]; likewise.
        mass: Masses [kg], [N].
        rows: Rows of the strays, int64 [S].
        span: Time [s].
        gravity: Acceleration [m/s^2].
        floor: Height of the floor [m], or None.

    Returns:
        The impulse of the floor on the strays [N s], float64 [3].
    """
    pull = torch.tensor(gravity, dtype=torch.float64, device=position.device)
    start = velocity[rows].double()
    speed = start + span * pull
    place = position[rows] + span * (0.5 * (start + speed))
    impulse = torch.zeros(3, dtype=torch.float64, device=position.device)
    if floor is not None:
        down = place[:, 2] <= floor
        stop = torch.where(down[:, None], speed, torch.zeros_like(speed))
        impulse = -(mass[rows, None].double() * stop).sum(dim=0)
        speed = speed - stop
        place[:, 2] = place[:, 2].clamp(min=floor)
    position[rows] = place
    velocity[rows] = speed.to(velocity)
    return impulse
