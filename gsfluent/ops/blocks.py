"""The sparse grid of the material point method: 4x4x4-node blocks where matter is, cell order.

Node ``(i, j, k)`` of block ``b`` sits at ``(coords[b] * 4 + (i, j, k)) * dx`` and has local index
``(i * 4 + j) * 4 + k``. CPU kernel: ``csrc/cpu/mpm/blocks.cpp``; on CUDA torch operations.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from gsfluent._check import check_tensor
from gsfluent.ops._register import fakes

MAX_BLOCKS = 2**24


class Blocks(NamedTuple):
    """Sparse grid of 4x4x4-node blocks and particles in cell order, from :func:`build_blocks`.

    Attributes:
        table: Active block index or -1 over the bounding box of all blocks, int32 [Tx, Ty, Tz].
        origin: Block coordinates of ``table[0, 0, 0]``.
        coords: Block coordinates of every active block, int32 [B, 3].
        order: Particle indices sorted by block and cell, int32 [N].
        start: Range of ``order`` that belongs to each block, int32 [B + 1].
        margin: Nodes of slack; valid while no particle moved more than ``margin * dx`` on an axis.
    """

    table: Tensor
    origin: tuple[int, int, int]
    coords: Tensor
    order: Tensor
    start: Tensor
    margin: int = 1

    def parts(self, dx: float) -> tuple[Tensor | Sequence[int] | float, ...]:
        """What the operators are given of it: six fields in the order of their schemas, then dx."""
        return self.table, self.coords, self.order, self.start, self.origin, self.margin, dx

    @staticmethod
    def of(
        table: Tensor, coords: Tensor, order: Tensor, start: Tensor, origin: Sequence[int],
        margin: int,
    ) -> Blocks:  # fmt: skip
        """The inverse of :meth:`parts`, without dx."""
        return Blocks(table, (origin[0], origin[1], origin[2]), coords, order, start, margin)

    @property
    def block_count(self) -> int:
        """Number of active blocks, B."""
        return self.coords.shape[0]

    def expired(self, travelled: float, dx: float) -> bool:
        """Whether the blocks must be rebuilt before the next :func:`p2g`.

        Args:
            travelled: Upper bound on the distance any particle moved along an axis since
                :func:`build_blocks` [m], for example the running sum of ``dt * max |v|``.
            dx: Node spacing [m].

        Returns:
            True when a particle may have left the covered nodes. NaN counts as expired.
        """
        return not travelled <= 0.999 * self.margin * dx

    def node_positions(self, dx: float, dtype: torch.dtype = torch.float64) -> Tensor:
        """Positions of all nodes [m], shape [B, 64, 3]."""
        axis = torch.arange(4, device=self.coords.device)
        local = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).view(64, 3)
        return (self.coords[:, None].long() * 4 + local).to(dtype) * dx


def check_dx(op: str, dx: float) -> float:
    """Node spacing as a float; ValueError unless positive and finite."""
    if not 0.0 < float(dx) < float("inf"):
        raise ValueError(f"{op}: dx must be a positive number, got {dx}")
    return float(dx)


def check_blocks(op: str, blocks: object, like: Tensor) -> Blocks:
    """Type, dtype, shape and device of the grid part of ``blocks``."""
    if not isinstance(blocks, Blocks):
        raise TypeError(
            f"{op}: blocks must be a Blocks from build_blocks, got {type(blocks).__name__}"
        )
    device = like.device
    for name, shape in (("table", (None,) * 3), ("coords", (None, 3)), ("start", (None,))):
        tensor = getattr(blocks, name)
        check_tensor(op, f"blocks.{name}", tensor, shape=shape, dtype=torch.int32)
        if tensor.device != device:
            raise ValueError(f"{op}: blocks.{name} must be on {device}, got {tensor.device}")
    if blocks.start.shape[0] != blocks.coords.shape[0] + 1:
        raise ValueError(
            f"{op}: blocks.start must have shape [{blocks.coords.shape[0] + 1}] (blocks + 1), "
            f"got {list(blocks.start.shape)}"
        )
    return blocks


def check_order(op: str, blocks: Blocks, count: int) -> None:
    """Refuse blocks that were built for another number of particles."""
    check_tensor(op, "blocks.order", blocks.order, shape=(None,), dtype=torch.int32)
    if blocks.order.shape[0] != count:
        raise ValueError(
            f"{op}: blocks were built for {blocks.order.shape[0]} particles, got {count}; "
            "call build_blocks again after adding or removing particles"
        )


def build_blocks(
    position: Tensor, dx: float, *, margin: int = 1, max_blocks: int = MAX_BLOCKS
) -> Blocks:
    """Find the 4x4x4-node blocks that hold matter and sort the particles by cell.

    Every node within reach of a particle that moves by at most ``margin`` nodes is covered, so the
    result serves several steps (:meth:`Blocks.expired`).

    Args:
        position: Particle positions [m], shape [N, 3], float32 or float64.
        dx: Node spacing [m].
        margin: Nodes of slack, 0, 1 or 2.
        max_blocks: Largest bounding box of blocks (entries of ``Blocks.table``, 4 bytes each).

    Returns:
        The blocks in lexicographic order; ``order`` is stable. Both are the same on CPU and CUDA.

    Raises:
        TypeError: ``position`` is not a float32 or float64 tensor.
        ValueError: Wrong shape, ``dx`` not positive, ``margin`` out of range, a position that is
            not finite, or particles spread over more than ``max_blocks`` blocks.
    """
    check_tensor("build_blocks", "position", position, shape=(None, 3))
    dx = check_dx("build_blocks", dx)
    if margin not in (0, 1, 2):
        raise ValueError(f"build_blocks: margin must be 0, 1 or 2, got {margin}")
    if not 1 <= max_blocks <= 2 * MAX_BLOCKS - 1:  # cell numbers are int32
        raise ValueError(
            f"build_blocks: max_blocks must be 1 to {2 * MAX_BLOCKS - 1}, got {max_blocks}"
        )
    table, coords, order, start, info = torch.ops.gsfluent.build_blocks(
        position.detach(), dx, margin, max_blocks
    )
    ox, oy, oz, bad, needed = info.tolist()
    if bad:
        raise ValueError(
            f"build_blocks: position must be finite and within 2^28 nodes of the origin, "
            f"got {bad} of {position.shape[0]} rows that are not; remove or reset those particles"
        )
    if needed > max_blocks:
        raise ValueError(
            f"build_blocks: particles spread over more than max_blocks = {max_blocks} blocks of "
            f"4 dx = {4 * dx:g} m; remove particles that flew away, or raise dx or max_blocks"
        )
    return Blocks(table, (ox, oy, oz), coords, order, start, margin)


def build_blocks_on_device(
    position: Tensor, dx: float, margin: int, max_table: int
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """build_blocks in device-wide torch operations: mark, cumsum, stable sort, searchsorted."""
    device, far = position.device, 2**28
    empty = torch.zeros(0, dtype=torch.int32, device=device)
    no_blocks = (empty.view(0, 0, 0), empty.view(0, 3), empty, torch.zeros_like(empty).new_zeros(1))
    u = position * (1.0 / torch.tensor(dx, dtype=position.dtype)).item() - 0.5
    bad = int((~(u.abs() < far)).any(dim=1).sum())
    if bad:
        return *no_blocks, torch.tensor([0, 0, 0, bad, 0])
    base = torch.floor(u).to(torch.int64)
    lo, hi = (base - margin) >> 2, (base + 2 + margin) >> 2
    if position.shape[0]:
        origin = lo.amin(dim=0)
        corner = torch.stack([origin, hi.amax(dim=0) - origin + 1]).tolist()
    else:
        origin = lo.new_zeros(3)
        corner = [[0, 0, 0], [1, 1, 1]]
    first, size = corner
    needed = size[0] * size[1] * size[2]
    info = torch.tensor([*first, 0, min(needed, 2**62)])
    if needed > max_table:
        return *no_blocks, info
    strides = torch.tensor([size[1] * size[2], size[2], 1], device=device)
    lo, hi = lo - origin, hi - origin
    marked = torch.zeros(needed, dtype=torch.bool, device=device)
    reach = range((2 * margin + 5) // 4 + 1)
    for di in reach:
        for dj in reach:
            for dk in reach:
                step = torch.tensor([di, dj, dk], device=device)
                marked[(torch.minimum(lo + step, hi) * strides).sum(dim=1)] = True
    index = torch.cumsum(marked, dim=0, dtype=torch.int32) - 1
    table = torch.where(marked, index, torch.full_like(index, -1))
    flat = marked.nonzero().squeeze(1)
    coords = torch.stack([flat // strides[0], flat // strides[1] % size[1], flat % size[2]], dim=1)
    coords = (coords + origin).to(torch.int32)
    home = (((base >> 2) - origin) * strides).sum(dim=1)
    local = base & 3
    key = table[home].to(torch.int64) * 64 + (local[:, 0] * 4 + local[:, 1]) * 4 + local[:, 2]
    key, order = torch.sort(key, stable=True)
    edges = torch.arange(coords.shape[0] + 1, device=device) * 64
    start = torch.searchsorted(key, edges).to(torch.int32)
    return table.view(size), coords, order.to(torch.int32), start, info


torch.library.register_kernel("gsfluent::build_blocks", "cuda")(build_blocks_on_device)


def _block_shapes(position: Tensor, *rest: object) -> tuple[Tensor, ...]:
    unknown = torch.library.get_ctx().new_dynamic_size
    size, count = [unknown() for _ in range(3)], unknown()
    shapes = (size, (count, 3), (position.shape[0],), (count + 1,))
    whole = [position.new_empty(shape, dtype=torch.int32) for shape in shapes]
    return *whole, torch.empty(5, dtype=torch.int64)


fakes(build_blocks=_block_shapes)
