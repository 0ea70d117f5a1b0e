"""Tensors of the resident solver, in the order of ``SolverBuffer`` in ``csrc/host/solver.h``."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator

import torch
from torch import Tensor

CLOCK_WORDS = 53
BLOCK_NODES = 64
NEIGHBOURS = 27
SITE_FIELDS = 16
CONTACT_MOMENTS = 3
DAMAGE_PLANES = 10
IMPULSE_SUMS = 7
BLOCK_RANGE = 2**16
MAX_FIELDS = 2**12 - 2
MAX_ROWS = 2**23
MAX_PARTICLES = 2**29
"""Their places fit into 32 bits, on any number of ranks."""
MAX_HOME = 2**26
"""Points of one home; more could overflow its fixed-point sums (docs/theory/solver-sums.md)."""

CHUNK = 2**24
"""Points that are loaded or read at a time, so that what this takes does not grow with all."""
ON_CPU = {"offset": 3, "meta": 1, "velocity": 3, "slope": 9, "strain": 6, "alpha": 1, "peak": 1,
          "deformation": 9, "id": 1, "viscous": 9, "own": 9}  # fmt: skip
"""What is held of each point, and its components (``csrc/core/solver/layout.h``)."""
ON_DEVICE = {name: width for name, width in ON_CPU.items() if name not in ("meta", "slope")} | {
    "offset": 4, "velocity": 12,
}  # fmt: skip
"""There the offset holds the meta word and the velocity the slope."""
SCRATCH = {"spare": 9, "entry": 1, "place": 1}
"""Of each point, for builds."""

FLOATS = (
    "time", "until", "dt", "dt_next", "dt_fixed", "dt_scale", "cfl", "gradient_limit",
    "momentum_unit", "mass_unit", "dt_min", "dt_max", "speed_seen", "wave_seen", "slack", "travel",
    "dt_most",
)  # fmt: skip
"""Members of the clock that are doubles; the others are integers."""
CLOCK = (
    "time", "until", "dt", "dt_next", "dt_fixed", "dt_scale", "cfl", "gradient_limit",
    "momentum_unit", "mass_unit", "dt_min", "dt_max",
    "step", "steps_left", "done", "rebuild", "grow", "reason", "parity", "homes",
    "slots", "sites", "cursor", "arrived", "speed", "wave", "gradient", "bound",
    "plastic", "guarded", "inverted", "invalid", "contact_nodes", "contact_steps", "builds",
    "wanted_homes", "wanted_slots", "homes_max", "slots_max", "particle_steps",
    "touched", "lost", "unit_bits", "shared_sites", "speed_seen", "wave_seen", "leaving", "slack",
    "travel", "moved", "dt_most", "shared_homes", "quiet",
)  # fmt: skip
"""Members of ``SolverClock``, word by word."""
INDEX = {name: index for index, name in enumerate(CLOCK)}


@dataclasses.dataclass
class Buffers:
    """Every tensor of a solver; see ``csrc/core/solver/state.h`` for what each holds."""

    clock: Tensor
    offset: Tensor
    meta: Tensor
    velocity: Tensor
    slope: Tensor
    strain: Tensor
    alpha: Tensor
    peak: Tensor
    deformation: Tensor
    id: Tensor
    spare: Tensor
    entry: Tensor
    place: Tensor
    law: Tensor
    rows: Tensor
    home_coord0: Tensor
    home_start0: Tensor
    home_count0: Tensor
    home_coord1: Tensor
    home_start1: Tensor
    home_count1: Tensor
    neighbour: Tensor
    home_bound: Tensor
    home_mass: Tensor
    slot_coord: Tensor
    slot_shared: Tensor
    site_slots: Tensor
    sums: Tensor
    moments: Tensor
    node_velocity: Tensor
    key: Tensor
    table_count: Tensor
    table_mask: Tensor
    table_home: Tensor
    table_slot: Tensor
    slot_next: Tensor
    slot_near: Tensor
    colliders: Tensor
    collider_state: Tensor
    sdf: Tensor
    impulse_units: Tensor
    impulse: Tensor
    parent: Tensor
    cut: Tensor
    radius: Tensor
    viscous: Tensor
    object: Tensor
    own: Tensor
    free_velocity: Tensor
    spring_rows: Tensor
    push: Tensor
    press: Tensor
    slot_given: Tensor
    home_rank: Tensor
    home_place: Tensor
    holders: Tensor
    needers: Tensor
    mail: Tensor
    peers: Tensor
    damage_sums: Tensor
    damage_nodes: Tensor
    damage_slots: Tensor
    damage_homes: Tensor
    damage_counts: Tensor
    damage_scale: Tensor

    def listed(self) -> list[Tensor]:
        """Return the tensors in the order the operators take them."""
        return [getattr(self, field.name) for field in dataclasses.fields(self)]

    def memory(self) -> int:
        """Return the bytes of all tensors."""
        return sum(t.numel() * t.element_size() for t in self.listed())

    def reserve_points(self, widths: dict[str, int], count: int) -> None:
        """Make room for so many points in these tensors; what they hold is kept."""
        for name, width in widths.items():
            flat = "meta" not in widths or width == 1
            setattr(self, name, more_room(getattr(self, name), width, count, flat=flat))

    def reserve_blocks(self, homes: int, slots: int, fields: int) -> None:
        """Make room for blocks; the list of present homes is kept, nothing else needs to be."""
        like = self.offset
        device, real = like.device, like.dtype
        sums = torch.int64 if device.type == "cuda" else torch.float64

        def whole(*shape: int) -> Tensor:
            return torch.zeros(shape, dtype=torch.int32, device=device)

        for side in "01":
            for name, width in (("coord", 4), ("start", 1), ("count", 1)):
                key = f"home_{name}{side}"
                old, new = getattr(self, key), whole(homes, width) if width > 1 else whole(homes)
                kept = min(old.shape[0], homes)
                if kept > 0:  # before the first homes, the old list has no columns
                    new[:kept] = old[:kept]
                setattr(self, key, new)
        self.neighbour = whole(homes, NEIGHBOURS)
        self.home_bound = torch.zeros(homes, dtype=real, device=device)
        self.home_mass = torch.zeros(homes, dtype=real, device=device)
        self.slot_coord, self.slot_shared = whole(slots, 4), whole(slots)
        self.site_slots, self.slot_next = whole(slots, SITE_FIELDS), whole(slots)
        self.sums = torch.zeros(slots, BLOCK_NODES, 4, dtype=sums, device=device)
        many = slots if fields > 1 else 0
        moments = torch.int64 if device.type == "cuda" else real
        self.moments = torch.zeros(many, BLOCK_NODES, CONTACT_MOMENTS, dtype=moments, device=device)
        self.slot_near = torch.zeros(slots, dtype=torch.int64, device=device)
        self.node_velocity = torch.zeros(slots, BLOCK_NODES, 4, dtype=real, device=device)
        if device.type == "cuda":  # on a CPU the kernels have them
            if self.own.numel():
                self.free_velocity = torch.zeros_like(self.node_velocity)
            if self.radius.numel():
                self.push, self.slot_given = torch.zeros_like(self.sums), whole(slots)
            if self.object.numel():
                self.press = torch.zeros_like(self.sums)
            if self.damage_scale.numel():
                self.damage_sums = torch.zeros_like(self.sums)
                self.damage_nodes = torch.zeros_like(self.sums, dtype=torch.float64)
                self.damage_slots, self.damage_homes = whole(DAMAGE_PLANES, slots), whole(homes)
                self.damage_counts = whole(4)
        # Homes and slots share the table with one entry per site; half full at most.
        entries = 1 << max(10, (4 * slots - 1).bit_length())
        if self.peers.numel():
            self.reserve_ranks()
        self.key = torch.zeros(entries, dtype=torch.int64, device=device)
        self.table_count, self.table_mask = whole(entries), whole(entries)
        self.table_home, self.table_slot = whole(entries), whole(entries)

    def reserve_ranks(self) -> None:
        """Make room for what several ranks on CUDA need of blocks; who owns homes is kept."""
        homes, slots = self.home_start0.shape[0], self.slot_next.shape[0]
        device = self.offset.device
        for name in ("home_rank", "home_place"):
            old, new = getattr(self, name), torch.zeros(homes, dtype=torch.int32, device=device)
            kept = min(old.shape[0], homes)
            new[:kept] = old[:kept]
            setattr(self, name, new)
        self.holders = torch.zeros(slots, dtype=torch.int64, device=device)
        self.needers = torch.zeros_like(self.holders)


def groups(values: Tensor, width: int) -> Iterator[Tensor]:
    """Views [N, components] of ``width`` components per point, as they lie in memory.

    Rows on a CPU; on a device flat, planes of up to four components each
    (``csrc/core/solver/layout.h``).
    """
    if values.dim() == 2:
        yield values
        return
    count, begin = values.numel() // width, 0
    for left in range(width, 0, -4):
        end = begin + min(4, left) * count
        yield values[begin:end].view(count, min(4, left))
        begin = end


def put_rows(values: Tensor, width: int, places: Tensor, rows: Tensor) -> None:
    """Write rows [n, width] to these places."""
    begin, rows = 0, rows.reshape(-1, width)
    for group in groups(values, width):
        end = begin + group.shape[1]
        group.index_copy_(0, places, rows[:, begin:end].to(values.dtype))
        begin = end


def get_rows(values: Tensor, width: int, begin: int, end: int) -> Tensor:
    """The rows [n, width] of places ``begin`` to ``end``."""
    return torch.cat([group[begin:end] for group in groups(values, width)], dim=1)


def more_room(values: Tensor, width: int, count: int, *, flat: bool = True) -> Tensor:
    """The same with room for ``count`` points; as many are kept as fit."""
    new = values.new_zeros(count * width) if flat else values.new_zeros(count, width)
    if values.numel():
        for old, group in zip(groups(values, width), groups(new, width), strict=True):
            kept = min(len(old), count)
            group[:kept] = old[:kept]
    return new


def word_as_real(word: Tensor, like: Tensor) -> Tensor:
    """Unsigned 32-bit words (int64) as bits of values of the dtype of ``like``."""
    if like.dtype == torch.float64:
        return word.view(torch.float64)
    return torch.where(word >= 2**31, word - 2**32, word).to(torch.int32).view(torch.float32)


def real_as_word(real: Tensor) -> Tensor:
    """The words that :func:`word_as_real` was given, int64."""
    whole = torch.int64 if real.dtype == torch.float64 else torch.int32
    return real.contiguous().view(whole).long() & (2**32 - 1)


def empty_buffers(device: torch.device, real: torch.dtype) -> Buffers:
    """Buffers without points, blocks, materials or optional parts."""

    @functools.cache
    def zeros(*shape: int, dtype: torch.dtype = real) -> Tensor:
        return torch.zeros(shape, dtype=dtype, device=device)

    # what has no element is the same for all: most of them would be made for nothing
    values = {field.name: zeros(0) for field in dataclasses.fields(Buffers)}
    whole = ("id", "entry", "place", "meta", "law", "home_start0", "home_count0", "home_start1",
             "home_count1", "parent", "cut", "object", "slot_given", "home_rank", "home_place",
             "damage_slots", "damage_homes", "damage_counts")  # fmt: skip
    for name in whole:
        values[name] = zeros(0, dtype=torch.int32)
    for name in ("home_coord0", "home_coord1"):
        values[name] = zeros(0, 4, dtype=torch.int32)
    for name in ("push", "press", "holders", "needers", "mail", "damage_sums"):
        values[name] = zeros(0, dtype=torch.int64)
    values["peers"] = zeros(0, dtype=torch.uint8)
    for name in ("spring_rows", "damage_nodes", "damage_scale"):
        values[name] = zeros(0, dtype=torch.float64)
    values["clock"] = zeros(CLOCK_WORDS, dtype=torch.int64)
    values["impulse_units"] = zeros(0, IMPULSE_SUMS, dtype=torch.int64)
    values["impulse"] = zeros(0, IMPULSE_SUMS, dtype=torch.float64)
    values["collider_state"] = zeros(0, dtype=torch.float64)
    values["sdf"] = zeros(0, dtype=torch.float32)
    return Buffers(**values)
