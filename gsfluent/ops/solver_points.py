"""Points of the resident solver on their way in and out, some at a time.

Given tensors may lie in host memory and be larger than a device: each rank gets a stretch of them,
whichever, and the first build brings every point to the rank that owns its home.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator

import torch
from torch import Tensor

from gsfluent.ops import solver_buffers as layout
from gsfluent.ops.plasticity import LAWS
from gsfluent.ops.solver_buffers import INDEX

UNBROKEN = -1.0
"""Peak alpha of points whose law does not break."""


def stretches(begin: int, end: int) -> Iterator[slice]:
    """Slices of ``CHUNK`` points."""
    for start in range(begin, end, layout.CHUNK):
        yield slice(start, min(start + layout.CHUNK, end))


@dataclasses.dataclass
class Given:
    """All points as they were given, wherever they lie.

    Attributes:
        position: [m], [N, 3].
        velocity: [m/s], [N, 3]; its dtype is that of the state.
        mass: [kg], [N].
        row: Row of (parameters, mass, volume), int32 [N].
        body: Velocity field, int32 [N], or None for one.
        more: strain, alpha, peak, affine, deformation and viscous, as far as they were given.
        frame: Velocity of the grid [m/s], float64 [3] on a CPU.
        dx: Node spacing [m].
    """

    position: Tensor
    velocity: Tensor
    mass: Tensor
    row: Tensor
    body: Tensor | None
    more: dict[str, Tensor]
    frame: Tensor
    dx: float

    def cells(self, part: slice, device: torch.device) -> tuple[Tensor, Tensor]:
        """Cells, int64 [n, 3], and the offsets in them, [n, 3].

        Raises:
            ValueError: A position is not finite, or too far out.
        """
        u = self.position[part].to(device, torch.float64) / self.dx - 0.5
        limit = 4.0 * (layout.BLOCK_RANGE - 2)
        outside = ~(u.abs() < limit).all(dim=1)
        if bool(outside.any()):
            raise ValueError(
                f"Solver: position must be finite and within {limit:.0f} cells of the origin, "
                f"got {int(outside.sum())} of {len(u)} rows that are not"
            )
        cell = torch.floor(u)
        offset = (u - cell).to(self.velocity.dtype)
        over = offset >= 1.0
        return (cell + over).long(), offset.masked_fill(over, 0.0)

    def keys(self, part: slice, cell: Tensor) -> Tensor:
        """Block and field of each point in one word, int64 [n], by its cell."""
        return keys(cell >> 2, 0 if self.body is None else self.body[part].to(cell.device).long())

    def rows(
        self,
        part: slice,
        cells: tuple[Tensor, Tensor],
        b: layout.Buffers,
        widths: dict[str, int],
        sound: dict[str, Tensor],
    ) -> Iterator[tuple[str, Tensor]]:
        """What is held of each point, name by name.

        Args:
            part: Which points.
            cells: What :meth:`cells` says of them.
            b: Buffers.
            widths: What they hold.
            sound: Gets for every name whether all of its values are finite, bool [].
        """
        device, real = b.offset.device, self.velocity.dtype
        cell, offset = cells

        def finite(name: str, values: Tensor) -> Tensor:
            good = torch.isfinite(values).all()
            sound[name] = good & sound.get(name, good)
            return values

        row = self.row[part].to(device).long()
        local = (cell & 3) + 1
        word = local[:, 0] | local[:, 1] << 3 | local[:, 2] << 6 | row << 9

        def of(name: str) -> Tensor:
            value = self.more.get(name)
            if value is None:
                return torch.zeros(len(row), layout.ON_CPU.get(name, 9), dtype=real, device=device)
            return finite(name, value[part].to(device).reshape(len(row), -1))

        velocity = self.velocity[part].to(device)
        if bool(self.frame.any()):
            velocity = (velocity.double() - self.frame.to(device)).to(real)
        velocity = finite("velocity", velocity)
        slope = finite("slope", of("affine") * self.mass[part].to(device)[:, None])
        if "meta" in widths:
            yield from (("offset", offset), ("velocity", velocity), ("slope", slope))
            # The word is unsigned there; wrap it into the signed type torch has.
            yield "meta", torch.where(word >= 2**31, word - 2**32, word)
        else:
            bits = layout.word_as_real(word, offset)[:, None]
            yield "offset", torch.cat([offset, bits], dim=1)
            yield "velocity", torch.cat([velocity, slope], dim=1)
        yield "id", torch.arange(part.start, part.stop, device=device)
        for name in ("strain", "alpha", "deformation", "viscous", "own"):
            if name in widths:
                yield name, of(name)
        if "peak" in widths:
            law = b.law[row]
            given = "peak" in self.more
            breaks = (law == LAWS["nacc"]) | ((law == LAWS["phase_field"]) & given)
            peak = of("peak" if given else "alpha")[:, 0]
            yield "peak", torch.where(breaks, peak, torch.full_like(peak, UNBROKEN))


def load(
    b: layout.Buffers, widths: dict[str, int], given: Given, begin: int, end: int, room: int
) -> tuple[Tensor, Tensor]:
    """Put a stretch of the given points into buffers, in the order of their homes.

    Args:
        b: Buffers without points yet.
        widths: What they hold of each.
        given: All points.
        begin: Its first point.
        end: Past its last one.
        room: So many points there is to be room for.

    Returns:
        Keys of the homes in ascending order, int64 [H], and how many points each has.

    Raises:
        ValueError: A value is not finite, or a point too far out.
    """
    device = b.offset.device
    key = torch.empty(end - begin, dtype=torch.int64, device=device)
    cells = None
    for part in stretches(begin, end):
        cells = given.cells(part, device)
        key[part.start - begin : part.stop - begin] = given.keys(part, cells[0])
    key, order = torch.sort(key, stable=True)
    homes, counts = torch.unique_consecutive(key, return_counts=True)
    del key
    place = torch.empty(end - begin, dtype=torch.int32, device=device)
    place[order] = torch.arange(end - begin, dtype=torch.int32, device=device)
    del order
    b.reserve_points(widths, room)
    sound: dict[str, Tensor] = {}
    for part in stretches(begin, end):
        to = place[part.start - begin : part.stop - begin].long()
        if cells is None or part != slice(begin, end):  # not those of the only stretch
            cells = given.cells(part, device)
        for name, rows in given.rows(part, cells, b, widths, sound):
            layout.put_rows(getattr(b, name), widths[name], to, rows)
    flags = torch.stack([*sound.values()]).tolist() if sound else []  # a rank may get no points
    for name, good in zip(sound, flags, strict=True):
        if not good:
            raise ValueError(f"Solver: {name} must be finite")
    return homes, counts


def list_homes(b: layout.Buffers, key: Tensor, counts: Tensor) -> None:
    """Enter homes whose points lie one after the other; there is room for them."""
    n = len(key)
    b.home_coord0[:n] = unkey(key).to(torch.int32)
    b.home_count0[:n] = counts.to(torch.int32)
    b.home_start0[:n] = (torch.cumsum(counts, 0) - counts).to(torch.int32)


@dataclasses.dataclass
class Lot:
    """Some points where they lie, one after the other.

    Attributes:
        buffers: Hold them.
        begin, end: Their places.
        starts: First places of the homes there, ascending, int64 [H].
        blocks: Block and field of each of them, int32 [H, 4].
        widths: What is held of each point.
    """

    buffers: layout.Buffers
    begin: int
    end: int
    starts: Tensor
    blocks: Tensor
    widths: dict[str, int]

    @functools.cached_property
    def index(self) -> Tensor:
        """Where each stands in the order of loading, int64 [n]."""
        return self.buffers.id[self.begin : self.end].long()

    @functools.cached_property
    def owners(self) -> Tensor:
        """Block and field of each, int64 [n, 4]."""
        place = torch.arange(self.begin, self.end, device=self.starts.device)
        return self.blocks[torch.searchsorted(self.starts, place, right=True) - 1].long()

    @functools.cached_property
    def words(self) -> Tensor:
        """Cell and row of each, int64 [n]."""
        if "meta" in self.widths:
            return self.stored("meta")[:, 0].long() & (2**32 - 1)
        return layout.real_as_word(self.stored("offset")[:, 3])

    def stored(self, name: str) -> Tensor:
        """A tensor's rows."""
        return layout.get_rows(getattr(self.buffers, name), self.widths[name], self.begin, self.end)

    def rows(self, name: str) -> Tensor:
        """Values with one row per point; of ``offset``, ``velocity`` and ``slope`` those alone."""
        if "meta" not in self.widths and name in ("velocity", "slope"):
            motion = self.stored("velocity")
            return motion[:, :3] if name == "velocity" else motion[:, 3:]
        return self.stored(name)[:, : layout.ON_CPU[name]]


def lots(b: layout.Buffers, widths: dict[str, int]) -> Iterator[Lot]:
    """All points that buffers hold, ``CHUNK`` at a time."""
    clock = b.clock.cpu()
    side, homes = str(int(clock[INDEX["parity"]])), int(clock[INDEX["homes"]])
    starts = getattr(b, f"home_start{side}")[:homes].long()
    starts, order = torch.sort(starts)
    blocks = getattr(b, f"home_coord{side}")[:homes][order]
    count = int(getattr(b, f"home_count{side}")[:homes].sum())
    for part in stretches(0, count):
        yield Lot(b, part.start, part.stop, starts, blocks, widths)


def keys(block: Tensor, field: Tensor | int) -> Tensor:
    """Blocks [n, 3] and fields in one word, int64 [n]; ascending in block x, y, z, then field."""
    shift = block + layout.BLOCK_RANGE
    return ((shift[:, 0] << 17 | shift[:, 1]) << 17 | shift[:, 2]) << 12 | field


def unkey(key: Tensor) -> Tensor:
    """What :func:`keys` was given, int64 [n, 4]."""
    parts = [key >> 46, key >> 29, key >> 12]
    block = [(part & (2**17 - 1)) - layout.BLOCK_RANGE for part in parts]
    return torch.stack([*block, key & (2**12 - 1)], dim=1)


def reach(key: Tensor) -> int:
    """Number of blocks that windows of these homes can touch at most."""
    axis = torch.arange(-1, 2, device=key.device)
    step = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).view(27, 3)
    coord = unkey(key)
    block = (coord[:, None, :3] + step).reshape(-1, 3)
    return len(torch.unique(keys(block, coord[:, 3].repeat_interleave(27))))
