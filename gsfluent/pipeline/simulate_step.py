"""One time step of the material points, and what it may leave out.

A step is p2g, grid update, g2p and the return map. Left out are: bodies in free flight (they move
exactly, see :mod:`gsfluent.pipeline.simulate_flight`), the contact pass while no two bodies meet,
and the search for active blocks while the old ones still hold every point.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.data import Particles
from gsfluent.pipeline.particles import Matter
from gsfluent.pipeline.rigid import RigidSet
from gsfluent.pipeline.simulate_flight import Flight
from gsfluent.pipeline.simulate_strays import drift, find_strays, reach_of
from gsfluent.scene import Scene

CFL = 0.5
GRADIENT_LIMIT = 0.3
"""Largest ``dt |grad v|`` of intact matter in one step."""
REFRESH = 5
"""Steps between two looks at speeds and stiffness (each one waits for the device)."""
LANDING = 2.0
"""Distance [cells] at which a flying body is handed to the grid: the reach of the kernel (1.5)
plus what it can move before the next look."""
WEAKENING = 0.02
"""Range of alpha past zero over which a broken point loses its cohesion for good."""


class Unhealthy(Exception):
    """The state cannot be advanced: a number is not finite, or a point left the grid."""


class State(NamedTuple):
    """Everything that changes in a simulation. Tensors are never written in place.

    Attributes:
        particles: All points; those of flying bodies are as of ``time`` only in frames.
        peak: Largest alpha each point ever had, [N]; breaking cannot be undone.
        stress: Kirchhoff stress [Pa], [N, 6].
        time: Simulated time [s].
        step: Grid steps so far.
        landed: Which bodies are on the grid.
        impulse: Sum of collider impulses on the bodies [N s], float64 [3].
        colliders: Rows of the rigid colliders as of ``time``, float64 [M, 32].
        work: Most energy that colliders can have given to the bodies [J], float64 [].
        stray: Crumbs that left the grid for good, bool [N] (see
            :mod:`gsfluent.pipeline.simulate_strays`).
    """

    particles: Particles
    peak: Tensor
    stress: Tensor
    time: float
    step: int
    landed: tuple[bool, ...]
    impulse: Tensor
    stray: Tensor
    colliders: Tensor
    work: Tensor


@dataclasses.dataclass
class Counters:
    """What the solver did and what it left out."""

    steps: int = 0
    particle_steps: int = 0
    flight_seconds: float = 0.0
    flight_body_steps: int = 0
    contact_steps: int = 0
    contact_steps_skipped: int = 0
    block_builds: int = 0
    blocks_max: int = 0
    dt_min: float = float("inf")
    dt_max: float = 0.0
    return_map: Tensor | int = 0
    """Sums over steps of plastic, guarded, inverted and reset points, int64 [4]."""


class Stepper:
    """Advances a :class:`State` on the grid.

    Args:
        scene: Floor, gravity and contact coefficients.
        matter: Points and their parameters.
        cfl: Courant number of the automatic time step.
        free_flight: Whether bodies that touch nothing skip the grid.
        irreversible: Whether broken points stay without cohesion when they are pressed together.
        return_map: Options of :func:`gsfluent.ops.return_mapping` (``k``, ``epsilon``,
            ``implicit``).
    """

    def __init__(
        self,
        scene: Scene,
        matter: Matter,
        *,
        cfl: float = CFL,
        free_flight: bool = True,
        irreversible: bool = True,
        return_map: dict[str, float | bool] | None = None,
    ) -> None:
        self.scene, self.matter = scene, matter
        self.cfl, self.free_flight, self.irreversible = cfl, free_flight, irreversible
        self.return_map = dict(return_map or {})
        self.counters = Counters()
        self.dt_scale = 1.0
        self._reach = reach_of(matter)
        self.lost: Tensor | int = 0
        """Points that were not finite or not covered since the last :meth:`reset`."""
        device = matter.particles.device
        self._gravity = torch.tensor(scene.gravity, dtype=torch.float64)
        self.rigid = RigidSet(scene, matter.dx, device)
        self.flights = []
        for body, (a, b) in zip(scene.bodies, matter.ranges, strict=True):
            points = matter.particles.select(torch.arange(a, b, device=device))
            held = body.start if body.held else 0.0
            self.flights.append(Flight(points, self._gravity, 0.0, matter.dx, held=held))
        self.reset()

    def reset(self) -> None:
        """Forget what was learned from the last state (after a roll-back or a resume)."""
        self.lost = 0
        self._blocks: ops.Blocks | None = None
        self._travelled = 0.0
        self._speed = 0.0
        self._limit = 0.0
        self._refresh = 0
        self._contact = False
        self._rows: Tensor | None = None
        self._params: Tensor | None = None
        self._law: Tensor | None = None
        self._fields: Tensor | None = None
        self._strays = torch.zeros(0, dtype=torch.int64)

    def initial(self) -> State:
        """Return the state at time 0."""
        particles = self.matter.particles
        state = State(
            particles=particles,
            peak=particles.alpha,
            stress=particles.position.new_zeros(particles.count, 6),
            time=0.0,
            step=0,
            landed=(not self.free_flight,) * len(self.flights),
            impulse=torch.zeros(3, dtype=torch.float64, device=particles.device),
            stray=torch.zeros(particles.count, dtype=torch.bool, device=particles.device),
            colliders=self.rigid.start,
            work=torch.zeros((), dtype=torch.float64, device=particles.device),
        )
        return self._land(state)

    def whole(self, state: State) -> State:
        """Return the state with the points of flying bodies brought to ``state.time``."""
        if all(state.landed):
            return state
        parts = []
        for flight, landed, (a, b) in zip(
            self.flights, state.landed, self.matter.ranges, strict=True
        ):
            if landed:
                rows = torch.arange(a, b, device=state.particles.device)
                parts.append(state.particles.select(rows))
            else:
                parts.append(flight.particles_at(state.time))
        return state._replace(particles=Particles.cat(parts))

    def advance(self, state: State, until: float) -> State:
        """Advance by one grid step, or by one stretch of pure flight, but not past ``until``.

        Raises:
            Unhealthy: A number is not finite or a point left the grid.
        """
        until = min(until, self.rigid.next_change(state.time))
        if not any(state.landed):
            return self._fly(state, until)
        if self._refresh <= 0:
            state = self._retire(state)
            self._look(state)
            self._refresh = REFRESH
        self._refresh -= 1
        left = until - state.time
        dt = min(self._limit * self.dt_scale, left)
        if dt < left < 2.0 * dt:  # two even steps instead of a whole one and a sliver
            dt = 0.5 * left
        state = self._step(state, dt, last=dt == left, until=until)
        return self._land(state)

    def _fly(self, state: State, until: float) -> State:
        """Move in closed form until a frame is due or a body comes close to something."""
        dx, time, rows = self.matter.dx, state.time, state.colliders
        while time < until:
            speed = max(self._flight_speed(flight, time) for flight in self.flights)
            speed = max(speed, float(self.rigid.speed(rows)))
            pull = float(self._gravity.norm())
            # Time to move half a cell at most, also when starting from rest.
            step = 0.5 * dx / max(speed + pull * 0.5 * (dx / max(pull, 1e-9)) ** 0.5, 1e-9)
            before, time = time, min(until, time + step)
            rows = self.rigid.advance(rows, before, time - before)
            now = self._land(state._replace(time=time, colliders=rows))
            if any(now.landed):
                self.counters.flight_seconds += time - state.time
                return now
        self.counters.flight_seconds += until - state.time
        return state._replace(time=until, colliders=rows)

    def _flight_speed(self, flight: Flight, time: float) -> float:
        return float(flight.center_at(time)[1].norm()) + flight.speed_limit

    def _land(self, state: State) -> State:
        """Put on the grid every flying body that is close to a collider or to another body."""
        flying = [
            i for i, f in enumerate(self.flights) if not state.landed[i] and state.time >= f.held
        ]
        if not flying:
            return state
        pad = LANDING * self.matter.dx
        boxes: list[tuple[Tensor, Tensor]] = []
        for i, (a, b) in enumerate(self.matter.ranges):
            if state.landed[i]:
                position = state.particles.position[a:b]
                low, high = (v.to("cpu", torch.float64) for v in torch.aminmax(position, dim=0))
                boxes.append((low, high))
            else:
                boxes.append(self.flights[i].bounds_at(state.time))
        touched = set()
        for i in flying:
            if self.rigid.gap(state.colliders, *boxes[i]) <= pad:
                touched.add(i)
            for j in range(len(boxes)):
                if j != i and _boxes_meet(boxes[i], boxes[j], pad):
                    touched.update(k for k in (i, j) if k in flying)
        if not touched:
            return state
        state = state._replace(
            particles=self.whole(state).particles,
            landed=tuple(now or i in touched for i, now in enumerate(state.landed)),
        )
        self.reset()
        return state

    def _active(self, state: State) -> Tensor | None:
        """Rows on the grid, without flying bodies and strays; None means all of them."""
        self._strays = state.stray.nonzero()[:, 0]
        if all(state.landed) and self._strays.numel() == 0:
            return None
        return (self._on_grid(state) & ~state.stray).nonzero()[:, 0]

    def _on_grid(self, state: State) -> Tensor:
        """Points of the bodies that have landed, bool [N]."""
        mask = torch.ones_like(state.stray)
        for (a, b), landed in zip(self.matter.ranges, state.landed, strict=True):
            if not landed:
                mask[a:b] = False
        return mask

    def _retire(self, state: State) -> State:
        """Take broken points that are far away off the grid."""
        candidate = self._on_grid(state) & ~state.stray
        far = find_strays(state.particles.position, state.peak, candidate, self._reach)
        if not bool(far.any()):
            return state
        self._params, self._blocks = None, None
        particles = state.particles
        particles = particles.replace(strain=particles.strain.masked_fill(far[:, None], 0.0))
        return state._replace(
            particles=particles,
            stray=state.stray | far,
            stress=state.stress.masked_fill(far[:, None], 0.0),
        )

    def _look(self, state: State) -> None:
        """Read speeds and stiffness; choose the time step and the parameters of the return map."""
        dx = self.matter.dx
        if self._params is None:
            self._rows = self._active(state)
        rows = self._rows
        particles = state.particles if rows is None else state.particles.select(rows)
        peak = state.peak if rows is None else state.peak[rows]
        material = particles.material
        table = self.matter.params
        speed = particles.velocity.norm(dim=1).max()
        wave = _wave_speed(particles.strain, table[material]).max()
        # Broken points carry no stress, so how fast they are torn does not matter.
        turn = torch.linalg.matrix_norm(particles.affine)
        gradient = torch.where(peak < 0, turn, torch.zeros_like(turn)).max()
        driven = self.rigid.speed(state.colliders).to(speed)
        looked = torch.stack([torch.maximum(speed, driven), wave, gradient])
        self._speed, fastest, steepest = looked.tolist()
        if not (self._speed < 1e6 and fastest < 1e6):
            raise Unhealthy(f"speed {self._speed:.3g} m/s, wave speed {fastest:.3g} m/s")
        for flight, landed in zip(self.flights, state.landed, strict=True):
            if not landed:
                self._speed = max(self._speed, self._flight_speed(flight, state.time))
        step = self.cfl * dx / (fastest + self._speed)
        if steepest > 0:
            # The floor of a quarter keeps one wild point from freezing the whole scene.
            step = max(min(step, GRADIENT_LIMIT / steepest), 0.25 * step)
        self._limit = step
        if self.irreversible and bool((peak > 0).any()):
            params = table[material].clone()
            params[:, 3] *= 1.0 - (peak / WEAKENING).clamp(0.0, 1.0)
            self._params, self._law = params, self.matter.law[material]
            self._fields = None
        elif self._params is None or self._fields is None:
            self._params, self._law, self._fields = table, self.matter.law, material

    def _step(self, state: State, dt: float, *, last: bool, until: float) -> State:
        dx = self.matter.dx
        rows = self._rows
        active = state.particles if rows is None else state.particles.select(rows)
        stress = state.stress if rows is None else state.stress[rows]
        # The speed may grow between two looks; a quarter more covers it.
        reach = 1.25 * self._speed * dt + 10.0 * dt * dt
        blocks = self._blocks
        if blocks is None or blocks.expired(self._travelled + reach, dx):
            blocks = self._build(state, active)
        self._travelled += reach
        fields = len(self.matter.ranges) if self._contact else 1
        body = active.body if self._contact else None
        grid, moments = ops.p2g(
            active.position, active.velocity, active.affine, active.mass,
            dx=dx, blocks=blocks, dt=dt, stress=stress, volume=active.volume,
            body=body, fields=fields, contact=self._contact,
        )  # fmt: skip
        velocity_grid, impulse, torque, _ = ops.grid_update(
            grid, dx=dx, dt=dt, blocks=blocks, gravity=self.scene.gravity,
            colliders=state.colliders.to(grid.dtype), sdf=self.rigid.sdf, moments=moments,
            friction=self.scene.friction, restitution=self.scene.restitution, return_torque=True,
        )  # fmt: skip
        position, velocity, affine, deformation, skipped = ops.g2p(
            velocity_grid, active.position, dx=dx, dt=dt, blocks=blocks, body=body,
            deformation=active.deformation, velocity=active.velocity, return_skipped=True,
        )  # fmt: skip
        strain, alpha, stress, info = ops.return_mapping(
            active.strain, active.alpha, dt * affine,
            law=self._law, params=self._params, material=self._fields, dt=dt, **self.return_map,
        )  # fmt: skip
        moved = active.replace(
            position=position, velocity=velocity, affine=affine, deformation=deformation,
            strain=strain, alpha=alpha,
        )  # fmt: skip
        self._count(dt, active.count, info, skipped)
        peak = torch.maximum(state.peak if rows is None else state.peak[rows], alpha)
        total = state.impulse if impulse.numel() == 0 else state.impulse + impulse.sum(dim=0)
        if rows is not None:
            self.counters.flight_body_steps += sum(not on for on in state.landed)
            moved = _scatter(state.particles, rows, moved)
            peak = state.peak.index_copy(0, rows, peak)
            stress = state.stress.index_copy(0, rows, stress)
        if self._strays.numel():
            moved, push = drift(moved, self._strays, dt, self.scene.gravity, self.scene.floor)
            total = total + push
        return state._replace(
            particles=moved,
            peak=peak,
            stress=stress,
            time=until if last else state.time + dt,
            step=state.step + 1,
            impulse=total,
            colliders=self.rigid.advance(state.colliders, state.time, dt, impulse, torque),
            work=state.work + self.rigid.work(state.colliders, impulse, torque),
        )

    def _build(self, state: State, active: Particles) -> ops.Blocks:
        """Find the active blocks anew and decide whether the contact pass is needed."""
        try:
            blocks = ops.build_blocks(active.position, self.matter.dx)
        except ValueError as error:
            raise Unhealthy(str(error)) from error
        self._blocks, self._travelled = blocks, 0.0
        self.counters.block_builds += 1
        self.counters.blocks_max = max(self.counters.blocks_max, blocks.block_count)
        self._contact = sum(state.landed) > 1 and self._bodies_meet(active)
        return blocks

    def _bodies_meet(self, active: Particles) -> bool:
        """Tell whether two bodies come within reach of a common node before the next build."""
        dx = self.matter.dx
        numbers = torch.unique(active.body).tolist()
        points = [active.position[active.body == number] for number in numbers]
        boxes = [tuple(v.to("cpu", torch.float64) for v in torch.aminmax(p, dim=0)) for p in points]
        for i in range(len(points)):
            for j in range(i):
                # Kernel reach of both (2 x 1.5) plus the slack of the blocks on both sides.
                if _boxes_meet(boxes[i], boxes[j], 5.0 * dx) and _cells_meet(
                    points[i], points[j], 4.0 * dx
                ):
                    return True
        return False

    def _count(self, dt: float, count: int, info: Tensor, skipped: Tensor) -> None:
        counters = self.counters
        counters.steps += 1
        counters.particle_steps += count
        counters.dt_min = min(counters.dt_min, dt)
        counters.dt_max = max(counters.dt_max, dt)
        counters.contact_steps += self._contact
        counters.contact_steps_skipped += not self._contact
        counters.return_map = counters.return_map + info.to(torch.int64)
        self.lost = self.lost + skipped + info[3]


def _boxes_meet(a: tuple[Tensor, ...], b: tuple[Tensor, ...], pad: float) -> bool:
    return bool(((a[0] - pad <= b[1]) & (b[0] - pad <= a[1])).all())


def _cells_meet(a: Tensor, b: Tensor, edge: float) -> bool:
    """Tell whether points of both lie in the same or in neighbouring cubes of ``edge``."""
    cells_a, cells_b = (torch.unique(torch.floor(p / edge).to(torch.int64), dim=0) for p in (a, b))
    if cells_a.shape[0] > cells_b.shape[0]:
        cells_a, cells_b = cells_b, cells_a
    # Few cubes each: the full table of distances is small (thousands squared at most).
    for chunk in cells_a.split(1024):
        if bool(((chunk[:, None] - cells_b[None]).abs().amax(dim=2) <= 1).any()):
            return True
    return False


def _wave_speed(strain: Tensor, params: Tensor) -> Tensor:
    """Speed of the pressure wave in the stretched material [m/s], [N].

    For a uniaxial state of the neo-Hookean law (equations.md 2.1) the acoustic modulus in the
    current configuration is ``kappa (1 + J^2) / 2 + (2 mu / 9) (J^(4/3) + 5 J^(-2/3))``: it grows
    with stretch through its first term and with compression through its last.
    """
    xx, yy, zz, xy, xz, yz = (strain + strain.new_tensor([1, 1, 1, 0, 0, 0])).unbind(-1)
    squared = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    squared = torch.where(squared < 1e-4, squared.new_tensor(1e-4), squared)  # keeps NaN
    third = squared ** (1.0 / 3.0)  # J^(2/3)
    mu, kappa, density = params[:, 0], params[:, 1], params[:, 6]
    modulus = 0.5 * kappa * (1.0 + squared) + 2.0 / 9.0 * mu * (third * third + 5.0 / third)
    return torch.sqrt(modulus / density)


def _scatter(whole: Particles, rows: Tensor, part: Particles) -> Particles:
    """Return ``whole`` with ``rows`` replaced by ``part``."""
    changed = {}
    for name in ("position", "velocity", "affine", "strain", "alpha", "deformation"):
        old, new = getattr(whole, name), getattr(part, name)
        if old is not None and new is not None:
            changed[name] = old.index_copy(0, rows, new)
    return whole.replace(**changed)
