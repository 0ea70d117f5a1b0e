"""Velocity fields of the pieces of broken bodies.

Points that share a velocity field are welded wherever they share a node. So every piece of a broken
body has its own field, and pieces feel each other by contact only, like bodies; powder moves with
the piece it lies on. A block of the grid holds a few fields at most: where more meet, the smallest
pieces share one.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gsfluent.ops.solver_buffers import SITE_FIELDS
from gsfluent.pipeline.matter.points import Matter

MOST = 1024
"""Fields of a scene at most."""


def breakable(matter: Matter) -> Tensor:
    """Bodies that can break: those with brittle matter, bool [bodies]. Liquids run together."""
    return torch.stack([matter.brittle[a:b].any() for a, b in matter.ranges])


def cut_bodies(matter: Matter, cut: Tensor) -> Tensor:
    """Bodies that a blade has touched, bool [bodies]; liquids run together again."""
    mark = (cut != 0) & ~matter.of_law("fluid")
    return torch.stack([mark[a:b].any() for a, b in matter.ranges])


def number_fields(
    unit: Tensor,
    position: Tensor,
    mass: Tensor,
    on_grid: Tensor,
    dx: float,
    limit: int,
    most: int,
) -> Tensor:
    """Number the units as velocity fields, heaviest first, so that no block has too many.

    Args:
        unit: From :func:`gsfluent.pipeline.matter.pieces.find_pieces`, [N]; -1 is a unit like any
            other.
        position: Positions [m], [N, 3].
        mass: Masses [kg], [N].
        on_grid: Points that matter for the room in blocks, bool [N].
        dx: Grid spacing [m].
        limit: Fields that may meet in a block.
        most: Fields in all.

    Returns:
        Fields from 0, int32 [N].
    """
    ids, index = torch.unique(unit, return_inverse=True)
    if ids.shape[0] == 1:
        return torch.zeros_like(index, dtype=torch.int32)
    # In whole numbers, whose sums have no order: 2^26 points of the heaviest's mass fit.
    share = (mass.double() / mass.max().double().clamp_min(1e-300) * 2.0**36).round().long()
    weight = torch.zeros_like(ids).index_add_(0, index, share)
    rank = torch.empty_like(ids)
    order = torch.argsort(weight, descending=True, stable=True)
    rank[order] = torch.arange(ids.shape[0], device=ids.device)
    room = limit - 1
    crowded = rank >= most - 1
    block = torch.floor(position[on_grid] / (4.0 * dx) - 0.125).long()
    block = block - block.amin(dim=0) + 1
    key = (block[:, 0] << 20 | block[:, 1]) << 20 | block[:, 2]
    # Pairs of block and rank as one number each: sorting rows costs ten times as much.
    count = ids.shape[0]
    blocks, home = torch.unique(key, return_inverse=True)
    pair = torch.unique(home * count + rank[index[on_grid]])
    step = torch.tensor([-1, 0, 1], device=key.device)
    star = ((step[:, None, None] * 2**20 + step[:, None]) * 2**20 + step).flatten()
    around = (blocks[pair // count][:, None] + star).flatten()
    _, site = torch.unique(around, return_inverse=True)
    reached = torch.unique(site * count + (pair % count).repeat_interleave(27))
    _, place, counts = torch.unique_consecutive(
        reached // count, return_inverse=True, return_counts=True
    )
    first = torch.cumsum(counts, 0) - counts
    behind = torch.arange(reached.shape[0], device=key.device) - first[place] >= room
    is_crowded = torch.zeros_like(crowded)
    is_crowded[reached[behind] % count] = True
    crowded = crowded | is_crowded[rank]
    # What is crowded shares the number of the heaviest of them.
    rank = torch.where(crowded, rank[crowded].min() if bool(crowded.any()) else rank, rank)
    return torch.unique(rank[index], return_inverse=True)[1].to(torch.int32)


LIMIT = SITE_FIELDS
"""Fields that may meet in a block of the resident solver."""
