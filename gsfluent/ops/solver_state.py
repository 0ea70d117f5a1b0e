"""What a resident solver holds, and how it is loaded and read.

On the device points are grouped by block and field, positions are kept as cell and offset, and the
order changes from build to build; here they come back in the order they were given in.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from gsfluent._check import check_tensor
from gsfluent.errors import InputError
from gsfluent.materials.phase_field import MODELS
from gsfluent.ops import solver_buffers as layout
from gsfluent.ops import solver_points as points
from gsfluent.ops.plasticity import LAWS, SLOW_UNLOADING, return_mapping, weakened
from gsfluent.ops.reference.phase_field import DRIVE_MAX, EMPTY
from gsfluent.ops.solver_buffers import INDEX
from gsfluent.ops.solver_points import UNBROKEN
from gsfluent.ops.solver_ranks import Parts
from gsfluent.ops.viscous import viscous_step

MORE_LAWS, DAMAGE_FIELD, VISCOUS, VISCOUS_ANY, DAMAGE_QUIET = 3, 4, 5, 6, 7
"""Sets of laws past the plain ones, ``LawSet`` of ``csrc/core/solver/particle.h``."""
_VALUES = {"position", "body", "velocity", "affine", "strain", "alpha", "peak", "deformation",
           "viscous", "stress"}  # fmt: skip
REST = 1e-3
"""Share of the fastest speed below which the matter of a scene counts as resting on the whole."""


def sum_bits(count: int) -> int:
    """Bits of a fixed-point unit below its largest addend: sums of ``count`` of them fit 2^62."""
    return min(52, 62 - max(0, math.ceil(math.log2(0.43 * count))))


class SolverState:
    """State of :class:`gsfluent.ops.Solver`: loading it, and reading it in the order of loading.

    Attributes:
        device: Device of the state; of several, the one whose clock is read.
        outside: Where the points were given, and what is read of them goes.
        dtype: Of the state.
        count: Points N.
        dx: Node spacing [m].
        fields: Velocity fields.
        frame: Velocity of the grid [m/s], float64 [3] on the CPU.
        irreversible: Whether broken points lose their cohesion for good.
        implicit, k, epsilon: Options of the return map.
    """

    device: torch.device
    outside: torch.device
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
    """Every tensor; of several ranks on CUDA without the points."""
    _params: Tensor
    _law: Tensor
    _alpha: Tensor | None
    """As given, where no law uses it."""
    _widths: dict[str, int]
    """What is held of each point, and its components."""
    _law_set: int
    _parts: Parts | None

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
        none = torch.zeros(3, dtype=torch.float64)
        if given is not None:
            asked = torch.tensor([float(v) for v in given], dtype=torch.float64)
            if asked.shape != (3,) or not bool(torch.isfinite(asked).all()):
                raise ValueError(f"Solver: frame must be three finite numbers, got {given}")
            if rests and bool(asked.any()):
                raise ValueError(f"Solver: frame must be 0 where there are colliders, got {given}")
            return asked
        if rests or not bool(torch.isfinite(velocity).all()):  # what is refused later
            return none
        fields = 1 if body is None else int(body.max()) + 1
        if body is not None and int(body.min()) < 0:
            return none
        whole, momentum, fastest = none.new_zeros(fields), none.new_zeros(fields, 3), 0.0
        for part in points.stretches(0, self.count):
            m, v = mass[part].double().cpu(), velocity[part].double().cpu()
            index = torch.zeros(len(m), dtype=torch.int64) if body is None else body[part].long()
            index = index.cpu()
            whole += torch.bincount(index, m, fields)
            momentum += torch.stack(
                [torch.bincount(index, m * v[:, i], fields) for i in range(3)], dim=1
            )
            fastest = max(fastest, float(v.norm(dim=1).max()))
        # by mass once more: a bullet does not move the grid through what it hits
        mean = (whole @ momentum) / (whole @ whole)
        if not float(mean.norm()) > REST * fastest:
            return none
        # without the digits that hang on the order of the points
        unit = math.ldexp(1.0, math.frexp(fastest)[1] - 24)
        return unit * torch.round(mean / unit)

    def _rows(
        self, material: Tensor | None, mass: Tensor, volume: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Rows of (parameters, mass, volume) that occur, and the row of each point.

        Columns after the parameters: ``csrc/core/solver/state.h``.
        """
        if material is not None:
            check_tensor("Solver", "material", material, shape=(self.count,), dtype=torch.int32)
        row, unique = self._alike(material, mass, volume) or self._unlike(material, mass, volume)
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
        return row, rows.contiguous(), self._law[which].contiguous()

    def _alike(
        self, material: Tensor | None, mass: Tensor, volume: Tensor
    ) -> tuple[Tensor, Tensor] | None:
        """What :meth:`_unlike` finds, without a sort.

        None where points of one row of parameters differ, or there are very many.
        """
        count = self._law.shape[0]
        if max(self.count, count) > layout.MAX_ROWS:
            return None
        facts = torch.stack([mass, volume])
        if material is None:
            row, wrong = torch.zeros_like(mass, dtype=torch.int64), mass < 0
        else:
            row = material.long().clamp(0, count - 1)
            wrong = row != material
        table = facts.new_zeros(2, count).scatter_(1, row.expand(2, -1), facts)
        differs = (table.gather(1, row.expand(2, -1)) != facts).any(0)
        used = table[0] > 0.0
        unlike, all_used = torch.stack([(wrong | differs).any(), used.all()]).tolist()
        if unlike:
            return None
        numbers = torch.arange(count, device=table.device, dtype=torch.float64)
        unique = torch.cat([numbers[None], table.double()]).T
        if not all_used:  # a row without points must not be the one with the fastest waves
            row, unique = (torch.cumsum(used, 0) - 1)[row], unique[used]
        return row.to(torch.int32), unique.to(self.device)

    def _unlike(
        self, material: Tensor | None, mass: Tensor, volume: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The row of each point among the (material, mass, volume) that occur, and these."""
        count = self._law.shape[0]
        if material is not None and not bool(((material >= 0) & (material < count)).all()):
            raise ValueError(f"Solver: material must lie in 0 to {count - 1} (rows of law)")
        found: list[Tensor] = []
        row = torch.empty(self.count, dtype=torch.int32, device=self.outside)
        for part in points.stretches(0, self.count):
            facts = [mass.new_zeros(()).expand_as(mass)] if material is None else [material]
            facts = [fact[part].to(self.device, torch.float64) for fact in (*facts, mass, volume)]
            unique, index = _unique_rows(torch.stack(facts, dim=1))
            row[part] = index.to(row) + sum(map(len, found))
            found.append(unique)
        if len(found) > 1:
            unique, number = _unique_rows(torch.cat(found))
            for part in points.stretches(0, self.count):
                row[part] = number[row[part].to(self.device).long()].to(row)
        return row, unique

    def _damage_scale(self, law: Tensor, rows: Tensor) -> Tensor:
        """Units of the sums of the damage field, by the largest volume, history and stiffness.

        Returns:
            Four units, 1 of AT2, volume of an empty node, stiffness over volume where all matter
            has one length or else 0 (``csrc/core/solver/damage.h``), float64 [7].
        """
        own = rows[law == LAWS["phase_field"]].double()
        most = float(own[:, 11].max())
        each = 2.0 * (own[:, 4] * float(rows.new_tensor(1.0 / self.dx))) ** 2
        stiff = float((own[:, 11] * each).max())
        even = float(each[0]) if bool((each == each[0]).all()) else 0.0
        # in float the window of a home holds two words of each (csrc/cuda/solver/damage.cu)
        bits = min(sum_bits(self.count), 52 if self.dtype == torch.float64 else 41)
        units = [
            math.ldexp(1.0, math.frexp(bound)[1] - bits)
            for bound in (most, most * DRIVE_MAX, stiff, most)
        ]
        at2 = float(int(own[0, 5]) >= MODELS["at2"])
        return own.new_tensor([*units, at2, EMPTY * most, even])

    def _load(self, given: points.Given) -> None:
        """Group the points by block and field and store them, on each rank a stretch of them."""
        b, n = self._whole, self.count
        stores = self._parts.parts if self._parts else [b]
        share = -(-n // len(stores))
        room = self._parts.room(share) if self._parts else n
        found = [
            points.load(
                store, self._widths, given, min(r * share, n), min((r + 1) * share, n), room
            )
            for r, store in enumerate(stores)
        ]
        key = torch.unique(torch.cat([own.to(self.device) for own, _ in found]))
        homes, slots = len(key), points.reach(key)
        b.reserve_blocks(homes + homes // 2 + 64, slots + slots // 3 + 64, self.fields)
        if self._parts:
            self._parts.reserve(homes, [len(own) for own, _ in found])
        for store, (own, counts) in zip(stores, found, strict=True):
            points.list_homes(store, own, counts)
        self._write(homes=homes, parity=0, rebuild=1, done=1, grow=0, reason=0)

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

    def _stores(self) -> list[layout.Buffers]:
        """The buffers that hold points."""
        return self._parts.parts if self._parts else [self._whole]

    def chunks(self, name: str) -> Iterator[tuple[Tensor, Tensor]]:
        """Values of the points as they lie, some at a time, each on the device that has them.

        So is read what is too large for one device, or for the host.

        Args:
            name: position, body, velocity, affine, strain, alpha, peak, stress; deformation or
                viscous where there is one.

        Returns:
            Where points stand in the order of loading, int64 [n], and their values, [n, ...].

        Raises:
            InputError: No such values.
        """
        self._known(name)
        for lot in self._lots():
            yield lot.index, self._of(lot, name)

    def values(self, *names: str) -> tuple[Tensor, ...]:
        """Several values in the order of loading, where the points were given: one look for all.

        Args:
            names: As :meth:`chunks` takes them.

        Raises:
            InputError: No such values.
        """
        for name in names:
            self._known(name)
        out: dict[str, Tensor] = {}
        for lot in self._lots():
            index = lot.index.to(self.outside)
            for name in names:
                values = self._of(lot, name).to(self.outside)
                if name not in out:
                    out[name] = values.new_empty((self.count, *values.shape[1:]))
                out[name][index] = values
        return tuple(out[name] for name in names)

    def holds(self, name: str) -> bool:
        """Whether there are such values: not every solver has a deformation, or viscous springs."""
        return name in _VALUES - ({"deformation", "viscous"} - self._widths.keys())

    def _known(self, name: str) -> None:
        missing = {"deformation", "viscous"} - self._widths.keys()
        if not self.holds(name):
            raise InputError(
                f"Solver.chunks: there is no {name!r} here",
                hint=f"one of {', '.join(sorted(_VALUES - missing))}",
            )

    def _lots(self) -> Iterator[points.Lot]:
        for b in self._stores():
            yield from points.lots(b, self._widths)

    def _of(self, lot: points.Lot, name: str) -> Tensor:
        of = getattr(self, f"_{name}_of", None)
        value: Tensor = lot.rows(name) if of is None else of(lot)
        return value

    def _read(self, name: str) -> Tensor:
        return self.values(name)[0]

    @property
    def position(self) -> Tensor:
        """Positions [m], float64 [N, 3]."""
        return self._read("position")

    def _position_of(self, lot: points.Lot) -> Tensor:
        word = lot.words
        local = torch.stack([word & 7, word >> 3 & 7, word >> 6 & 7], dim=1)
        cell = 4 * lot.owners[:, :3] - 1 + local
        place = (cell.double() + 0.5 + lot.rows("offset").double()) * self.dx
        if bool(self.frame.any()):
            place = place + self.frame.to(place.device) * self.time
        return place

    @property
    def body(self) -> Tensor:
        """Velocity field of each point, int32 [N]."""
        return self._read("body")

    def _body_of(self, lot: points.Lot) -> Tensor:
        return lot.owners[:, 3].to(torch.int32)

    @property
    def velocity(self) -> Tensor:
        """Velocities [m/s], [N, 3]."""
        return self._read("velocity")

    def _velocity_of(self, lot: points.Lot) -> Tensor:
        velocity = lot.rows("velocity")
        if bool(self.frame.any()):
            velocity = (velocity.double() + self.frame.to(velocity.device)).to(velocity)
        return velocity

    @property
    def affine(self) -> Tensor:
        """APIC matrix C [1/s], [N, 3, 3]."""
        return self._read("affine")

    def _affine_of(self, lot: points.Lot) -> Tensor:
        mass = lot.buffers.rows[lot.words >> 9, 8, None]
        return (lot.rows("slope") / mass).view(-1, 3, 3)

    @property
    def strain(self) -> Tensor:
        """Strain ``b - I``, [N, 6]."""
        return self._read("strain")

    @property
    def alpha(self) -> Tensor:
        """Alpha of each point's law, [N]; as given where no law of the scene changes it."""
        return self._read("alpha")

    def _alpha_of(self, lot: points.Lot) -> Tensor:
        if "alpha" in self._widths:
            return lot.rows("alpha")[:, 0]
        if self._alpha is None:
            return lot.rows("offset").new_zeros(lot.end - lot.begin)
        return self._alpha[lot.index.to(self._alpha.device)]

    @property
    def peak(self) -> Tensor:
        """Largest alpha so far, [N]; -1 for points whose law does not break."""
        return self._read("peak")

    def _peak_of(self, lot: points.Lot) -> Tensor:
        if "peak" in self._widths:
            return lot.rows("peak")[:, 0]
        return torch.full_like(lot.rows("offset")[:, 0], UNBROKEN)

    @property
    def deformation(self) -> Tensor | None:
        """Total deformation gradient, [N, 3, 3], or None when it is not tracked."""
        return self._read("deformation") if "deformation" in self._widths else None

    def _deformation_of(self, lot: points.Lot) -> Tensor:
        return lot.rows("deformation").view(-1, 3, 3)

    @property
    def viscous(self) -> Tensor | None:
        """Viscosity of each point with its spring, [N, 9], or None without."""
        return self._read("viscous") if "viscous" in self._widths else None

    @property
    def stress(self) -> Tensor:
        """Kirchhoff stress of the present state [Pa], [N, 6]; of a liquid without its viscous part.

        That one belongs to the step, not to the state: it is viscosity times rate of strain.
        """
        return self._read("stress")

    def _stress_of(self, lot: points.Lot) -> Tensor:
        b, row = lot.buffers, (lot.words >> 9).to(torch.int32)
        material: Tensor | None = row
        strain, broken = lot.rows("strain").contiguous(), self._law_set > 0
        alpha = lot.rows("alpha")[:, 0] if broken else strain.new_zeros(len(row))
        law, params, none = b.law, b.rows[:, :8].contiguous(), strain.new_zeros(len(row), 3, 3)
        if broken and (self.irreversible or self._law_set == DAMAGE_FIELD):
            (law, params), material = weakened(law, params, row, lot.rows("peak")[:, 0]), None
        after, new_alpha, stress, _ = return_mapping(
            strain, alpha, none, law=law, params=params, material=material, k=self.k,
            epsilon=self.epsilon, implicit=self.implicit,
            dt=1e-9,  # of a step without motion: what flows with a viscosity stays
        )  # fmt: skip
        if "viscous" in self._widths:
            stress = viscous_step(
                lot.rows("viscous"), strain, alpha, none, (after, new_alpha, stress), law=b.law,
                params=b.rows[:, :8].contiguous(), material=row, dt=0.0,
            )[3]  # fmt: skip
        return stress

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
