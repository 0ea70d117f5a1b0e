"""Groups of points that move without the grid: first flights, pieces in flight, sleepers.

A group leaves the grid at a frame and comes back as soon as something that moves is close. What is
decided here is who may leave; :mod:`gsfluent.pipeline.simulate.step` decides when to come back.
"""

from __future__ import annotations

import dataclasses
import math

import torch
from torch import Tensor

from gsfluent.pipeline.colliders.proximity import boxes, proximity_pairs, time_to_meet
from gsfluent.pipeline.colliders.rigid import RigidSet
from gsfluent.pipeline.matter.fragments import components
from gsfluent.pipeline.matter.points import Matter
from gsfluent.pipeline.matter.state import State, kinetic_energy
from gsfluent.pipeline.simulate.flight import Flight

LANDING = 2.0
"""Distance [cells] at which a group is handed to the grid: the reach of the kernel (1.5) plus what
it can move before the next look."""
TAKE_OFF = 4.0
"""Distance [cells] from everything at which a piece may leave the grid."""
VIBRATION = 0.01
"""Largest share of a piece's kinetic energy that may lie in vibration (kinetic and elastic) when it
takes off."""
CALM_FRAMES = 3
"""Frames in a row at rest before a group sleeps."""
CALM = 0.02
"""Speed of rest, in units of sqrt(|gravity| dx): of what a fall through one cell gives."""
TREMBLE = 0.2
"""Speed, in the same units, of what stays in its place and rests all the same: it lifts by a
fiftieth of a cell."""


@dataclasses.dataclass(eq=False)
class Group:
    """Points that move without the grid.

    Args:
        rows: Their rows, int64 [M].
        flight: How they fly; None while they sleep.
        body: Number of the body in its first flight; None for others.
        position: Where sleepers lie [m], float64 [M, 3].
        mass: Their mass [kg].
    """

    rows: Tensor
    flight: Flight | None
    body: int | None
    position: Tensor
    mass: float

    def __post_init__(self) -> None:
        """Find the box of sleepers."""
        low, high = torch.aminmax(self.position, dim=0)
        self._box = low.cpu(), high.cpu()

    def held(self, time: float) -> bool:
        """Whether it waits where it is, to start later."""
        return self.flight is not None and self.flight.held > time

    def speed(self, time: float) -> float:
        """Upper bound of the speed of its points [m/s]."""
        return 0.0 if self.flight is None else self.flight.speed_at(time)

    def bounds(self, time: float) -> tuple[Tensor, Tensor]:
        """A box that holds it."""
        return self._box if self.flight is None else self.flight.bounds_at(time)

    def points(self, time: float) -> Tensor:
        """Positions [m], float64 [M, 3]."""
        return self.position if self.flight is None else self.flight.state_at(time)[1]


def grid_mask(state: State, matter: Matter) -> Tensor:
    """Points on the grid, bool [N]."""
    mask = ~state.loose & (state.group == -1)
    for (a, b), landed in zip(matter.ranges, state.landed, strict=True):
        if not landed:
            mask[a:b] = False
    return mask


def count_calm(
    state: State, on_grid: Tensor, gravity: Tensor, dx: float, frame: float, trembles: bool
) -> State:
    """Count the frames during which points hardly moved.

    Where points are pushed what trembles in one place rests, too: a springy body keeps for seconds
    what lifts it by less than anyone sees.

    Args:
        state: State at a frame.
        on_grid: Points on the grid, bool [N].
        gravity: Acceleration [m/s^2], float64 [3].
        dx: Grid spacing [m].
        frame: Time since they were last counted [s].
        trembles: Whether points are pushed.
    """
    p = state.particles
    unit = float(gravity.norm() * dx) ** 0.5
    speed = p.velocity.norm(dim=1) + dx * torch.linalg.matrix_norm(p.affine)
    moved = (state.position - state.calm_at).norm(dim=1) / frame
    slow = speed < CALM * unit
    if trembles:
        slow |= (moved < CALM * unit) & (speed < TREMBLE * unit)
    calm = torch.where(slow, state.calm + 1, torch.zeros_like(state.calm)).clamp(max=1000)
    return state._replace(calm=torch.where(on_grid, calm, state.calm), calm_at=state.position)


class Leaving:
    """Takes groups off the grid.

    Args:
        matter: The points.
        rigid: The colliders.
        gravity: Acceleration [m/s^2], float64 [3].
        sleep: Whether groups at rest may leave.
        fly: Whether pieces that touch nothing may leave.
    """

    def __init__(
        self, matter: Matter, rigid: RigidSet, gravity: Tensor, *, sleep: bool, fly: bool
    ) -> None:
        self.matter, self.rigid, self.gravity = matter, rigid, gravity
        # Without gravity nothing settles: what is slow stays slow for ever, touching or not.
        self.sleep = sleep and float(gravity.norm()) > 0.0
        self.fly = fly
        self.naps = self.flights = 0

    def __call__(self, state: State, unit: Tensor, frame: float) -> State:
        """Take off the grid what may leave it.

        Args:
            state: State at a frame.
            unit: What each point hangs together with, [N].
            frame: Length of a frame [s].
        """
        rows = grid_mask(state, self.matter).nonzero()[:, 0]
        if rows.numel() == 0 or not (self.sleep or self.fly):
            return state
        ids, label = torch.unique(unit[rows], return_inverse=True)
        position = state.position[rows]
        low, high = boxes(position, label, ids.shape[0])
        calm = torch.full_like(ids, 1 << 30).scatter_reduce(
            0, label, state.calm[rows].long(), "amin"
        )
        calm = (calm >= CALM_FRAMES).cpu()
        gaps = self.rigid.gaps(state.colliders, low, high)
        dx = self.matter.dx
        if self.sleep and bool(calm.any()):
            pairs = proximity_pairs(position, label, LANDING * dx).cpu()
            moving = self.rigid.moving(state.colliders)
            driven = torch.tensor(self.rigid.gaps(moving, low, high)) <= TAKE_OFF * dx
            state = self._nap(state, rows, label, pairs, calm, gaps, driven)
        if self.fly:
            high_up = [i for i, gap in enumerate(gaps) if gap > TAKE_OFF * dx and ids[i] >= 0]
            if high_up and len(high_up) < 200:
                pairs = proximity_pairs(position, label, TAKE_OFF * dx).cpu()
                for i in high_up:
                    if not bool((pairs == i).any()):
                        state = self._take_off(state, rows[label == i], gaps[i], frame)
        return state

    def _nap(
        self,
        state: State,
        rows: Tensor,
        label: Tensor,
        pairs: Tensor,
        calm: Tensor,
        gaps: list[float],
        driven: Tensor,
    ) -> State:
        """Put whole heaps to sleep: all that touch each other, when all of them are calm.

        What lies close to a collider that moves (``driven``, bool per unit) stays awake.
        """
        heap = components(pairs[:, 0], pairs[:, 1], len(gaps))
        held_up = torch.tensor([gap <= LANDING * self.matter.dx for gap in gaps])
        for number in torch.unique(heap).tolist():
            members = heap == number
            if not bool((calm & ~driven)[members].all()) or not bool(held_up[members].any()):
                continue
            state = self._lay_down(state, rows[members.to(label.device)[label]])
        return state

    def _lay_down(self, state: State, rows: Tensor) -> State:
        p = state.particles
        mass = p.mass[rows].double()[:, None]
        # What little momentum was left goes to the floor, that the balance stays whole.
        left = (mass * p.velocity[rows].double()).sum(dim=0)
        energy = kinetic_energy(p.mass[rows], p.velocity[rows], p.affine[rows], self.matter.dx)
        self.naps += 1
        return state._replace(
            particles=p.replace(
                velocity=p.velocity.index_fill(0, rows, 0.0),
                affine=p.affine.index_fill(0, rows, 0.0),
            ),
            impulse=state.impulse - left,
            dissipated=state.dissipated + energy,
            group=state.group.index_fill(0, rows, int(rows.min())),
            asleep=state.asleep.index_fill(0, rows, True),
        )

    def _take_off(self, state: State, rows: Tensor, gap: float, frame: float) -> State:
        """Let a piece fly if it is rigid enough and has room for half a frame."""
        matter, p = self.matter, state.particles
        points = p.select(rows)
        density = matter.stored(points, state.peak[rows])
        stored = (density.double() * points.volume.double()).sum()
        moving = kinetic_energy(points.mass, points.velocity, points.affine, matter.dx)
        # a rigid motion holds no more than all of it, and is not found for nothing
        if not float(stored) <= 1.001 * VIBRATION * float(moving):
            return state
        flight = Flight(
            points, state.position[rows], self.gravity, state.time, matter.dx, rigid=False
        )
        room = gap - LANDING * matter.dx
        if time_to_meet(room, flight.speed_at(state.time), float(self.gravity.norm())) < frame / 2:
            return state
        lost = moving - flight.kinetic
        if not float(lost + stored) <= VIBRATION * flight.kinetic:
            return state
        moved, place = flight.state_at(state.time)
        self.flights += 1
        return state._replace(
            particles=p.replace(
                velocity=p.velocity.index_copy(0, rows, moved.velocity),
                affine=p.affine.index_copy(0, rows, moved.affine),
            ),
            position=state.position.index_copy(0, rows, place),
            dissipated=state.dissipated + lost,
            group=state.group.index_fill(0, rows, int(rows.min())),
        )


def lay_down(state: State, matter: Matter, rigid: RigidSet, gravity: Tensor, unit: Tensor) -> State:
    """Put to sleep at once what does not move and is held up; arguments as of :class:`Leaving`."""
    p = state.particles
    still = (p.velocity == 0).all(dim=1) & (p.affine == 0).all(dim=2).all(dim=1)
    calm = torch.where(still, CALM_FRAMES, state.calm).to(state.calm)
    leaving = Leaving(matter, rigid, gravity, sleep=True, fly=False)
    return leaving(state._replace(calm=calm), unit, math.inf)
