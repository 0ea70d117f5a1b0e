"""Matter on the grid: two engines with one face.

:class:`Resident` keeps the points in one :class:`gsfluent.ops.Solver`, which takes many steps per
call. :class:`gsfluent.pipeline.simulate.composed.Composed` takes one step at a time with the
composable operators; it is the reference, and it alone knows blades at work and light free bodies.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.materials import LAWS
from gsfluent.ops import SolverError
from gsfluent.ops import collider as columns
from gsfluent.pipeline.colliders.rigid import RigidSet
from gsfluent.pipeline.matter.points import Matter
from gsfluent.pipeline.matter.state import State, at_rows
from gsfluent.pipeline.simulate.engine import Counters, Points, SolverOptions, Unhealthy
from gsfluent.scene.scene import Scene

FLOOR_DEPTH = 0.05
"""How far [cells] a free body may sink into the floor before it is put back."""
CROWDED = 3
"""Reason of a SolverError: more fields share a block than it has room for."""


LOOK = 8
"""Steps between two looks at how fast matter is, while a collider is much faster."""
STEADY = 0.9
"""Factor on the time step above which that need not be."""
OUTWEIGHS = 0.5
"""Least mass of a free body for the resident solver, in masses of the matter that it can touch:
what it strikes first lies on one side of it."""


_COUNTED = {"step": "steps", "builds": "block_builds"}
_SUMS = ("particle_steps", "contact_steps", "contact_nodes", "plastic", "guarded", "inverted")
"""What the solver counts: under another name in :class:`Counters`, and under its own."""
_KINDS = {1: "numbers", 2: "speed", CROWDED: "crowded", 4: "far", 5: "step"}


def resident_can(rows: Tensor, rigid: RigidSet, matter: Matter) -> bool:
    """Whether the resident solver moves these colliders as they should move.

    It shares an impact between a free body and the nodes by the mass that the body touched a step
    ago, the composed operators by the mass it touches now. At a first touch that is nothing: the
    nodes get the body's whole velocity, and a body lighter than they are would be thrown back
    faster than it came. So a free body must outweigh what it can touch.

    Args:
        rows: Rows of the colliders, float64 [M, 32].
        rigid: The colliders.
        matter: The points, for the heaviest density and the grid spacing.
    """
    if not rigid.frees:
        return True
    mass = rows[:, columns.MASS]
    touched = float(matter.params[:, 6].max()) * rigid.touchable(rows)
    return bool(((mass >= OUTWEIGHS * touched) | (mass == 0.0)).all())  # 0: standing, or waiting


class Resident:
    """The resident solver.

    Args:
        scene: Gravity and contact coefficients.
        matter: Constants of the points.
        rigid: The colliders.
        state: Where to start.
        rows: Points on the grid, int64 [M], or None for all.
        options: How.
        dt_scale: Factor on the automatic time step.
        counters: Are added to.
    """

    def __init__(
        self,
        scene: Scene,
        matter: Matter,
        rigid: RigidSet,
        state: State,
        rows: Tensor | None,
        options: SolverOptions,
        dt_scale: float,
        counters: Counters,
    ) -> None:
        p = state.particles if rows is None else state.particles.select(rows)
        position, peak, field = (
            at_rows(value, rows) for value in (state.position, state.peak, state.field)
        )
        used, field = torch.unique(field, return_inverse=True)
        law, params = matter.law, matter.params
        if not options.law_kernels:  # a row that no point has asks for the kernel of all laws
            law = torch.cat([law, law.new_tensor([LAWS["fluid"]])])
            spare = params[:1].clone()
            spare[:, 7] = 0.0  # there a loss of nacc, which is no exponent of a fluid
            params = torch.cat([params, spare])
        self._special = options.law_kernels and set(law.tolist()) <= {
            LAWS["elastic"],
            LAWS["nacc"],
        }
        self._damage = not set(law.tolist()) <= {LAWS["elastic"]}  # as the solver decides it
        self._solver = _guarded(
            p.velocity,
            lambda: ops.Solver(
                position, p.velocity, p.mass, p.volume,
                dx=matter.dx, law=law, params=params, material=p.material,
                strain=p.strain, alpha=p.alpha, peak=peak, affine=p.affine,
                deformation=p.deformation, body=field.to(torch.int32), gravity=scene.gravity,
                colliders=state.colliders if state.colliders.shape[0] else None, sdf=rigid.sdf,
                friction=scene.friction, cfl=options.cfl,
                irreversible=options.irreversible, **options.return_map,
            ),
        )  # fmt: skip
        self._rigid, self._matter, self._counters = rigid, matter, counters
        self._dt_scale = dt_scale
        self._material = p.material
        self._start = self.time = state.time
        self.colliders = state.colliders
        self.impulse = torch.zeros(3, dtype=torch.float64, device=p.device)
        self.work = torch.zeros((), dtype=torch.float64, device=p.device)
        self.given = self.work.new_zeros(len(rigid.grips), 6)
        self._seen = self._solver.counters()
        self._where: Tensor | None = None
        counters.fields_max = max(counters.fields_max, used.shape[0])

    def advance(self, until: float, steps: int) -> int:
        """See :class:`Engine`."""
        before = self._seen["step"]
        depth = FLOOR_DEPTH * self._matter.dx
        while self.time < until and self._seen["step"] - before < steps:
            pace = self._pace()
            self._solver.dt_scale = self._dt_scale * pace
            wait = self._rigid.floor_wait(self.colliders, depth)
            left = steps - int(self._seen["step"] - before)
            self._go(min(until, self.time + wait), left if pace > STEADY else min(left, LOOK))
        taken, counters = int(self._seen["step"] - before), self._counters
        sites = int(self._seen["sites"])
        counters.law_kernel_steps += taken if self._special else 0
        counters.undamaged_steps += 0 if self._damage else taken
        counters.block_steps += taken * sites
        counters.contact_block_steps += taken * int(self._seen["shared_sites"])
        counters.box_steps += taken * max(sites, _box(self._position(), self._matter.dx))
        return taken

    @property
    def blocks(self) -> int:
        """Blocks of the grid in use."""
        return int(self._seen["sites"])

    def _position(self) -> Tensor:
        """Where the points are; asked for twice between two advances, put in order once."""
        if self._where is None:
            self._where = self._solver.position
        return self._where

    def _pace(self) -> float:
        """Factor on the time step: what drives matter may be faster than any of it yet."""
        driven = float(self._rigid.speed(self.colliders))
        if driven == 0.0:
            return 1.0
        matter, solver = self._matter, self._solver
        wave = ops.wave_speed(
            solver.strain, law=matter.law, params=matter.params, material=self._material
        )
        speed, fastest = float(solver.velocity.norm(dim=1).max()), float(wave.max())
        return (fastest + speed) / (fastest + max(speed, driven)) if fastest + speed > 0 else 1.0

    def _go(self, stop: float, steps: int) -> None:
        """Advance; the solver moves the colliders, all but for floor and schedule."""
        solver, target = self._solver, stop - self._start
        pushed, twisted = solver.impulse, solver.torque
        self._where = None
        if target > (self.time - self._start) + 1e-12 * max(1.0, stop):
            try:
                solver.advance(target, steps=steps)
            except SolverError as error:
                kind = _KINDS.get(error.reason, "numbers")
                what = str(error).split("\n")[0].split(": ", 2)[-1]  # its time is its own
                time = self._start + error.time
                raise Unhealthy(what, self._wrong(kind), kind, time) from error
            reached = solver.time
            self.time = stop if reached >= target else self._start + reached
        else:
            self.time = stop
        self._count()
        if not self._rigid.count:
            return
        given, turned = solver.impulse - pushed, solver.torque - twisted
        moved = solver.colliders
        self.impulse = self.impulse + given.sum(dim=0)
        if grips := self._rigid.grips:
            self.given = self.given + torch.cat([given, turned], dim=1)[grips]
        self.work = self.work + self._rigid.work_between(self.colliders, moved, given, turned)
        self.colliders = self._rigid.settled(moved, self.time)
        if not torch.equal(self.colliders, moved):
            solver.set_colliders(self.colliders)

    def _wrong(self, kind: str) -> Tensor:
        """The points at fault: not finite, among the fastest, or where most fields meet."""
        if kind == "crowded":
            return _most_crowded(self._position(), self._solver.body, self._matter.dx)
        speed = self._solver.velocity.norm(dim=1)
        bad = ~torch.isfinite(speed) | ~torch.isfinite(self._solver.strain).all(dim=1)
        if kind == "speed" or not bool(bad.any()):
            bad = bad | (speed >= 0.5 * speed[~bad].max()) if bool((~bad).any()) else bad
        return bad

    def _count(self) -> None:
        c, old, new = self._counters, self._seen, self._solver.counters()
        self._seen = new
        gone = {name: int(new[name] - old[name]) for name in ("invalid", *_COUNTED, *_SUMS)}
        for name, total in (*_COUNTED.items(), *zip(_SUMS, _SUMS, strict=True)):
            setattr(c, total, getattr(c, total) + gone[name])
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
        return Points(
            self._position(), s.velocity, s.affine, s.strain, s.alpha, s.peak, s.deformation
        )


def _most_crowded(position: Tensor, field: Tensor, dx: float) -> Tensor:
    """Points of the block of the grid that holds points of most fields, bool [N]."""
    block = torch.floor(position / (4.0 * dx) - 0.125).long()
    _, home = torch.unique(block, dim=0, return_inverse=True)
    pairs = torch.unique(torch.stack([home, field.long()], dim=1), dim=0)
    return home == torch.bincount(pairs[:, 0]).argmax()


def _box(position: Tensor, dx: float) -> int:
    """Blocks of the box around all nodes that points reach, a cell of slack on each side."""
    cell = torch.floor(torch.stack(torch.aminmax(position, dim=0)) / dx - 0.5)
    low, high = torch.floor((cell[0] - 1.0) / 4.0), torch.floor((cell[1] + 3.0) / 4.0)
    return int((high - low + 1.0).prod())


def _guarded(like: Tensor, make: Any) -> ops.Solver:
    """Make a solver; a state it refuses is unhealthy."""
    try:
        solver: ops.Solver = make()
    except ValueError as error:
        wrong = ~torch.isfinite(like).all(dim=1)
        raise Unhealthy(str(error), wrong if bool(wrong.any()) else None) from error
    return solver
