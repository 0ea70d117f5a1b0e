"""The resident solver: a simulation whose state stays on the device from step to step.

:class:`Solver` advances many explicit MLS-MPM steps per call without a look from the host: the
time step, the search for active blocks, the re-sorting of particles and the stopping time are
decided on the device (``csrc/core/solver_clock.h``). The composable operators
(:func:`gsfluent.ops.p2g` and its siblings) are the differentiable face of the same mathematics and
the reference it is tested against.

Sources: Hu et al. 2018 (MLS-MPM), Jiang et al. 2015 (APIC), Wang et al. 2020 and Fei et al. 2021
(block-sorted GPU transfers); fixed-point sums: docs/solver.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from gsfluent._check import check_tensor
from gsfluent.errors import GsfluentError
from gsfluent.ops import solver_buffers as layout
from gsfluent.ops.blocks import check_dx
from gsfluent.ops.collider import pad_colliders
from gsfluent.ops.plasticity import return_mapping
from gsfluent.ops.solver_buffers import INDEX

ELASTIC, NACC, LAWS = 0, 1, 7
_REASONS = {
    1: (
        "a speed, a wave speed or a strain is not finite",
        "start from finite values, or lower cfl",
    ),
    2: ("a point moved further than a cell in one step", "lower dt, or let the step be automatic"),
    3: (
        f"more than {layout.SITE_FIELDS} bodies share one block of 4 cells",
        "give bodies that touch fewer field numbers, or lower dx",
    ),
    4: (
        f"a point is further than {4 * layout.BLOCK_RANGE} cells from the origin",
        "remove points that fly away, or raise dx",
    ),
    5: ("the time step is too small for the present time to resolve", "look at the stiffest law"),
}


class SolverError(GsfluentError, RuntimeError):
    """The solver stopped before the time it was asked for.

    Args:
        reason: Number in ``SolverReason`` (``csrc/core/solver_state.h``).
        time: Simulated time at which it stopped [s].
        step: Steps so far.
    """

    def __init__(self, reason: int, time: float, step: int) -> None:
        what, mend = _REASONS.get(reason, (f"reason {reason}", "report this"))
        self.reason, self.time, self.step = reason, time, step
        super().__init__(f"solver: t = {time:.6g} s, step {step}: {what}\n  mend: {mend}")


class Solver:
    """Material points that live on a device and move in time.

    Args:
        position: Positions [m], [N, 3], float32 or float64 (the dtype of the whole state). They are
            kept relative to their cell, so distance from the origin costs no digits inside.
        velocity: Velocities [m/s], [N, 3].
        mass: Masses [kg], [N].
        volume: Volumes at rest [m^3], [N].
        dx: Node spacing [m].
        law: Law of each material row, int32 [M].
        params: Parameters of each row, [M, 8]; columns of :func:`gsfluent.ops.return_mapping`,
            with the density [kg/m^3] in column 6.
        material: Row of each point, int32 [N]; default: row 0.
        strain: Strain ``b - I``, [N, 6]; default: none.
        alpha: Log plastic volume ratio (NACC), [N]; default: zero.
        peak: Largest alpha so far, [N]; default: ``alpha``.
        affine: APIC matrix C [1/s], [N, 3, 3]; default: zero.
        deformation: Total deformation gradient, [N, 3, 3]; given, it is tracked.
        body: Velocity field of each point, int32 [N]; points of different fields feel each other by
            contact only. Default: one field.
        gravity: Acceleration [m/s^2].
        colliders: Rows of :func:`gsfluent.ops.grid_update`, [K, columns].
        sdf: Values of all distance grids that ``colliders`` name, float32 [M].
        friction: Coulomb friction between fields.
        restitution: Restitution of node contact between fields.
        contact_gap: Distance of the centroids, in cells, up to which fields touch.
        cfl: Courant number of the automatic time step.
        gradient_limit: Largest ``dt |grad v|`` of unbroken matter.
        dt: Fixed time step [s]; default: automatic.
        k: Exponent of the dynamic centre (NACC).
        epsilon: Its regularisation.
        implicit: Whether alpha is solved implicitly.
        irreversible: Whether broken points lose their cohesion for good.

    Raises:
        TypeError: Wrong type or dtype.
        ValueError: Wrong shape, device or range; values that are not finite; no particles.
    """

    def __init__(
        self,
        position: Tensor,
        velocity: Tensor,
        mass: Tensor,
        volume: Tensor,
        *,
        dx: float,
        law: Tensor,
        params: Tensor,
        material: Tensor | None = None,
        strain: Tensor | None = None,
        alpha: Tensor | None = None,
        peak: Tensor | None = None,
        affine: Tensor | None = None,
        deformation: Tensor | None = None,
        body: Tensor | None = None,
        gravity: Sequence[float] = (0.0, 0.0, -9.81),
        colliders: Tensor | None = None,
        sdf: Tensor | None = None,
        friction: float = 0.3,
        restitution: float = 0.0,
        contact_gap: float = 1.0,
        cfl: float = 0.5,
        gradient_limit: float = 0.3,
        dt: float | None = None,
        k: float = 2.0,
        epsilon: float = 0.1,
        implicit: bool = True,
        irreversible: bool = True,
    ) -> None:
        op = "Solver"
        check_tensor(op, "position", position, shape=(None, 3))
        n = position.shape[0]
        if not 0 < n <= layout.MAX_PARTICLES:
            raise ValueError(f"{op}: position must have 1 to {layout.MAX_PARTICLES} rows, got {n}")
        like = velocity
        check_tensor(op, "velocity", velocity, shape=(n, 3))
        for name, value in (("mass", mass), ("volume", volume)):
            check_tensor(op, name, value, shape=(n,), like=like)
            if not bool(((value > 0) & torch.isfinite(value)).all()):
                raise ValueError(f"{op}: {name} must be positive and finite")
        optional = (
            ("strain", strain, (n, 6)), ("alpha", alpha, (n,)), ("peak", peak, (n,)),
            ("affine", affine, (n, 3, 3)), ("deformation", deformation, (n, 3, 3)),
        )  # fmt: skip
        for name, given, shape in optional:
            if given is not None:
                check_tensor(op, name, given, shape=shape, like=like)
        check_tensor(op, "law", law, shape=(None,), dtype=torch.int32)
        check_tensor(op, "params", params, shape=(law.shape[0], 8))
        self.dx = check_dx(op, dx)
        self.device, self.dtype, self.count = velocity.device, velocity.dtype, n
        self.gravity = tuple(float(g) for g in gravity)
        if len(self.gravity) != 3 or not all(math.isfinite(g) for g in self.gravity):
            raise ValueError(f"{op}: gravity must be three finite numbers, got {gravity}")
        if not 0.0 < cfl <= 1.0:
            raise ValueError(f"{op}: cfl must lie in (0, 1], got {cfl}")
        if dt is not None and not (math.isfinite(dt) and dt > 0.0):
            raise ValueError(f"{op}: dt must be positive, got {dt}")
        laws = set(law.tolist())
        if not laws <= set(range(LAWS)):
            raise ValueError(f"{op}: law must lie in 0 to {LAWS - 1}, got {sorted(laws)}")
        self._law_set = 0 if laws <= {ELASTIC} else 1 if laws <= {ELASTIC, NACC} else 2
        self.irreversible, self.implicit, self.k, self.epsilon = irreversible, implicit, k, epsilon
        self.friction, self.restitution, self.contact_gap = friction, restitution, contact_gap
        self._fixed = dt
        self._primed = False

        self._params, self._law = params.to(velocity), law.to(self.device)
        row, rows, row_law = self._rows(material, mass, volume)
        b = layout.empty_buffers(velocity, n)
        b.law, b.rows = row_law, rows
        if colliders is not None and colliders.shape[0] > 0:
            b.colliders = pad_colliders(colliders).to(velocity).clone().contiguous()
            b.collider_state = pad_colliders(colliders).to(self.device, torch.float64).clone()
            shape = (colliders.shape[0], layout.IMPULSE_SUMS)
            b.impulse_units = torch.zeros(shape, dtype=torch.int64, device=self.device)
            b.impulse = torch.zeros(shape, dtype=torch.float64, device=self.device)
            if sdf is not None:
                check_tensor(op, "sdf", sdf, shape=(None,), dtype=torch.float32)
                b.sdf = sdf.to(self.device).contiguous()
        self._buffers = b
        zero = velocity.new_zeros
        start = alpha if alpha is not None else zero(n)
        values = {
            "velocity": velocity,
            "slope": (affine if affine is not None else zero(n, 3, 3)).reshape(n, 9)
            * mass[:, None],
            "strain": strain if strain is not None else zero(n, 6),
        }
        if self._law_set > 0:
            values["alpha"] = start
            values["peak"] = peak if peak is not None else start
        if deformation is not None:
            values["deformation"] = deformation.reshape(n, 9)
        self._load(position, values, row, body)
        heaviest = float(mass.max())
        bits = min(52, 62 - max(0, math.ceil(math.log2(0.43 * n))))
        self._write(
            cfl=cfl, gradient_limit=gradient_limit, dt_scale=1.0, dt_fixed=dt or 0.0,
            mass_unit=math.ldexp(1.0, math.frexp(heaviest)[1] + 1 - bits), unit_bits=bits,
        )  # fmt: skip

    # --- loading ---

    def _rows(
        self, material: Tensor | None, mass: Tensor, volume: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Rows of (parameters, mass, volume) that occur, and the row of each point."""
        n, count = self.count, self._law.shape[0]
        if material is None:
            material = torch.zeros(n, dtype=torch.int32, device=self.device)
        check_tensor("Solver", "material", material, shape=(n,), dtype=torch.int32)
        if not bool(((material >= 0) & (material < count)).all()):
            raise ValueError(f"Solver: material must lie in 0 to {count - 1} (rows of law)")
        facts = torch.stack([material.to(torch.float64), mass.double(), volume.double()], dim=1)
        unique, row = torch.unique(facts, dim=0, return_inverse=True)
        if unique.shape[0] > layout.MAX_ROWS:
            raise ValueError(
                f"Solver: {unique.shape[0]} different (material, mass, volume), at most "
                f"{layout.MAX_ROWS}; give points of one material the same mass and volume"
            )
        which = unique[:, 0].long()
        density = self._params[which, 6:7].double().clamp(min=1e-30)
        derived = torch.cat([1.0 / density, 4.0 * unique[:, 2:] / self.dx**2], dim=1)
        numbers = torch.cat([unique[:, 1:], derived], dim=1)
        rows = torch.cat([self._params[which], numbers.to(self._params)], dim=1)
        return row.to(torch.int64), rows.contiguous(), self._law[which].contiguous()

    def _load(
        self, position: Tensor, values: dict[str, Tensor], row: Tensor, body: Tensor | None
    ) -> None:
        """Group the points by block and field and store them."""
        b, n = self._buffers, self.count
        if body is None:
            body = torch.zeros(n, dtype=torch.int32, device=self.device)
        check_tensor("Solver", "body", body, shape=(n,), dtype=torch.int32)
        low, high = int(body.min()), int(body.max())
        if low < 0 or high >= layout.MAX_FIELDS:
            raise ValueError(
                f"Solver: body must lie in 0 to {layout.MAX_FIELDS - 1}, got {low} to {high}"
            )
        self.fields = high + 1
        u = position.to(self.device, torch.float64) / self.dx - 0.5
        limit = 4.0 * (layout.BLOCK_RANGE - 2)
        if not bool((u.abs() < limit).all()):
            wrong = int((~(u.abs() < limit)).any(dim=1).sum())
            raise ValueError(
                f"Solver: position must be finite and within {limit:.0f} cells of the origin, "
                f"got {wrong} of {n} rows that are not"
            )
        for name, value in values.items():
            if not bool(torch.isfinite(value).all()):
                raise ValueError(f"Solver: {name} must be finite")
        cell = torch.floor(u)
        offset = (u - cell).to(self.dtype)
        over = offset >= 1.0
        cell = (cell + over).long()
        offset = offset.masked_fill(over, 0.0)
        block = cell >> 2
        key = self._keys(block, body.long())
        unique, owner, counts = torch.unique(key, return_inverse=True, return_counts=True)
        order = torch.argsort(owner, stable=True)
        local = (cell - 4 * block + 1)[order]
        word = local[:, 0] | local[:, 1] << 3 | local[:, 2] << 6 | row[order] << 9
        # The word is unsigned on the device; wrap it into the signed type torch has.
        b.meta = torch.where(word >= 2**31, word - 2**32, word).to(torch.int32)
        b.offset = self._stored(offset[order])
        b.id = order.to(torch.int32)
        for name, value in values.items():
            setattr(b, name, self._stored(value[order].to(self.dtype)))
        coord = self._unkey(unique)
        homes, reach = unique.shape[0], self._reach(coord)
        b.reserve_blocks(homes + homes // 2 + 64, reach + reach // 3 + 64, self.fields)
        b.home_coord0[:homes] = coord.to(torch.int32)
        b.home_count0[:homes] = counts.to(torch.int32)
        b.home_start0[:homes] = (torch.cumsum(counts, 0) - counts).to(torch.int32)
        self._write(homes=homes, parity=0, rebuild=1, done=1, grow=0, reason=0)
        self._primed = False

    @staticmethod
    def _keys(block: Tensor, field: Tensor) -> Tensor:
        shift = block + layout.BLOCK_RANGE
        return ((shift[:, 0] << 17 | shift[:, 1]) << 17 | shift[:, 2]) << 12 | field

    @staticmethod
    def _unkey(key: Tensor) -> Tensor:
        parts = [key >> 46, key >> 29, key >> 12]
        block = [(part & (2**17 - 1)) - layout.BLOCK_RANGE for part in parts]
        return torch.stack([*block, key & (2**12 - 1)], dim=1)

    def _reach(self, coord: Tensor) -> int:
        """Number of blocks that windows of these homes can touch at most."""
        axis = torch.arange(-1, 2, device=coord.device)
        step = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).view(27, 3)
        block = (coord[:, None, :3] + step).reshape(-1, 3)
        field = coord[:, 3].repeat_interleave(27)
        return int(torch.unique(self._keys(block, field)).shape[0])

    # --- the clock ---

    def _write(self, **values: float) -> None:
        clock = self._buffers.clock.cpu()
        real = clock.view(torch.float64)
        for name, value in values.items():
            if name in layout.FLOATS:
                real[INDEX[name]] = value
            else:
                clock[INDEX[name]] = int(value)
        self._buffers.clock.copy_(clock)

    def clock(self) -> dict[str, float]:
        """Return every member of the clock; waits for the device."""
        clock = self._buffers.clock.cpu()
        whole, real = clock.tolist(), clock.view(torch.float64).tolist()
        return {
            name: real[i] if name in layout.FLOATS else whole[i]
            for i, name in enumerate(layout.CLOCK)
        }

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return float(self.clock()["time"])

    @property
    def steps(self) -> int:
        """Steps so far."""
        return int(self.clock()["step"])

    @property
    def dt(self) -> float:
        """Length of the last step [s]."""
        return float(self.clock()["dt"])

    @property
    def dt_scale(self) -> float:
        """Factor on the automatic time step (halved by a roll-back)."""
        return float(self.clock()["dt_scale"])

    @dt_scale.setter
    def dt_scale(self, value: float) -> None:
        self._write(dt_scale=value)

    def memory(self) -> int:
        """Return the bytes of every tensor of the solver."""
        return self._buffers.memory()

    def _settings(self) -> tuple[list[int], list[float]]:
        ints = [self.fields, int(self.implicit), int(self.irreversible), self._law_set]
        floats = [
            self.dx, *self.gravity, self.friction, self.restitution, self.contact_gap, self.k,
            self.epsilon,
        ]  # fmt: skip
        return ints, floats

    # --- moving ---

    def advance(self, until: float | None = None, *, steps: int | None = None) -> None:
        """Advance to a time, by a number of steps, or to whichever comes first.

        The last step is shortened so that a time is met exactly. With a fixed ``dt`` the number of
        steps is ``until`` divided by it, rounded.

        Args:
            until: Time to reach [s].
            steps: Number of steps at most.

        Raises:
            ValueError: Neither is given, or one is not a number.
            SolverError: The state went bad, or a point left its window; the state is that of the
                step that failed (take :meth:`snapshot` before to go back).
        """
        if until is None and steps is None:
            raise ValueError("Solver.advance: give until, steps or both")
        if until is not None and not math.isfinite(until):
            raise ValueError(f"Solver.advance: until must be finite, got {until}")
        if steps is not None and steps < 0:
            raise ValueError(f"Solver.advance: steps must not be negative, got {steps}")
        now = self.clock()
        if self._fixed is not None and until is not None:
            whole = max(0, round((until - now["time"]) / self._fixed))
            steps = whole if steps is None else min(whole, steps)
            until = None
        if steps == 0 or (until is not None and until <= now["time"]):
            return
        left = -1 if steps is None else steps
        # Every call starts from new blocks, so that nothing depends on what was built before it.
        self._write(
            until=1e300 if until is None else until,
            steps_left=left,
            done=0,
            reason=0,
            lost=0,
            leaving=0,
            rebuild=1,
        )
        ints, floats = self._settings()
        with torch.no_grad():
            torch.ops.gsfluent.solver_prime(self._buffers.listed(), ints, floats)
            while True:
                now = self.clock()
                if now["reason"]:
                    self._write(done=1, rebuild=1)
                    raise SolverError(int(now["reason"]), now["time"], int(now["step"]))
                if now["done"]:
                    return
                if now["grow"]:
                    self._grow(now)
                rounds = self._rounds(now)
                torch.ops.gsfluent.solver_run(
                    self._buffers.listed(), ints, floats, rounds, self.steps_per_round
                )

    steps_per_round = 8
    """Steps between two chances to build blocks on a GPU."""

    def _rounds(self, now: dict[str, float]) -> int:
        """How many rounds to enqueue before the clock is looked at again."""
        left = now["steps_left"] if now["steps_left"] >= 0 else math.inf
        if now["dt"] > 0.0:
            left = min(left, (now["until"] - now["time"]) / now["dt"])
        left = min(left, 4096.0)
        built = now["builds"] / max(now["step"], 1.0)  # rounds end early for new blocks
        return math.ceil(left * (1.0 / self.steps_per_round + 0.6 * min(built, 1.0))) + 1

    def _grow(self, now: dict[str, float]) -> None:
        """Make room for more blocks; every present value is kept."""
        b = self._buffers
        homes = max(int(1.5 * now["wanted_homes"]) + 64, b.home_start0.shape[0])
        slots = max(int(1.5 * now["wanted_slots"]) + 64, b.slot_next.shape[0])
        b.reserve_blocks(homes, slots, self.fields)
        self._write(grow=0, rebuild=1)

    # --- reading ---

    def _owners(self) -> Tensor:
        """Block and field of each stored point, int64 [N, 4]."""
        b, now = self._buffers, self.clock()
        side, homes = str(int(now["parity"])), int(now["homes"])
        start = getattr(b, f"home_start{side}")[:homes].long()
        order = torch.argsort(start)
        counts = getattr(b, f"home_count{side}")[:homes].long()[order]
        return (
            getattr(b, f"home_coord{side}")[:homes]
            .long()[order]
            .repeat_interleave(counts, dim=0, output_size=self.count)
        )

    def _stored(self, values: Tensor) -> Tensor:
        """Values as the device has them: component by component on a GPU."""
        planar = self.device.type == "cuda" and values.dim() == 2
        return (values.T if planar else values).clone(memory_format=torch.contiguous_format)

    def _rowwise(self, name: str) -> Tensor:
        """Stored values with one row per point."""
        value = getattr(self._buffers, name)
        return value.T if self.device.type == "cuda" and value.dim() == 2 else value

    def _restored(self, values: Tensor) -> Tensor:
        """Bring stored values into the order of loading."""
        out = torch.empty_like(values, memory_format=torch.contiguous_format)
        out[self._buffers.id.long()] = values
        return out

    @property
    def position(self) -> Tensor:
        """Positions [m], float64 [N, 3]."""
        b = self._buffers
        word = b.meta.long() & 0x1FF
        local = torch.stack([word & 7, word >> 3 & 7, word >> 6 & 7], dim=1)
        cell = 4 * self._owners()[:, :3] - 1 + local
        return self._restored((cell.double() + 0.5 + self._rowwise("offset").double()) * self.dx)

    @property
    def body(self) -> Tensor:
        """Velocity field of each point, int32 [N]."""
        return self._restored(self._owners()[:, 3].to(torch.int32))

    @property
    def velocity(self) -> Tensor:
        """Velocities [m/s], [N, 3]."""
        return self._restored(self._rowwise("velocity"))

    @property
    def affine(self) -> Tensor:
        """APIC matrix C [1/s], [N, 3, 3]."""
        b = self._buffers
        row = b.meta.long() >> 9 & (layout.MAX_ROWS - 1)
        return self._restored(self._rowwise("slope") / b.rows[row, 8, None]).view(-1, 3, 3)

    @property
    def strain(self) -> Tensor:
        """Strain ``b - I``, [N, 6]."""
        return self._restored(self._rowwise("strain"))

    @property
    def alpha(self) -> Tensor:
        """Log plastic volume ratio, [N]; zero when no law uses it."""
        return self._scalar("alpha")

    @property
    def peak(self) -> Tensor:
        """Largest alpha so far, [N]; zero when no law uses it."""
        return self._scalar("peak")

    def _scalar(self, name: str) -> Tensor:
        value = getattr(self._buffers, name)
        if value.numel() == 0:
            return torch.zeros(self.count, dtype=self.dtype, device=self.device)
        return self._restored(value)

    @property
    def deformation(self) -> Tensor | None:
        """Total deformation gradient, [N, 3, 3], or None when it is not tracked."""
        if self._buffers.deformation.numel() == 0:
            return None
        return self._restored(self._rowwise("deformation")).view(-1, 3, 3)

    @property
    def stress(self) -> Tensor:
        """Kirchhoff stress of the present state [Pa], [N, 6]."""
        b = self._buffers
        row = (b.meta.long() >> 9 & (layout.MAX_ROWS - 1)).to(torch.int32)
        strain = self._rowwise("strain").contiguous()
        alpha = b.alpha if b.alpha.numel() else strain.new_zeros(self.count)
        params = b.rows[:, :8].contiguous()
        _, _, stress, _ = return_mapping(
            strain, alpha, strain.new_zeros(self.count, 3, 3), law=b.law, params=params,
            material=row, k=self.k, epsilon=self.epsilon, implicit=self.implicit,
        )  # fmt: skip
        return self._restored(stress)

    def set_colliders(self, colliders: Tensor) -> None:
        """Replace the rows of the colliders, as many as there were; impulses go on adding up.

        Args:
            colliders: Rows of :func:`gsfluent.ops.grid_update`, [K, columns].

        Raises:
            ValueError: Another number of rows.
        """
        rows, have = pad_colliders(colliders), self._buffers.colliders
        if rows.shape != have.shape:
            raise ValueError(
                f"Solver.set_colliders: colliders must have shape {list(have.shape)}, "
                f"got {list(rows.shape)}"
            )
        have.copy_(rows)

    @property
    def impulse(self) -> Tensor:
        """Impulse given to the matter by each collider since the start [N s], float64 [K, 3]."""
        return self._buffers.impulse[:, :3].clone()

    @property
    def torque(self) -> Tensor:
        """Angular impulse on the matter by each collider about its point [N m s], [K, 3]."""
        return self._buffers.impulse[:, 3:6].clone()

    @property
    def colliders(self) -> Tensor:
        """The colliders where they are now, float64 [K, columns]."""
        return self._buffers.collider_state.clone()

    def counters(self) -> dict[str, float]:
        """Return what was done: steps, builds, blocks, plastic, guarded and inverted points, ..."""
        now = self.clock()
        names = (
            "step", "particle_steps", "builds", "homes", "slots", "homes_max", "slots_max",
            "sites", "shared_sites", "plastic", "guarded", "inverted", "invalid", "contact_nodes",
            "contact_steps", "dt_min", "dt_max", "speed_seen", "wave_seen",
        )  # fmt: skip
        return {name: now[name] for name in names}

    # --- going back ---

    _MOVING = ("clock", "offset", "meta", "velocity", "slope", "strain", "alpha", "peak",
               "deformation", "id", "impulse", "colliders", "collider_state", "home_coord0",
               "home_start0", "home_count0", "home_coord1", "home_start1",
               "home_count1")  # fmt: skip

    def snapshot(self) -> dict[str, Any]:
        """Copy everything that changes, for :meth:`restore`."""
        return {name: getattr(self._buffers, name).clone() for name in self._MOVING}

    def restore(self, saved: dict[str, Any]) -> None:
        """Go back to a :meth:`snapshot` of this solver."""
        b = self._buffers
        for name, value in saved.items():
            target = getattr(b, name)
            if target.shape == value.shape:
                target.copy_(value)
            else:  # room for blocks has grown since
                target.zero_()
                target[: value.shape[0]] = value
        b.sums.zero_()
        b.moments.zero_()
        b.impulse_units.zero_()
        self._write(rebuild=1, done=1, grow=0, reason=0, touched=0, lost=0, leaving=0)
