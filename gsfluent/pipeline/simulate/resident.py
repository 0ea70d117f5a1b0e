"""Matter on the grid: two engines with one face.

:class:`Resident` keeps the points in one :class:`gsfluent.ops.Solver`, which takes many steps per
call. :class:`gsfluent.pipeline.simulate.composed.Composed` takes one step at a time with the
composable operators; it is the reference, and it alone knows light free bodies.

A blade at work is looked at once per cell that its edge moves: what it parts gets its side, and the
solver goes on with the fields and the faces that follow.
"""

from __future__ import annotations

import itertools
import math
from typing import Any

import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.materials import LAWS
from gsfluent.ops import SolverError
from gsfluent.ops import collider as columns
from gsfluent.ops.reference import touch
from gsfluent.ops.solver_buffers import MAX_FIELDS
from gsfluent.pipeline.colliders.blades import BladeSet
from gsfluent.pipeline.colliders.rigid import RigidSet
from gsfluent.pipeline.matter.points import Matter
from gsfluent.pipeline.matter.state import State, at_rows
from gsfluent.pipeline.simulate.engine import Counters, Points, SolverOptions, Unhealthy
from gsfluent.scene.scene import Scene

FLOOR_DEPTH = 0.05
"""How far [cells] a free body may sink into the floor before it is put back."""
ROUGH = 0.3
"""Contact radius of a point in lattice spacings."""
CROWDED = 3
"""Reason of a SolverError: more fields share a block than it has room for."""


POINT, VELOCITY = slice(3, 6), slice(10, 13)
"""Columns of a collider's row."""
LOOK = 8
"""Steps between two looks at how fast matter is, while a collider is much faster."""
STEADY = 0.9
"""Factor on the time step above which that need not be."""
WORTH_DEVICES = 1_000_000
"""Points from which several GPUs may be faster than one (docs/measured/benchmarks.md)."""
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
    if matter.has_field:
        known = matter.law.new_tensor([LAWS[name] for name in ("elastic", "nacc", "phase_field")])
        if not bool(torch.isin(matter.law, known).all()):
            return False  # not there yet
    if matter.viscous and (matter.has_field or matter.compiled_apart):
        return False  # not there yet
    if not rigid.frees:
        return True
    mass = rows[:, columns.MASS]
    touched = float(matter.params[:, 6].max()) * rigid.touchable(rows)
    return bool(((mass >= OUTWEIGHS * touched) | (mass == 0.0)).all())  # 0: standing, or waiting


def contact_radius(matter: Matter, rigid: RigidSet) -> Tensor:
    """Nearest that points come to colliders and other bodies before these push them [m], [N].

    Float64.

    The outermost points of a jittered lattice lie a quarter of its spacing inside of the face. Of a
    point that starts nearer the radius is that distance: nothing is thrown out of what it overlaps.
    """
    particles = matter.particles
    usual = (ROUGH * particles.volume.double() ** (1.0 / 3.0)).clamp(max=0.5 * matter.dx)
    usual = torch.minimum(usual, apart(matter))
    if not rigid.start.shape[0]:
        return usual
    distance, _ = ops.collider_distance(particles.position.double(), rigid.start, rigid.sdf)
    return torch.minimum(usual, distance.amin(dim=1))


def rebound(matter: Matter) -> Tensor:
    """Share of what pushes points that is left while they part, [N], float64.

    A spring at the surface stands for a layer of the matter behind it and loses as much as that:
    what it loses by itself and what of it relaxes.
    """
    p = matter.particles
    loss = matter.params[:, 7].double()
    solid = (matter.law == LAWS["elastic"]) | (matter.law == LAWS["nacc"])
    loss = torch.where(solid, torch.where(loss >= 1.0, loss - 1.0, loss), 0.0).clamp(0.0, 1.0)
    kept = (1.0 - loss)[p.material.long()]
    return kept if p.viscous is None else kept * (1.0 - p.viscous[:, 6].double())


def apart(matter: Matter) -> Tensor:
    """Distance at which each point starts from the faces of other bodies [m], float64 [N].

    As the solver finds faces (docs/theory/contact.md, "At a point"), up to a cell. On the device of
    the points; sums are in the order of the points.
    """
    place = matter.rest.double() / matter.dx
    found = torch.zeros_like(place[:, 0])
    near = torch.zeros_like(found, dtype=torch.bool)
    body = torch.zeros_like(near, dtype=torch.int64)
    boxes = [(place[a:b].amin(0) - 1.0, place[a:b].amax(0) + 1.0) for a, b in matter.ranges]
    for one, (a, b) in enumerate(matter.ranges):
        body[a:b] = one
        for other, (low, high) in enumerate(boxes):
            if other != one:
                near[a:b] |= ((place[a:b] >= low) & (place[a:b] <= high)).all(dim=1)
    rows = near.nonzero()[:, 0]
    if len(rows):
        volume = matter.particles.volume.double()[rows] / matter.dx**3
        found[rows] = _of_others(place[rows], volume, body[rows])
    distance = torch.linspace(0.9, -1.9, 28001, dtype=torch.float64, device=place.device)
    share = touch.share(distance)  # grows along these
    after = torch.searchsorted(share, found).clamp(1, len(share) - 1)
    way = (found - share[after - 1]) / (share[after] - share[after - 1])
    at = distance[after - 1] + way.clamp(0.0, 1.0) * (distance[after] - distance[after - 1])
    return matter.dx * (at - 1e-5)  # a little less: rounding pushes nobody


def _of_others(place: Tensor, volume: Tensor, body: Tensor) -> Tensor:
    """Share of space about each point that is other bodies' [N]; places and volumes in cells."""
    cell = place.floor().long()
    cell = cell - cell.amin(dim=0) + 1
    size = cell.amax(dim=0) + 2
    steps = [int(size[1] * size[2]), int(size[2]), 1]
    key = (cell * cell.new_tensor(steps)).sum(dim=1)
    ordered, order = torch.sort(key, stable=True)
    found = torch.zeros_like(volume)
    for i, j, k in itertools.product((-1, 0, 1), repeat=3):
        there = key + i * steps[0] + j * steps[1] + k * steps[2]
        first = torch.searchsorted(ordered, there)
        count = torch.searchsorted(ordered, there, right=True) - first
        rows = count.nonzero()[:, 0]  # of those with a next point in that cell
        for n in range(int(count.max())):
            rows = rows[count[rows] > n]
            other = order[first[rows] + n]
            own = (body[other] != body[rows]).nonzero()[:, 0]
            at, other = rows[own], other[own]
            distance = (place[at] - place[other]).norm(dim=1)
            found[at] += volume[other] * touch.kernel(distance)
    return found


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
        field = torch.unique(field, return_inverse=True)[1]
        law, params = matter.law, matter.params
        if not (
            options.law_kernels or matter.has_field or matter.viscous
        ):  # a row that no point has asks for the kernel of all laws
            law = torch.cat([law, law.new_tensor([LAWS["fluid"]])])
            spare = params[:1].clone()
            spare[:, 7] = 0.0  # there a loss of nacc, which is no exponent of a fluid
            params = torch.cat([params, spare])
        self._special = options.law_kernels and set(law.tolist()) <= {
            LAWS["elastic"],
            LAWS["nacc"],
        }
        self._damage = not set(law.tolist()) <= {LAWS["elastic"]}  # as the solver decides it
        constants: dict[str, Any] = dict(
            mass=p.mass, volume=p.volume, dx=matter.dx, law=law, params=params,
            material=p.material, gravity=scene.gravity, sdf=rigid.sdf, friction=scene.friction,
            cfl=options.cfl, irreversible=options.irreversible, **options.return_map,
        )  # fmt: skip
        if not matter.has_field:
            constants["flip"] = options.flip
        there = torch.cuda.device_count() if p.device.type == "cuda" else 1
        if options.all_devices and there > 1 and len(p.mass) >= WORTH_DEVICES:
            constants["devices"] = [f"cuda:{i}" for i in range(there)]
        if options.contact == "points":
            constants["radius"] = at_rows(contact_radius(matter, rigid), rows).to(p.velocity)
            constants["rebound"] = at_rows(rebound(matter), rows).to(p.velocity)
            which = torch.arange(len(matter.ranges)).repeat_interleave(
                torch.tensor([end - start for start, end in matter.ranges])
            )
            self._object = at_rows(which.to(p.device), rows)
        self._constants = constants
        self._rigid, self._matter, self._counters = rigid, matter, counters
        self._dt_scale = dt_scale
        self._start = self.time = state.time
        self.colliders = state.colliders
        self.impulse = torch.zeros(3, dtype=torch.float64, device=p.device)
        self.work = torch.zeros((), dtype=torch.float64, device=p.device)
        self.given = self.work.new_zeros(len(rigid.grips), 6)
        self._blades = BladeSet(scene, matter.dx)
        self._unit, self.cut = field.to(torch.int32), at_rows(state.cut, rows)
        self._faces = self.colliders[:0]
        """Rows of the faces of blades at work, after those of the colliders."""
        self._wave: float | None = None
        """Speed of the fastest wave when a face first pushed [m/s]."""
        self._look(position.to(p.dtype))
        self._begin(Points(
            position, p.velocity, p.affine, p.strain, p.alpha, peak, p.deformation, p.viscous
        ))  # fmt: skip

    def _begin(self, points: Points) -> None:
        """Load points into a solver, with the fields and the faces of now."""
        body, parent, cut = self._unit, None, None
        if len(self._blades):
            pushed = self._faces.shape[0] > 0
            fields = self._blades.fields(body, self.cut, pushed=pushed, most=MAX_FIELDS)
            if bool((fields.cut != 0).any()):
                body, parent, cut = fields.field, fields.parent, fields.cut
        rows = torch.cat([self.colliders, self._faces])
        objects = None
        if "radius" in self._constants:
            none = self._object.new_full((int(body.max()) + 1,), len(self._matter.ranges))
            objects = none.scatter_reduce(0, body.long(), self._object, "amin").to(torch.int32)
        self._solver = _guarded(
            points.velocity,
            lambda: ops.Solver(
                **points._asdict(), body=body, parent=parent, cut=cut, objects=objects,
                colliders=rows if rows.shape[0] else None, **self._constants,
            ),
        )  # fmt: skip
        self._start = self.time
        self._seen = self._solver.counters()
        self._where: Tensor | None = None
        self._counters.fields_max = max(self._counters.fields_max, self._solver.fields)

    def advance(self, until: float, steps: int) -> int:
        """See :class:`Engine`."""
        counters = self._counters
        before = counters.steps
        depth = FLOOR_DEPTH * self._matter.dx
        while self.time < until and counters.steps - before < steps:
            if self.time >= self._due and self._look(self._position().to(self._solver.dtype)):
                self._begin(self.read())
            stop = min(until, self._due)
            pace = self._pace()
            self._solver.dt_scale = self._dt_scale * pace
            wait = self._rigid.floor_wait(self.colliders, depth)
            left = steps - (counters.steps - before)
            steady = pace > STEADY or self._faces.shape[0] > 0  # a blade is looked at anyway
            self._go(min(stop, self.time + wait), left if steady else min(left, LOOK))
        taken = counters.steps - before
        sites = int(self._seen["sites"])
        counters.law_kernel_steps += taken if self._special else 0
        counters.undamaged_steps += 0 if self._damage else taken
        counters.block_steps += taken * sites
        counters.contact_block_steps += taken * int(self._seen["shared_sites"])
        counters.box_steps += taken * max(sites, _box(self._position(), self._matter.dx))
        return taken

    def _look(self, position: Tensor) -> bool:
        """Part what the blades pass until the next look; return whether that changed anything.

        Until then the edge moves a cell at most; what it passes gets its side when the edge is half
        of that away, before or behind.
        """
        blades, now, cut = self._blades, self.time, self.cut
        faces, self._due = self._faces[:0], blades.next_change(now)
        if len(blades):
            span = self._matter.dx / max(blade.speed for blade in blades.blades)
            half = 0.0
            if blades.speed(now) > 0.0:
                self._due = min(self._due, now + span)
                half = 0.5 * (self._due - now)
                faces = blades.faces(self._due).to(self._faces)
                # They are where they should be when the look ends, and move there until then.
                faces[:, POINT] -= (self._due - now) * faces[:, VELOCITY]
            cut = blades.look(position, cut, now - span, now + half)
        same = not (faces.shape[0] or self._faces.shape[0]) and torch.equal(cut, self.cut)
        self.cut, self._faces = cut, faces
        return not same

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
        rigid, faces = self._rigid, self._faces
        driven = float(rigid.speed(self.colliders))
        if faces.shape[0]:
            driven = max(driven, float(faces[:, VELOCITY].norm(dim=1).max()))
        if driven == 0.0:
            return 1.0
        # Between the looks at a blade, a cell apart, waves change little, and the ratio less.
        if self._wave is None or not faces.shape[0]:
            matter, strain = self._matter, self._solver.strain
            wave = ops.wave_speed(
                strain, law=matter.law, params=matter.params, material=self._constants["material"]
            )
            self._wave = float(wave.max())
        fastest, speed = self._wave, float(self._solver.velocity.norm(dim=1).max())
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
        rigid, count = self._rigid, self._rigid.count
        if not count + self._faces.shape[0]:
            return
        given, turned = solver.impulse - pushed, solver.torque - twisted
        moved = solver.colliders
        self.impulse = self.impulse + given.sum(dim=0)
        if grips := rigid.grips:
            self.given = self.given + torch.cat([given, turned], dim=1)[grips]
        self.work = self.work + rigid.work(moved[count:], given[count:], turned[count:])
        self._faces = moved[count:]
        moved = moved[:count]
        self.work = self.work + rigid.work_between(
            self.colliders, moved, given[:count], turned[:count]
        )
        self.colliders = rigid.settled(moved, self.time)
        if not torch.equal(self.colliders, moved):
            solver.set_colliders(torch.cat([self.colliders, self._faces]))

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
        s, names = self._solver, list(Points._fields)
        if self._where is not None:
            names.remove("position")
        names = [name for name in names if s.holds(name)]
        found = dict(zip(names, s.values(*names), strict=True))
        self._where = found.pop("position", self._where)
        assert self._where is not None  # it was there, or has been asked for
        return Points(position=self._where, **{"deformation": None, **found})


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
    return math.prod(int(n) for n in (high - low + 1.0).tolist())


def _guarded(like: Tensor, make: Any) -> ops.Solver:
    """Make a solver; a state it refuses is unhealthy."""
    try:
        solver: ops.Solver = make()
    except ValueError as error:
        wrong = ~torch.isfinite(like).all(dim=1)
        raise Unhealthy(str(error), wrong if bool(wrong.any()) else None) from error
    return solver
