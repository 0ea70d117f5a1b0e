"""Debris that flew far away: points without a grid.

A broken point carries no tension and, alone, no stress at all. When it is far from what is left of
the objects it moves as a free point, so that a few of them do not stretch the grid over metres of
empty space (or beyond its limit). It falls, and stays where it meets the floor.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gsfluent.pipeline.matter.points import Matter
from gsfluent.pipeline.matter.state import State

LONELY = 48
"""Points in 216 cells, of 1728 in whole matter, below which broken ones are alone."""
DISTANCE = 8.0
"""Distance from the middle of the unbroken matter, in extents of the largest body."""


def reach_of(matter: Matter) -> float:
    """Distance [m] beyond which a broken point is loose."""
    extents = []
    for a, b in matter.ranges:
        low, high = torch.aminmax(matter.rest[a:b], dim=0)
        extents.append(float((high - low).max()))
    return DISTANCE * max(extents)


def find_far(position: Tensor, peak: Tensor, candidate: Tensor, reach: float) -> Tensor:
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


def let_go(state: State, debris: Tensor) -> State:
    """The state in which these points [N] are loose, without a strain."""
    p = state.particles
    return state._replace(
        particles=p.replace(strain=p.strain.masked_fill(debris[:, None], 0.0)),
        loose=state.loose | debris,
    )


def find_loose(position: Tensor, peak: Tensor, candidate: Tensor, dx: float) -> Tensor:
    """Tell which candidates are broken and have next to nothing around them, bool [N].

    Less than :data:`LONELY` points, none of them unbroken, in the 3^3 cubes of two cells around
    them: a density at which nothing of a solid's mechanics is left.

    Args:
        position: Positions [m], [N, 3].
        peak: Largest alpha so far, [N].
        candidate: Points on the grid, bool [N].
        dx: Grid spacing [m].
    """
    rows = candidate.nonzero()[:, 0]
    lonely = torch.zeros_like(candidate)
    if rows.numel() == 0:
        return lonely
    cube = torch.floor(position[rows] / (2.0 * dx)).to(torch.int64)
    cube = cube - cube.amin(dim=0) + 1
    wide = cube.amax(dim=0) + 2
    key = (cube[:, 0] * wide[1] + cube[:, 1]) * wide[2] + cube[:, 2]
    cubes, home, counts = torch.unique(key, return_inverse=True, return_counts=True)
    whole = torch.zeros_like(cubes).index_add_(0, home, (peak[rows] < 0).long())
    counts = counts + LONELY * whole
    step = torch.tensor([-1, 0, 1], device=key.device)
    star = ((step[:, None, None] * wide[1] + step[:, None]) * wide[2] + step).flatten()
    wanted = cubes + star[:, None]
    at = torch.searchsorted(cubes, wanted).clamp(max=cubes.shape[0] - 1)
    around = torch.where(cubes[at] == wanted, counts[at], 0).sum(dim=0)
    lonely[rows] = (around < LONELY)[home]
    return lonely


def drift(
    position: Tensor,
    velocity: Tensor,
    mass: Tensor,
    rows: Tensor,
    span: float,
    gravity: tuple[float, float, float],
    floor: float | None,
) -> Tensor:
    """Let loose debris fall, in place; they stay where they meet the floor.

    Args:
        position: Positions of all points [m], float64 [N, 3]; rows of debris are written.
        velocity: Velocities of all points [m/s], [N, 3]; likewise.
        mass: Masses [kg], [N].
        rows: Rows of the debris, int64 [S].
        span: Time [s].
        gravity: Acceleration [m/s^2].
        floor: Height of the floor [m], or None.

    Returns:
        The impulse of the floor on the debris [N s], float64 [3].
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
