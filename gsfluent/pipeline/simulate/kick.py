"""Kicks: a velocity given to all matter of a body at a moment.

A kick is an impulse ``m v`` and an angular impulse ``I w`` about the centre of mass. It belongs to
the state like the impulses of colliders do, so momentum and energy stay accounted for.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gsfluent.pipeline.matter.points import Matter
from gsfluent.pipeline.matter.state import State
from gsfluent.scene.parts import Kick
from gsfluent.scene.scene import Scene


class Kicks:
    """The kicks of a scene in the order of their times.

    Args:
        scene: The scene.
        matter: The points.
    """

    def __init__(self, scene: Scene, matter: Matter) -> None:
        self.matter = matter
        self.kicks = sorted(scene.kicks, key=lambda kick: kick.start)

    def next_change(self, state: State) -> float:
        """Time of the next kick [s], or infinity."""
        return self.kicks[state.kicked].start if state.kicked < len(self.kicks) else math.inf

    def given(self, state: State) -> State:
        """The state after all kicks that are due."""
        while self.next_change(state) <= state.time:
            state = _kicked(state, self.matter, self.kicks[state.kicked])
        return state


def _kicked(state: State, matter: Matter, kick: Kick) -> State:
    """Kick the matter of one body that has not been left behind as crumbs; it wakes and lands."""
    p, device = state.particles, state.position.device
    start, end = matter.ranges[kick.body]
    mine = torch.zeros_like(state.stray)
    mine[start:end] = True
    rows = (mine & ~state.stray).nonzero()[:, 0]
    # Sleepers and flights leave the grid as whole heaps, which may hold other bodies' matter.
    called = torch.unique(state.group[rows])
    woken = torch.isin(state.group, called[called >= 0])
    mass = p.mass[rows].double()[:, None]
    place = state.position[rows]
    center = (mass * place).sum(dim=0) / mass.sum().clamp(min=1e-300)
    wx, wy, wz = kick.spin
    turn = torch.tensor([[0, -wz, wy], [wz, 0, -wx], [-wy, wx, 0]], dtype=torch.float64)
    turn = turn.to(device)
    push = torch.tensor(kick.velocity, dtype=torch.float64, device=device)
    velocity = p.velocity.index_add(0, rows, (push + (place - center) @ turn.T).to(p.velocity))
    affine = p.affine.index_add(0, rows, turn.to(p.affine).expand(rows.shape[0], 3, 3).contiguous())
    given = mass * (velocity[rows].double() - p.velocity[rows].double())
    gained = _kinetic(mass, velocity[rows], affine[rows], matter.dx)
    gained = gained - _kinetic(mass, p.velocity[rows], p.affine[rows], matter.dx)
    landed = list(state.landed)
    landed[kick.body] = True
    return state._replace(
        particles=p.replace(velocity=velocity, affine=affine),
        impulse=state.impulse + given.sum(dim=0),
        work=state.work + gained.clamp(min=0.0),
        landed=tuple(landed),
        group=state.group.masked_fill(woken, -1),
        asleep=state.asleep & ~woken,
        calm=state.calm.masked_fill(woken | mine, 0),
        kicked=state.kicked + 1,
    )


def _kinetic(mass: Tensor, velocity: Tensor, affine: Tensor, dx: float) -> Tensor:
    """Kinetic energy with the APIC part [J], float64 []; mass is [M, 1]."""
    squared = (velocity.double() ** 2).sum(dim=1)
    squared = squared + 0.25 * dx * dx * (affine.double() ** 2).sum(dim=(1, 2))
    return 0.5 * (mass[:, 0] * squared).sum()
