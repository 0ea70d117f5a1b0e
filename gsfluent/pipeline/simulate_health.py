"""Health of a running simulation: checks, checkpoints, roll-backs, and the momentum ledger."""

from __future__ import annotations

import collections
import logging
from collections.abc import Sequence

import torch

from gsfluent.pipeline.particles import Matter
from gsfluent.pipeline.simulate_figures import Figures, measure
from gsfluent.pipeline.simulate_step import State, Stepper

_log = logging.getLogger(__name__)

CHECK_EVERY = 40
"""Grid steps between two checks."""
VOLUME_RATIO = (0.02, 50.0)
"""Bounds of the volume ratio J; the return map's own guard keeps J inside [0.05, 20]."""
ENERGY_SLACK = 0.05
"""How far mechanical energy may rise above its start, in units of the largest kinetic plus elastic
energy so far. Contact and breaking only take energy away."""
RING = 3
RECOVERY = 10
"""Good checks after which a halved time step is doubled again."""


def figures_of(matter: Matter, state: State, gravity: tuple[float, float, float]) -> Figures:
    """Measure one state; flying bodies must have been brought to its time."""
    p = state.particles
    return measure(matter, p.position, p.velocity, p.affine, p.strain, state.peak, gravity)


class Watch:
    """Decides whether a state is sound, keeps the last good ones, and rolls back.

    Args:
        matter: The points.
        gravity: Acceleration [m/s^2].
        start: Figures at time 0.
        max_rollbacks: Roll-backs in a row, without a good check in between, before giving up.
    """

    def __init__(
        self,
        matter: Matter,
        gravity: tuple[float, float, float],
        start: Figures,
        *,
        max_rollbacks: int = 6,
    ) -> None:
        self.matter, self.gravity = matter, gravity
        self.energy = start.total
        self.scale = start.kinetic + start.elastic
        self.max_rollbacks = max_rollbacks
        self.rollbacks = 0
        self.in_a_row = 0
        self.good_in_a_row = 0
        self.reasons: list[str] = []
        self._ring: collections.deque[State] = collections.deque(maxlen=RING)

    def keep(self, state: State, *, only: bool = False) -> None:
        """Remember a good state; ``only`` forgets the others (a frame has been handed out)."""
        if only:
            self._ring.clear()
        self._ring.append(state)

    def check(self, state: State, stepper: Stepper) -> str:
        """Return why the state is bad, or an empty string; a good state is kept."""
        reason = self._judge(stepper.whole(state), stepper)
        if reason:
            return reason
        self.keep(state)
        self.in_a_row = 0
        self.good_in_a_row += 1
        if stepper.dt_scale < 1.0 and self.good_in_a_row >= RECOVERY:
            stepper.dt_scale = min(1.0, 2.0 * stepper.dt_scale)
            self.good_in_a_row = 0
        return ""

    def _judge(self, state: State, stepper: Stepper) -> str:
        lost = int(stepper.lost)
        if lost:
            return f"{lost} points were not finite or left the grid"
        now = figures_of(self.matter, state, self.gravity)
        if now.non_finite:
            return f"{now.non_finite} points are not finite"
        low, high = _volume_ratio(state)
        if not (low >= VOLUME_RATIO[0] and high <= VOLUME_RATIO[1]):
            return f"volume ratio between {low:.3g} and {high:.3g}"
        # Height at which gravity's energy is counted is arbitrary, so only its change matters.
        given = self.energy + float(state.work)
        self.scale = max(self.scale, min(now.kinetic + now.elastic, max(given - now.gravity, 0.0)))
        excess = now.total - given
        if not excess <= ENERGY_SLACK * self.scale + 1e-9:
            return f"energy rose by {excess:.3g} J over the {given:.3g} J it had and was given"
        return ""

    def roll_back(self, reason: str, state: State, stepper: Stepper) -> State | None:
        """Return the state to go on from with half the time step, or None to give up."""
        self.good_in_a_row = 0
        where = f"t = {state.time:.6g} s, step {state.step}: {reason}"
        self.reasons.append(where)
        if self.in_a_row >= self.max_rollbacks:
            return None
        self.rollbacks += 1
        self.in_a_row += 1
        # Each further failure in a row goes one checkpoint further back.
        if self.in_a_row > 1 and len(self._ring) > 1:
            self._ring.pop()
        stepper.reset()
        stepper.dt_scale *= 0.5
        _log.warning("rolled back: %s; time step scale %.3g", where, stepper.dt_scale)
        return self._ring[-1]

    def state(self) -> dict[str, float | int]:
        """Return what a resumed run needs."""
        return {"energy": self.energy, "scale": self.scale, "rollbacks": self.rollbacks}

    def restore(self, values: dict[str, float | int]) -> None:
        """Inverse of :meth:`state`."""
        self.energy, self.scale = float(values["energy"]), float(values["scale"])
        self.rollbacks = int(values["rollbacks"])


class Ledger:
    """Momentum balance: ``P(t) = P(0) + M g t + impulses of the colliders``, in float64.

    Args:
        matter: The points at time 0.
        gravity: Acceleration [m/s^2].
        start: Figures at time 0.
        held: Time [s] until which each body waits, outside gravity's reach.
    """

    def __init__(
        self,
        matter: Matter,
        gravity: tuple[float, float, float],
        start: Figures,
        held: Sequence[float] = (),
    ) -> None:
        self.held = [
            (float(matter.particles.mass[a:b].to(torch.float64).sum()), time)
            for (a, b), time in zip(matter.ranges, held, strict=False)
            if time > 0.0
        ]
        self.mass = float(matter.particles.mass.to(torch.float64).sum())
        self.start = torch.tensor(start.momentum, dtype=torch.float64)
        self.gravity = torch.tensor(gravity, dtype=torch.float64)
        self.worst = 0.0
        # Two bodies thrown at each other have no momentum together, but a scale of it.
        self.scale = max(float(self.start.norm()), (2.0 * self.mass * start.kinetic) ** 0.5)

    def error(self, state: State, now: Figures) -> float:
        """Return the relative error of the balance at this moment.

        It is relative to the largest momentum or impulse that the run has seen so far.
        """
        waited = sum(mass * min(time, state.time) for mass, time in self.held)
        pull = self.gravity * (self.mass * state.time - waited)
        push = state.impulse.cpu()
        momentum = torch.tensor(now.momentum, dtype=torch.float64)
        self.scale = max(self.scale, *(float(v.norm()) for v in (momentum, pull, push)))
        residual = float((momentum - self.start - pull - push).norm())
        error = residual / self.scale if self.scale > 0 else 0.0
        self.worst = max(self.worst, error)
        return error


def _volume_ratio(state: State) -> tuple[float, float]:
    """Smallest and largest elastic volume ratio J of all points."""
    strain = state.particles.strain.to(torch.float64)
    xx, yy, zz, xy, xz, yz = (strain + strain.new_tensor([1, 1, 1, 0, 0, 0])).unbind(-1)
    squared = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    low, high = torch.aminmax(squared.clamp(min=0.0).sqrt())
    return float(low), float(high)
