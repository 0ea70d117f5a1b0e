"""Liquid that has not left its nozzle yet: it moves with one velocity, without the grid.

A pour is a column behind its nozzle. What waits in it is out of gravity's reach, so that the jet
leaves the nozzle at one speed for as long as it flows; at every look (:mod:`.looks`) a slice that
has passed the nozzle goes to the grid.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gsfluent.pipeline.matter.points import Matter
from gsfluent.pipeline.matter.state import State
from gsfluent.scene.scene import Body, Scene

WAITING = torch.iinfo(torch.int32).min
"""``State.group`` of what waits in a nozzle."""


def pours(body: Body) -> bool:
    """Whether a body is a jet of liquid that leaves a nozzle, and no pool, which stands."""
    flows = body.material.law == "fluid"
    return flows and body.held and body.length > 0.0 and math.hypot(*body.velocity) > 0.0


def release_times(scene: Scene, matter: Matter, tick: float) -> Tensor:
    """When the points leave their nozzles: the first look at which they are past them.

    Args:
        scene: The scene.
        matter: Its points.
        tick: Time between two looks [s].

    Returns:
        Times [s], float64 [N], whole numbers of ticks; -inf for all that is poured by no nozzle.
    """
    times = torch.full((matter.particles.count,), -math.inf, dtype=torch.float64)
    for body, (a, b) in zip(scene.bodies, matter.ranges, strict=True):
        if not pours(body):
            continue
        way = torch.tensor(body.axis, dtype=torch.float64)
        middle = torch.tensor(body.offset, dtype=torch.float64)
        speed = math.hypot(*body.velocity)
        behind = 0.5 * body.length - (matter.rest[a:b].cpu().double() - middle) @ way
        when = body.start + behind.clamp(min=0.0) / speed
        times[a:b] = torch.ceil(when / tick - 1e-9) * tick
    return times.to(matter.particles.device)


def waiting(state: State, release: Tensor) -> State:
    """A state in which all that is still behind its nozzle waits there."""
    behind = (release > state.time) & (state.group == -1)
    if not bool(behind.any()):
        return state
    return state._replace(group=state.group.masked_fill(behind, WAITING))


def held_weights(release: Tensor, mass: Tensor) -> list[tuple[float, float]]:
    """Masses [kg] and the times [s] until which gravity does not pull them."""
    poured = torch.isfinite(release)
    times, place = torch.unique(release[poured].cpu(), return_inverse=True)
    weight = torch.zeros_like(times).index_add_(0, place, mass[poured].cpu().double())
    return list(zip(weight.tolist(), times.tolist(), strict=True))
