"""Advances the state of a simulation: matter on the grid, and what may be left out of it.

The grid belongs to an engine (:mod:`gsfluent.pipeline.simulate.resident`) that takes many steps per
call. Beside it move groups in closed form (:mod:`gsfluent.pipeline.simulate.groups`) and loose
debris. A call ends when something may come close to a group, which then joins the grid.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from gsfluent.errors import InputError
from gsfluent.pipeline.colliders.blades import BladeSet
from gsfluent.pipeline.colliders.proximity import box_gaps, boxes, distance, time_to_meet
from gsfluent.pipeline.colliders.rigid import RigidSet
from gsfluent.pipeline.liquid.looks import Liquids
from gsfluent.pipeline.liquid.nozzle import WAITING, pours
from gsfluent.pipeline.matter.fields import LIMIT, MOST, number_fields
from gsfluent.pipeline.matter.pieces import Pieces
from gsfluent.pipeline.matter.points import Matter
from gsfluent.pipeline.matter.state import State, at_rows
from gsfluent.pipeline.simulate import debris
from gsfluent.pipeline.simulate.composed import FIELDS, Composed
from gsfluent.pipeline.simulate.engine import Counters, Engine, Points, SolverOptions
from gsfluent.pipeline.simulate.flight import Flight, Queue
from gsfluent.pipeline.simulate.groups import (
    LANDING,
    Group,
    Leaving,
    count_calm,
    grid_mask,
    lay_down,
)
from gsfluent.pipeline.simulate.resident import Resident, resident_can
from gsfluent.scene.scene import Scene

FINE = 8.0
"""Below this distance of their boxes [cells] the points of two things are compared themselves."""
SIDES = 3
"""Fields of one piece at a blade: above it, below it, and ahead of its edge."""
HASTE = 1.5
"""How much faster than now matter on the grid may get before the next look."""


class Stepper:
    """Advances a :class:`State`.

    Args:
        scene: Floor, gravity and contact coefficients.
        matter: Points and their parameters.
        options: How; the defaults when absent.
        flights: The first flights of the first bodies, when they are known.
    """

    def __init__(
        self,
        scene: Scene,
        matter: Matter,
        options: SolverOptions | None = None,
        flights: Sequence[Flight] = (),
    ) -> None:
        self.scene, self.matter = scene, matter
        self.options = options = (options or SolverOptions()).decided(scene)
        self._ordered = options.deterministic and matter.particles.device.type == "cuda"
        self.counters = Counters()
        self.dt_scale = 1.0
        self.field_limit = LIMIT
        self._reach = debris.reach_of(matter)
        device = matter.particles.device
        self._gravity = torch.tensor(scene.gravity, dtype=torch.float64)
        self._pull = float(self._gravity.norm())
        self.rigid = RigidSet(scene, matter.dx, device, matter.particles)
        self.blades = BladeSet(scene, matter.dx)
        self.liquids = Liquids(scene, matter)
        self.leaving = Leaving(
            matter, self.rigid, self._gravity, sleep=options.sleep,
            fly=options.piece_flight and options.free_flight,
        )  # fmt: skip
        self.flights = list(flights)
        known = len(self.flights)
        for body, (a, b) in zip(scene.bodies[known:], matter.ranges[known:], strict=True):
            points = matter.particles.select(torch.arange(a, b, device=device))
            held = body.start if body.held else 0.0
            self.flights.append(
                Flight(points, points.position, self._gravity, 0.0, matter.dx, held=held)
            )
        self.reset()

    def reset(self) -> None:
        """Forget what was learned from the last state (at a frame, after a roll-back)."""
        self._last: State | None = None
        self._engine: Engine | None = None
        self._groups: list[Group] = []
        self._rows: Tensor | None = None
        self._empty = False

    def resume(self, counters: Counters) -> None:
        """Go on counting from a saved run."""
        self.counters = counters
        self.leaving.naps, self.leaving.flights = counters.naps, counters.piece_flights
        self.reset()

    def successor(self, scene: Scene, matter: Matter) -> Stepper:
        """A stepper that goes on counting where this one stands, with a scene that has more."""
        other = Stepper(scene, matter, self.options, self.flights)
        other.resume(self.counters)
        other.field_limit, other.dt_scale = self.field_limit, self.dt_scale
        return other

    def initial(self, links: int = 0) -> State:
        """Return the state at time 0, of matter with so many links at rest."""
        flies = self.options.free_flight
        landed = tuple(not flies or pours(body) for body in self.scene.bodies)
        state = State.start(
            self.matter, self.rigid.start, landed, links, grips=len(self.rigid.grips)
        )
        state = self.liquids.begun(state)
        self._take(state)
        state = self._land(state)[0]
        if not self.options.standing:
            return state
        return lay_down(state, self.matter, self.rigid, self._gravity, state.unit)

    def regroup(
        self, state: State, pieces: Pieces, frame: float, *, at_frame: bool = True
    ) -> State:
        """Give pieces fields of their own and let what may leave the grid do so.

        Args:
            state: The state.
            pieces: What hangs together.
            frame: Length of a frame [s].
            at_frame: Whether a frame begins here; groups leave only then.
        """
        state = state._replace(unit=pieces.unit, cut_links=pieces.cut_links)
        dust = pieces.dust & grid_mask(state, self.matter)
        state = self._let_go(state, dust)
        state = debris.settle_chips(state, self.matter, self.rigid, pieces.chip)
        on_grid = grid_mask(state, self.matter)
        state = self._renumber(state, on_grid)
        if not at_frame:
            return state
        trembles = self.options.contact == "points"
        state = count_calm(state, on_grid, self._gravity, self.matter.dx, frame, trembles)
        state = self.leaving(state, state.unit, frame)
        self.counters.naps, self.counters.piece_flights = self.leaving.naps, self.leaving.flights
        return state

    def relieve(self, state: State) -> State:
        """Let fewer fields meet in a block, after they were too many for it."""
        self.field_limit = max(2, self.field_limit // 2)
        return self._renumber(state, grid_mask(state, self.matter))

    def _renumber(self, state: State, on_grid: Tensor) -> State:
        if not self.options.separate_fragments or not bool(on_grid.any()):
            return state
        limit = max(2, self.field_limit // SIDES) if self._cuts(state) else self.field_limit
        field = number_fields(
            state.unit, state.position, self.matter.particles.mass, on_grid, self.matter.dx,
            limit, MOST if self._resident_now(state) else FIELDS,
        )  # fmt: skip
        return state if torch.equal(field, state.field) else state._replace(field=field)

    def advance(self, state: State, until: float, steps: int) -> State:
        """Advance by one call of the engine, or by one stretch without the grid.

        Args:
            state: The state.
            until: Time to reach at most [s].
            steps: Grid steps at most.

        Raises:
            Unhealthy: A number is not finite or a point left the grid.
        """
        until = min(until, self.rigid.next_change(state.time), self.blades.next_change(state.time))
        if state is not self._last:
            self._take(state)
        state, clear = self._land(state)
        if self._empty:
            state = self._without_grid(state, until)
        else:
            make = Resident if self._resident_now(state) else Composed
            if make is Composed and self._ordered:
                raise InputError(
                    f"simulate: from t = {state.time:.4g} s on the scene needs operators whose "
                    "sums have no order on a GPU (a free body is lighter than what it meets), but "
                    "deterministic was asked for",
                    hint="leave out solve.deterministic, or run on the CPU",
                )
            if not isinstance(self._engine, make):
                self._engine = make(
                    self.scene, self.matter, self.rigid, state, self._rows, self.options,
                    self.dt_scale, self.counters,
                )  # fmt: skip
            state = self._on_grid(state, self._engine, min(until, clear), steps)
        self._last = state
        return state

    @property
    def blocks(self) -> int:
        """Blocks of the grid in use."""
        return 0 if self._engine is None else self._engine.blocks

    def spread(self, wrong: Tensor, state: State) -> Tensor:
        """Marks of the engine's points as marks of all points, bool [N]."""
        if wrong.shape[0] == state.peak.shape[0] or self._rows is None:
            return wrong
        return torch.zeros_like(state.loose).index_copy(0, self._rows, wrong)

    def _cuts(self, state: State) -> bool:
        """Whether a blade is at work, or something is cut in part: its sides are fields too."""
        if len(self.blades) == 0:
            return False
        if self.blades.speed(state.time) > 0.0:
            return True
        whole = state.unit if self.options.separate_fragments else state.field
        held = state.unit >= 0
        return self.blades.splits(whole[held], state.cut[held]).numel() > 0

    def _resident_now(self, state: State) -> bool:
        """Whether the resident solver can go on from here."""
        wanted = self.options.resident and self.options.contact_proximity
        return wanted and resident_can(state.colliders, self.rigid, self.matter)

    def _on_grid(self, state: State, engine: Engine, until: float, steps: int) -> State:
        pushed, worked, gave = engine.impulse, engine.work, engine.given
        taken = engine.advance(until, steps)
        self.counters.flight_body_steps += taken * sum(g.body is not None for g in self._groups)
        state = self._moved(
            state._replace(
                step=state.step + taken,
                colliders=engine.colliders,
                impulse=state.impulse + (engine.impulse - pushed),
                work=state.work + (engine.work - worked),
                given=state.given + (engine.given - gave),
            ),
            engine.time,
            engine.read(),
        )
        if len(self.blades):
            rows = self._rows
            cut = engine.cut if rows is None else state.cut.index_copy(0, rows, engine.cut)
            state = state._replace(cut=cut)
        return self._retire(state)

    def _without_grid(self, state: State, until: float) -> State:
        """Move in closed form until a frame is due or something comes close to something."""
        time, rows = state.time, state.colliders
        while time < until:
            _, clear = self._look_around(state, time, rows)
            before, time = time, min(until, clear)
            rows = self.rigid.advance(rows, before, time - before)
            if self._look_around(state, time, rows)[0]:
                break
        if any(group.flight is not None for group in self._groups):
            self.counters.flight_seconds += time - state.time
        return self._moved(state._replace(colliders=rows), time, None)

    # --- groups ---

    def _take(self, state: State) -> None:
        """Take over a state: its groups, and which rows are on the grid."""
        self._engine = None
        device = state.position.device
        self._groups = []
        for i, (flight, (a, b)) in enumerate(zip(self.flights, self.matter.ranges, strict=True)):
            if not state.landed[i]:
                rows = torch.arange(a, b, device=device)
                self._groups.append(Group(rows, flight, i, state.position[a:b], flight.mass))
        waits = state.group == WAITING
        for i, body in enumerate(self.scene.bodies if bool(waits.any()) else ()):
            rows = (waits & (state.particles.body == i)).nonzero()[:, 0]
            if rows.numel():
                self._groups.append(self._queue(state, rows, body.start))
        for number in torch.unique(state.group[state.group >= 0]).tolist():
            rows = (state.group == number).nonzero()[:, 0]
            self._groups.append(self._group(state, rows))
        on_grid = grid_mask(state, self.matter)
        self._empty = not bool(on_grid.any())
        self._rows = None if bool(on_grid.all()) else on_grid.nonzero()[:, 0]

    def _group(self, state: State, rows: Tensor) -> Group:
        position = state.position[rows]
        mass = float(state.particles.mass[rows].double().sum())
        if bool(state.asleep[rows[0]]):
            return Group(rows, None, None, position, mass)
        flight = Flight(
            state.particles.select(rows), position, self._gravity, state.time, self.matter.dx,
            rigid=False,
        )  # fmt: skip
        return Group(rows, flight, None, position, mass)

    def _queue(self, state: State, rows: Tensor, start: float) -> Group:
        points, position = state.particles.select(rows), state.position[rows]
        flight = Queue(points, position, state.time, self.matter.dx, held=start)
        return Group(rows, flight, None, position, flight.mass)

    def _land(self, state: State) -> tuple[State, float]:
        """Put on the grid every group that something is close to; say how long the rest is clear.

        Returns:
            The state, and a time before which nothing else can come close.
        """
        while True:
            touched, clear = self._look_around(state, state.time, state.colliders)
            if not touched:
                return state, clear
            landed, group, asleep, calm = list(state.landed), state.group, state.asleep, state.calm
            for i in touched:
                found = self._groups[i]
                if found.body is not None:
                    landed[found.body] = True
                    continue
                self.counters.wakes += found.flight is None
                group = group.index_fill(0, found.rows, -1)
                asleep = asleep.index_fill(0, found.rows, False)
                calm = calm.index_fill(0, found.rows, 0)
            state = state._replace(landed=tuple(landed), group=group, asleep=asleep, calm=calm)
            self._take(state)

    def _look_around(self, state: State, time: float, colliders: Tensor) -> tuple[set[int], float]:
        """Which groups something is close to, and until when nothing else can be."""
        groups, dx, pad = self._groups, self.matter.dx, LANDING * self.matter.dx
        touched: set[int] = set()
        clear = math.inf
        if not groups:
            return touched, clear
        bounds = [group.bounds(time) for group in groups]
        low, high = (torch.stack([b[i] for b in bounds]) for i in (0, 1))
        speed = [group.speed(time) for group in groups]
        between = box_gaps(low, high, low, high)
        grid = _OnGrid(state, self._rows) if not self._empty else None
        to_grid = box_gaps(low, high, grid.low, grid.high) if grid is not None else None
        driven = float(self.rigid.speed(colliders))
        moving = self.rigid.moving(colliders)
        to_any, to_moving = (self.rigid.gaps(rows, low, high) for rows in (colliders, moving))
        for i, group in enumerate(groups):
            if group.held(time):
                clear = min(clear, group.flight.held if group.flight is not None else clear)
                continue
            sleeps = group.flight is None
            # Gap to what is near, and how fast that is.
            near: list[tuple[float, float]] = [(self.blades.gap(low[i], high[i], time), 0.0)]
            near.append((to_moving[i] if sleeps else to_any[i], driven))
            for j, other in enumerate(groups):
                if j == i or (sleeps and other.flight is None):
                    continue
                gap = float(between[i, j])
                if gap < FINE * dx:
                    gap = max(gap, distance(group.points(time), other.points(time), dx))
                near.append((gap, 0.0 if other.held(time) else speed[j]))
            if grid is not None and to_grid is not None:
                gap = float(to_grid[i].min())
                if gap < FINE * dx:
                    close = (to_grid[i] < FINE * dx).nonzero()[:, 0]
                    gap = max(gap, distance(group.points(time), grid.points(close), dx))
                near.append((gap, HASTE * grid.speed))
            for gap, other_speed in near:
                if gap < pad:
                    touched.add(i)
                # Half a cell more: a look costs something, and that much nearer is near enough.
                wait = time_to_meet(
                    max(gap - pad, 0.0) + 0.5 * dx, speed[i] + other_speed, self._pull
                )
                clear = min(clear, time + wait)
        return touched, clear

    # --- putting together ---

    def _moved(self, state: State, time: float, points: Points | None) -> State:
        """The state at a later time: points of the grid, groups and loose debris."""
        span = time - state.time
        p = state.particles
        names = ("velocity", "affine", "strain", "alpha", "deformation", "viscous")
        if points is not None and self._rows is None:
            position, peak = points.position, points.peak
            values = {name: getattr(points, name) for name in names}
        else:
            position, peak = state.position.clone(), state.peak.clone()
            values = {name: getattr(p, name) for name in names}
            values = {name: v if v is None else v.clone() for name, v in values.items()}
        if points is not None and self._rows is not None:
            position[self._rows], peak[self._rows] = points.position, points.peak
            for name, value in values.items():
                if value is not None:
                    value[self._rows] = getattr(points, name)
        impulse = state.impulse
        for group in self._groups:
            seconds = span * group.rows.shape[0]
            if group.flight is None:
                # What lies still is held up against its weight.
                impulse = impulse - span * group.mass * self._gravity.to(impulse)
                self.counters.sleeping_point_seconds += seconds
                continue
            self.counters.flying_point_seconds += seconds if group.body is None else 0.0
            moved, place = group.flight.state_at(time)
            position[group.rows] = place
            for name, value in values.items():
                if value is not None:
                    value[group.rows] = getattr(moved, name)
        self.counters.point_seconds += span * p.count
        work = state.work
        dust = (state.loose & (state.unit < 0)).nonzero()[:, 0]
        if dust.numel():
            push = debris.drift(
                position, values["velocity"], p.mass, dust, span, self.scene.gravity,
                self.scene.floor,
            )  # fmt: skip
            values["affine"][dust] = 0.0
            impulse = impulse + push
        chips = (state.loose & (state.unit >= 0)).nonzero()[:, 0]
        if chips.numel() and span > 0.0:
            push, given = self._tumble(state, chips, span, position, values)
            impulse, work = impulse + push, work + given
        particles = p.replace(position=position.to(p.dtype), **values)
        return state._replace(
            particles=particles, position=position, peak=peak, time=time, impulse=impulse,
            work=work, ever=state.ever | (self.matter.brittle & (peak >= 0)),
            lowest=torch.minimum(state.lowest, values["alpha"]),
        )  # fmt: skip

    def _tumble(
        self, state: State, rows: Tensor, span: float, position: Tensor,
        values: dict[str, Tensor | None],
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        """Move chips, in place; the impulse and the work of colliders on them."""
        p = state.particles
        index = torch.unique(state.unit[rows], return_inverse=True)[1]
        chips = debris.RigidChips(
            p.mass[rows], state.position[rows], p.velocity[rows], p.affine[rows], index,
            self.matter.dx,
        )  # fmt: skip
        now = debris.tumble(chips, span, self._gravity, state.colliders, self.rigid.sdf)
        position[rows] = now.position
        deformation = values["deformation"]
        if deformation is not None and p.deformation is not None:
            deformation[rows] = (now.turn.to(deformation) @ p.deformation[rows]).contiguous()
        for name in ("velocity", "affine"):
            value = values[name]
            assert value is not None  # only a deformation may be missing
            value[rows] = getattr(now, name).to(value)
        return now.impulse, now.work

    def _retire(self, state: State) -> State:
        """Take broken points that are far away off the grid."""
        candidate = grid_mask(state, self.matter)
        return self._let_go(
            state, debris.find_far(state.position, state.peak, candidate, self._reach)
        )

    def _let_go(self, state: State, gone: Tensor) -> State:
        if bool(gone.any()):
            state = debris.let_go(state, gone)
            self._take(state)
        return state


class _OnGrid:
    """Boxes of the fields on the grid, and the points of some of them."""

    def __init__(self, state: State, rows: Tensor | None) -> None:
        self._position, self._field = at_rows(state.position, rows), at_rows(state.field, rows)
        velocity = at_rows(state.particles.velocity, rows)
        speed = float(velocity.norm(dim=1).max())
        self.speed = speed if math.isfinite(speed) else 0.0
        self.low, self.high = boxes(self._position, self._field, int(self._field.max()) + 1)

    def points(self, fields: Tensor) -> Tensor:
        """Positions of the points of some fields [m]."""
        return self._position[torch.isin(self._field, fields.to(self._field))]
