"""What a resident solver holds, and how it is loaded and read.

On the device points are grouped by block and field, positions are kept as cell and offset, and the
order changes from build to build; here they come back in the order they were given in.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from gsfluent._check import check_tensor
from gsfluent.materials.phase_field import MODELS
from gsfluent.ops import solver_buffers as layout
from gsfluent.ops.plasticity import LAWS, SLOW_UNLOADING, return_mapping, weakened
from gsfluent.ops.reference.phase_field import DRIVE_MAX, EMPTY
from gsfluent.ops.solver_buffers import INDEX
from gsfluent.ops.solver_ranks import Parts
from gsfluent.ops.viscous import viscous_step

UNBROKEN = -1.0
"""Peak alpha of points whose law does not break."""
MORE_LAWS, DAMAGE_FIELD, VISCOUS, VISCOUS_ANY = 3, 4, 5, 6
"""Sets of laws past the plain ones, ``LawSet`` of ``csrc/core/solver/particle.h``."""
REST = 1e-3
"""Share of the fastest speed below which the matter of a scene counts as resting on the whole."""


def sum_bits(count: int) -> int:
    """Bits of a fixed-point unit below its largest addend: sums of ``count`` of them fit 2^62."""
    return min(52, 62 - max(0, math.ceil(math.log2(0.43 * count))))


class SolverState:
    """State of :class:`gsfluent.ops.Solver`: loading it, and reading it in the order of loading.

    Attributes:
        device: Device of every tensor.
        dtype: Of the state.
        count: Points N.
        dx: Node spacing [m].
        fields: Velocity fields.
        frame: Velocity of the grid [m/s], float64 [3].
        irreversible: Whether broken points lose their cohesion for good.
        implicit, k, epsilon: Options of the return map.
    """

    device: torch.device
    dtype: torch.dtype
    count: int
    dx: float
    fields: int
    frame: Tensor
    irreversible: bool
    implicit: bool
    k: float
    epsilon: float
    _whole: layout.Buffers
    """Every tensor; of several ranks on CUDA without the points, while they are away."""
    _params: Tensor
    _law: Tensor
    _unused: dict[str, Tensor]
    """alpha and peak where no law uses them, as given."""
    _law_set: int
    _parts: Parts | None

    @property
    def _buffers(self) -> layout.Buffers:
        """Every tensor, with the points in them."""
        if self._parts is not None:
            self._parts.gather()
        return self._whole

    # --- loading ---

    def _frame(
        self,
        velocity: Tensor,
        mass: Tensor,
        body: Tensor | None,
        given: Sequence[float] | None,
        rests: bool,
    ) -> Tensor:
        """Velocity of the grid: as given, none, or the one in which most matter hardly moves."""
        none = torch.zeros(3, dtype=torch.float64, device=self.device)
        if given is not None:
            asked = torch.tensor([float(v) for v in given], dtype=torch.float64)
            if asked.shape != (3,) or not bool(torch.isfinite(asked).all()):
                raise ValueError(f"Solver: frame must be three finite numbers, got {given}")
            if rests and bool(asked.any()):
                raise ValueError(f"Solver: frame must be 0 where there are colliders, got {given}")
            return asked.to(self.device)
        if rests or not bool(torch.isfinite(velocity).all()):  # what is refused later
            return none
        m, v = mass.double().cpu(), velocity.double().cpu()
        index = torch.zeros_like(m, dtype=torch.int64) if body is None else body.long().cpu()
        if int(index.min()) < 0:
            return none
        whole = torch.bincount(index, m)
        momentum = torch.stack([torch.bincount(index, m * v[:, i]) for i in range(3)], dim=1)
        # by mass once more: a bullet does not move the grid through what it hits
        mean = (whole @ momentum) / (whole @ whole)
        fastest = float(v.norm(dim=1).max())
        if not float(mean.norm()) > REST * fastest:
            return none
        # without the digits that hang on the order of the points
        unit = math.ldexp(1.0, math.frexp(fastest)[1] - 24)
        return (unit * torch.round(mean / unit)).to(self.device)

    def _rows(
        self, material: Tensor | None, mass: Tensor, volume: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Rows of (parameters, mass, volume) that occur, and the row of each point.

        Columns after the parameters: ``csrc/core/solver/state.h``.
        """
        n, count = self.count, self._law.shape[0]
        if material is None:
            material = torch.zeros(n, dtype=torch.int32, device=self.device)
        check_tensor("Solver", "material", material, shape=(n,), dtype=torch.int32)
        if not bool(((material >= 0) & (material < count)).all()):
            raise ValueError(f"Solver: material must lie in 0 to {count - 1} (rows of law)")
        facts = torch.stack([material.to(torch.float64), mass.double(), volume.double()], dim=1)
        unique, row = _unique_rows(facts)
        if unique.shape[0] > layout.MAX_ROWS:
            raise ValueError(
                f"Solver: {unique.shape[0]} different (material, mass, volume), at most "
                f"{layout.MAX_ROWS}; give points of one material the same mass and volume"
            )
        which = unique[:, 0].long()
        density = self._params[which, 6:7].double().clamp(min=1e-30)
        mu, kappa = self._params[which, 0].double(), self._params[which, 1].double()
        pace = SLOW_UNLOADING * (density[:, 0] * (kappa + 4.0 / 3.0 * mu)).sqrt() * self.dx
        derived = torch.cat([1.0 / density, 4.0 * unique[:, 2:] / self.dx**2], dim=1)
        numbers = torch.cat([unique[:, 1:2], pace[:, None], derived], dim=1)
        rows = torch.cat([self._params[which], numbers.to(self._params)], dim=1)
        return row.to(torch.int64), rows.contiguous(), self._law[which].contiguous()

    def _damage_scale(self, law: Tensor, rows: Tensor) -> Tensor:
        """Units of the sums of the damage field, by the largest volume, history and stiffness.

        Returns:
            Four units, 1 of AT2, volume of an empty node (``csrc/core/solver/damage.h``), float64.
        """
        own = rows[law == LAWS["phase_field"]].double()
        most = float(own[:, 11].max())
        stiff = float((own[:, 11] * 2.0 * (own[:, 4] / self.dx) ** 2).max())
        bits = sum_bits(self.count)
        units = [
            math.ldexp(1.0, math.frexp(bound)[1] - bits)
            for bound in (most, most * DRIVE_MAX, stiff, most)
        ]
        at2 = float(int(own[0, 5]) >= MODELS["at2"])
        return own.new_tensor([*units, at2, EMPTY * most])

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
        b.id = order.to(torch.int32)
        rows = {name: value.index_select(0, order).to(self.dtype) for name, value in values.items()}
        self._store(offset[order], word, rows)
        coord = self._unkey(unique)
        homes, reach = unique.shape[0], self._reach(coord)
        b.reserve_blocks(homes + homes // 2 + 64, reach + reach // 3 + 64, self.fields)
        b.home_coord0[:homes] = coord.to(torch.int32)
        b.home_count0[:homes] = counts.to(torch.int32)
        b.home_start0[:homes] = (torch.cumsum(counts, 0) - counts).to(torch.int32)
        self._write(homes=homes, parity=0, rebuild=1, done=1, grow=0, reason=0)

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
        clock = self._whole.clock.cpu()
        real = clock.view(torch.float64)
        for name, value in values.items():
            if name in layout.FLOATS:
                real[INDEX[name]] = value
            else:
                clock[INDEX[name]] = int(value)
        self._whole.clock.copy_(clock)

    def clock(self) -> dict[str, float]:
        """Return every member of the clock; waits for the device."""
        clock = self._whole.clock.cpu()
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
        if not 0.0 < value < math.inf:
            raise ValueError(f"Solver: dt_scale must be positive, got {value}")
        self._write(dt_scale=value)

    def memory(self) -> int:
        """Return the bytes of every tensor of the solver."""
        return self._whole.memory() + (self._parts.memory() if self._parts else 0)

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

    def _store(self, offset: Tensor, word: Tensor, rows: dict[str, Tensor]) -> None:
        """Lay the rows out as ``csrc/core/solver/layout.h`` says."""
        b = self._buffers
        if self.device.type == "cuda":
            bits = layout.word_as_real(word, offset)[:, None]
            motion = torch.cat([rows.pop("velocity"), rows.pop("slope")], dim=1)
            b.offset = layout.planes(torch.cat([offset, bits], dim=1))
            b.velocity = layout.planes(motion)
            for name, value in rows.items():
                setattr(b, name, layout.planes(value) if value.dim() == 2 else value.contiguous())
            return
        # The word is unsigned there; wrap it into the signed type torch has.
        b.meta = torch.where(word >= 2**31, word - 2**32, word).to(torch.int32)
        b.offset = offset.contiguous()
        for name, value in rows.items():
            setattr(b, name, value.contiguous())

    def _rowwise(self, name: str) -> Tensor:
        """Stored values with one row per point."""
        b = self._buffers
        if self.device.type != "cuda":
            value: Tensor = getattr(b, name)
            return value
        if name == "offset":
            return layout.from_planes(b.offset, 4)[:, :3]
        if name in ("velocity", "slope"):
            motion = layout.from_planes(b.velocity, 12)
            return motion[:, :3] if name == "velocity" else motion[:, 3:]
        return layout.from_planes(getattr(b, name), 6 if name == "strain" else 9)

    def _words(self) -> Tensor:
        """Cell and row of each stored point, int64 [N]."""
        if self.device.type == "cuda":
            return layout.real_as_word(layout.from_planes(self._buffers.offset, 4)[:, 3])
        return self._buffers.meta.long() & (2**32 - 1)

    def _restored(self, values: Tensor) -> Tensor:
        """Bring stored values into the order of loading."""
        out = torch.empty_like(values, memory_format=torch.contiguous_format)
        return out.index_copy_(0, self._buffers.id.long(), values)

    @property
    def position(self) -> Tensor:
        """Positions [m], float64 [N, 3]."""
        word = self._words()
        local = torch.stack([word & 7, word >> 3 & 7, word >> 6 & 7], dim=1)
        cell = 4 * self._owners()[:, :3] - 1 + local
        place = (cell.double() + 0.5 + self._rowwise("offset").double()) * self.dx
        if bool(self.frame.any()):
            place = place + self.frame * self.time
        return self._restored(place)

    @property
    def body(self) -> Tensor:
        """Velocity field of each point, int32 [N]."""
        return self._restored(self._owners()[:, 3].to(torch.int32))

    @property
    def velocity(self) -> Tensor:
        """Velocities [m/s], [N, 3]."""
        velocity = self._rowwise("velocity")
        if bool(self.frame.any()):
            velocity = (velocity.double() + self.frame).to(velocity)
        return self._restored(velocity)

    @property
    def affine(self) -> Tensor:
        """APIC matrix C [1/s], [N, 3, 3]."""
        row = self._words() >> 9
        return self._restored(self._rowwise("slope") / self._buffers.rows[row, 8, None]).view(
            -1, 3, 3
        )

    @property
    def strain(self) -> Tensor:
        """Strain ``b - I``, [N, 6]."""
        return self._restored(self._rowwise("strain"))

    @property
    def alpha(self) -> Tensor:
        """Alpha of each point's law, [N]; as given where no law of the scene changes it."""
        return self._scalar("alpha")

    @property
    def peak(self) -> Tensor:
        """Largest alpha so far, [N]; -1 for points whose law does not break."""
        return self._scalar("peak")

    def _scalar(self, name: str) -> Tensor:
        if name in self._unused:
            return self._unused[name].clone()
        return self._restored(getattr(self._buffers, name))

    @property
    def deformation(self) -> Tensor | None:
        """Total deformation gradient, [N, 3, 3], or None when it is not tracked."""
        if self._buffers.deformation.numel() == 0:
            return None
        return self._restored(self._rowwise("deformation")).view(-1, 3, 3)

    @property
    def viscous(self) -> Tensor | None:
        """Viscosity of each point with its spring, [N, 9], or None without."""
        if self._buffers.viscous.numel() == 0:
            return None
        return self._restored(self._rowwise("viscous"))

    @property
    def stress(self) -> Tensor:
        """Kirchhoff stress of the present state [Pa], [N, 6]; of a liquid without its viscous part.

        That one belongs to the step, not to the state: it is viscosity times rate of strain.
        """
        b = self._buffers
        row = (self._words() >> 9).to(torch.int32)
        material: Tensor | None = row
        strain, broken = self._rowwise("strain").contiguous(), self._law_set > 0
        alpha = b.alpha if broken else strain.new_zeros(self.count)
        law, params = b.law, b.rows[:, :8].contiguous()
        if broken and (self.irreversible or self._law_set == DAMAGE_FIELD):
            (law, params), material = weakened(law, params, row, b.peak), None
        after, new_alpha, stress, _ = return_mapping(
            strain, alpha, strain.new_zeros(self.count, 3, 3), law=law, params=params,
            material=material, k=self.k, epsilon=self.epsilon, implicit=self.implicit,
            dt=1e-9,  # of a step without motion: what flows with a viscosity stays
        )  # fmt: skip
        if b.viscous.numel():
            own, none = self._rowwise("viscous"), strain.new_zeros(self.count, 3, 3)
            stress = viscous_step(
                own, strain, alpha, none, (after, new_alpha, stress), law=b.law,
                params=b.rows[:, :8].contiguous(), material=row, dt=0.0,
            )[3]  # fmt: skip
        return self._restored(stress)

    @property
    def impulse(self) -> Tensor:
        """Impulse given to the matter by each collider since the start [N s], float64 [K, 3]."""
        return self._whole.impulse[:, :3].clone()

    @property
    def torque(self) -> Tensor:
        """Angular impulse on the matter by each collider about its point [N m s], [K, 3]."""
        return self._whole.impulse[:, 3:6].clone()

    @property
    def colliders(self) -> Tensor:
        """The colliders where they are now, float64 [K, columns]."""
        return self._whole.collider_state.clone()

    def counters(self) -> dict[str, float]:
        """Return what was done: steps, builds, blocks, plastic, guarded and inverted points, ..."""
        now = self.clock()
        names = (
            "step", "particle_steps", "builds", "homes", "slots", "homes_max", "slots_max",
            "sites", "shared_sites", "plastic", "guarded", "inverted", "invalid", "contact_nodes",
            "contact_steps", "dt_min", "dt_max", "speed_seen", "wave_seen",
        )  # fmt: skip
        return {name: now[name] for name in names}


def _unique_rows(values: Tensor) -> tuple[Tensor, Tensor]:
    """``torch.unique(values, dim=0, return_inverse=True)``, column by column.

    Sorting whole rows takes a GPU ten times as long.
    """
    key = torch.zeros(values.shape[0], dtype=torch.int64, device=values.device)
    for column in values.unbind(1):
        if bool((column == column[0]).all()):
            continue
        found, index = torch.unique(column, return_inverse=True)
        key = key * found.shape[0] + index
    kinds, row = torch.unique(key, return_inverse=True)
    first = torch.zeros_like(kinds).scatter_(0, row, torch.arange(len(row), device=row.device))
    return values[first], row
