"""Matter on the grid: two engines with one face.

:class:`Resident` keeps the points in one :class:`gsfluent.ops.Solver`, which takes many steps per
call. :class:`Composed` takes one step at a time with the composable operators; it is the reference,
and it alone knows colliders that are free bodies, distance grids, or sweep.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.ops import SolverError
from gsfluent.ops import collider as columns
from gsfluent.pipeline.particles import Matter
from gsfluent.pipeline.rigid import RigidSet
from gsfluent.pipeline.simulate_state import State
from gsfluent.scene import Scene

CFL = 0.5
PLATE_STEP = 0.05
"""Way of a moving collider [cells] between two looks at where it is."""
CROWDED = 3
"""Reason of a SolverError: more fields share a block than it has room for."""


class Unhealthy(Exception):
    """The state cannot be advanced.

    Args:
        reason: What is wrong.
        wrong: Points at fault, bool [N], if they are known.
        kind: ``numbers``, ``speed``, ``volume``, ``energy``, ``crowded``, ``far`` or ``step``.
    """

    def __init__(self, reason: str, wrong: Tensor | None = None, kind: str = "numbers") -> None:
        super().__init__(reason)
        self.reason, self.wrong, self.kind = reason, wrong, kind


_KINDS = {1: "numbers", 2: "speed", CROWDED: "crowded", 4: "far", 5: "step"}


@dataclasses.dataclass
class Counters:
    """What the solver did and what it left out."""

    steps: int = 0
    particle_steps: int = 0
    flight_seconds: float = 0.0
    flight_body_steps: int = 0
    contact_steps: int = 0
    contact_nodes: int = 0
    shared_sites: int = 0
    """Most blocks in which several fields met, in any step looked at."""
    block_builds: int = 0
    blocks_max: int = 0
    dt_min: float = float("inf")
    dt_max: float = 0.0
    plastic: int = 0
    guarded: int = 0
    inverted: int = 0
    point_seconds: float = 0.0
    """Simulated seconds of all points together."""
    sleeping_point_seconds: float = 0.0
    flying_point_seconds: float = 0.0
    """Pieces and bodies that went back to flight; first flights are counted apart."""
    naps: int = 0
    wakes: int = 0
    piece_flights: int = 0
    fields_max: int = 1


class Settings(NamedTuple):
    """What an engine needs to know beside the points."""

    cfl: float = CFL
    irreversible: bool = True
    return_map: dict[str, Any] | None = None
    dt_scale: float = 1.0


class Points(NamedTuple):
    """Moving part of the points of an engine; rows are those it was built with."""

    position: Tensor
    velocity: Tensor
    affine: Tensor
    strain: Tensor
    alpha: Tensor
    peak: Tensor
    deformation: Tensor | None


class Engine(Protocol):
    """Points on the grid from a moment on.

    Attributes:
        time: Time reached [s].
        colliders: Rows of the colliders as of ``time``, float64 [M, 32].
        impulse: Impulse of all colliders on the points since the start [N s], float64 [3].
        work: Most energy that colliders can have given since the start [J], float64 [].
    """

    time: float
    colliders: Tensor
    impulse: Tensor
    work: Tensor

    def advance(self, until: float, steps: int) -> int:
        """Advance to a time, but by no more than so many steps; return how many were taken."""

    def read(self) -> Points:
        """The points now."""


def resident_can(rows: Tensor) -> bool:
    """Whether the resident solver knows these colliders: analytic, moving as told, not turning."""
    if rows.shape[0] == 0:
        return True
    turning = rows[:, columns.ANGULAR_VELOCITY : columns.INERTIA].any(dim=1)
    special = rows[:, columns.OFFSET + 1 :].any(dim=1)
    own = (rows[:, columns.MASS] > 0) | (rows[:, columns.SWEEP] > 0) | turning | special
    return not bool((own | (rows[:, columns.TYPE] > columns.TYPES["cylinder"])).any())


class Resident:
    """The resident solver.

    Args:
        scene: Gravity and contact coefficients.
        matter: Constants of the points.
        rigid: The colliders.
        state: Where to start.
        rows: Points on the grid, int64 [M], or None for all.
        settings: See :class:`Settings`.
        counters: Are added to.
    """

    def __init__(
        self,
        scene: Scene,
        matter: Matter,
        rigid: RigidSet,
        state: State,
        rows: Tensor | None,
        settings: Settings,
        counters: Counters,
    ) -> None:
        p = state.particles if rows is None else state.particles.select(rows)
        position, peak, field = (
            value if rows is None else value[rows]
            for value in (state.position, state.peak, state.field)
        )
        used, field = torch.unique(field, return_inverse=True)
        self._solver = _guarded(
            p.velocity,
            lambda: ops.Solver(
                position, p.velocity, p.mass, p.volume,
                dx=matter.dx, law=matter.law, params=matter.params, material=p.material,
                strain=p.strain, alpha=p.alpha, peak=peak, affine=p.affine,
                deformation=p.deformation, body=field.to(torch.int32), gravity=scene.gravity,
                colliders=state.colliders if state.colliders.shape[0] else None,
                friction=scene.friction, restitution=scene.restitution, cfl=settings.cfl,
                irreversible=settings.irreversible, **(settings.return_map or {}),
            ),
        )  # fmt: skip
        self._solver.dt_scale = settings.dt_scale
        self._rigid, self._dx, self._counters = rigid, matter.dx, counters
        self._alpha, self._peak = p.alpha, peak
        self._elastic = not bool(matter.law.any())
        self._start = self.time = state.time
        self.colliders = state.colliders
        self.impulse = torch.zeros(3, dtype=torch.float64, device=p.device)
        self.work = torch.zeros((), dtype=torch.float64, device=p.device)
        self._seen = self._solver.counters()
        counters.fields_max = max(counters.fields_max, used.shape[0])

    def advance(self, until: float, steps: int) -> int:
        """See :class:`Engine`."""
        before = self._seen["step"]
        while self.time < until and self._seen["step"] - before < steps:
            left = steps - int(self._seen["step"] - before)
            speed = float(self._rigid.speed(self.colliders))
            stop = until if speed <= 0 else min(until, self.time + PLATE_STEP * self._dx / speed)
            if until - stop < 0.1 * (stop - self.time):
                stop = until
            self._go(stop, left)
        return int(self._seen["step"] - before)

    def _go(self, stop: float, steps: int) -> None:
        """Advance with the colliders where they are, then move them."""
        solver, before = self._solver, self.time
        target = stop - self._start
        pushed = solver.impulse
        if target > (before - self._start) + 1e-12 * max(1.0, stop):
            try:
                solver.advance(target, steps=steps)
            except SolverError as error:
                kind = _KINDS.get(error.reason, "numbers")
                raise Unhealthy(str(error).split("\n")[0], self._wrong(kind), kind) from error
            reached = solver.time
            self.time = stop if reached >= target else self._start + reached
        else:
            self.time = stop
        self._count()
        given = solver.impulse - pushed
        if given.numel():
            self.impulse = self.impulse + given.sum(dim=0)
            self.work = self.work + self._rigid.work(self.colliders, given, torch.zeros_like(given))
            rows = self._rigid.advance(self.colliders, before, self.time - before)
            if rows is not self.colliders:
                self.colliders = rows
                solver.set_colliders(rows)

    def _wrong(self, kind: str) -> Tensor:
        """The points at fault: not finite, or among the fastest."""
        speed = self._solver.velocity.norm(dim=1)
        bad = ~torch.isfinite(speed) | ~torch.isfinite(self._solver.strain).all(dim=1)
        if kind == "speed" or not bool(bad.any()):
            bad = bad | (speed >= 0.5 * speed[~bad].max()) if bool((~bad).any()) else bad
        return bad

    def _count(self) -> None:
        c, old, new = self._counters, self._seen, self._solver.counters()
        self._seen = new
        names = ("step", "particle_steps", "builds", "contact_steps", "contact_nodes", "plastic",
                 "guarded", "inverted", "invalid")  # fmt: skip
        gone = {name: int(new[name] - old[name]) for name in names}
        c.steps += gone["step"]
        c.particle_steps += gone["particle_steps"]
        c.block_builds += gone["builds"]
        c.contact_steps += gone["contact_steps"]
        c.contact_nodes += gone["contact_nodes"]
        c.plastic += gone["plastic"]
        c.guarded += gone["guarded"]
        c.inverted += gone["inverted"]
        c.shared_sites = max(c.shared_sites, int(new["shared_sites"]))
        c.blocks_max = max(c.blocks_max, int(new["slots_max"]))
        if gone["step"]:
            c.dt_min = min(c.dt_min, new["dt_min"])
            c.dt_max = max(c.dt_max, new["dt_max"])
        if gone["invalid"]:
            raise Unhealthy(f"{gone['invalid']} strains were not finite", self._wrong("numbers"))

    def read(self) -> Points:
        """See :class:`Engine`."""
        s = self._solver
        alpha, peak = (self._alpha, self._peak) if self._elastic else (s.alpha, s.peak)
        return Points(s.position, s.velocity, s.affine, s.strain, alpha, peak, s.deformation)


def _guarded(like: Tensor, make: Any) -> ops.Solver:
    """Make a solver; a state it refuses is unhealthy."""
    try:
        solver: ops.Solver = make()
    except ValueError as error:
        wrong = ~torch.isfinite(like).all(dim=1)
        raise Unhealthy(str(error), wrong if bool(wrong.any()) else None) from error
    return solver
