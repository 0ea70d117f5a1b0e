"""Impulses: a velocity given to all matter of a body at a moment.

An impulse here is ``m v`` and ``I w`` about the centre of mass. It belongs to
the state like the impulses of colliders do, so momentum and energy stay accounted for.
"""

from __future__ import annotations

import math

import torch

from gsfluent.pipeline.matter.points import Matter
from gsfluent.pipeline.matter.state import State, kinetic_energy
from gsfluent.scene.parts import Impulse
from gsfluent.scene.scene import Scene


class Impulses:
    """The impulses of a scene in the order of their times.

    Args:
        scene: The scene.
        matter: The points.
    """

    def __init__(self, scene: Scene, matter: Matter) -> None:
        self.matter = matter
        self.impulses = sorted(scene.impulses, key=lambda push: push.start)

    def next_change(self, state: State) -> float:
        """Time of the next impulse [s], or infinity."""
        return self.impulses[state.pushed].start if state.pushed < len(self.impulses) else math.inf

    def given(self, state: State) -> State:
        """The state after all impulses that are due."""
        while self.next_change(state) <= state.time:
            state = _pushed(state, self.matter, self.impulses[state.pushed])
        return state


def _pushed(state: State, matter: Matter, push: Impulse) -> State:
    """Push the matter of one body that has not been left behind as debris; it wakes and lands."""
    p, device = state.particles, state.position.device
    start, end = matter.ranges[push.body]
    mine = torch.zeros_like(state.loose)
    mine[start:end] = True
    rows = (mine & ~state.loose & (state.group >= -1)).nonzero()[:, 0]
    # Sleepers and flights leave the grid as whole heaps, which may hold other bodies' matter.
    called = torch.unique(state.group[rows])
    woken = torch.isin(state.group, called[called >= 0])
    mass = p.mass[rows].double()[:, None]
    place = state.position[rows]
    center = (mass * place).sum(dim=0) / mass.sum().clamp(min=1e-300)
    wx, wy, wz = push.spin
    turn = torch.tensor([[0, -wz, wy], [wz, 0, -wx], [-wy, wx, 0]], dtype=torch.float64)
    turn = turn.to(device)
    gain = torch.tensor(push.velocity, dtype=torch.float64, device=device)
    velocity = p.velocity.index_add(0, rows, (gain + (place - center) @ turn.T).to(p.velocity))
    affine = p.affine.index_add(0, rows, turn.to(p.affine).expand(rows.shape[0], 3, 3).contiguous())
    given = mass * (velocity[rows].double() - p.velocity[rows].double())
    gained = kinetic_energy(mass[:, 0], velocity[rows], affine[rows], matter.dx)
    gained = gained - kinetic_energy(mass[:, 0], p.velocity[rows], p.affine[rows], matter.dx)
    landed = list(state.landed)
    landed[push.body] = True
    return state._replace(
        particles=p.replace(velocity=velocity, affine=affine),
        impulse=state.impulse + given.sum(dim=0),
        work=state.work + gained.clamp(min=0.0),
        landed=tuple(landed),
        group=state.group.masked_fill(woken, -1),
        asleep=state.asleep & ~woken,
        calm=state.calm.masked_fill(woken | mine, 0),
        pushed=state.pushed + 1,
    )
