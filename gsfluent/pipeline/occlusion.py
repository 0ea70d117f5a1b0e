"""Where matter is now, on one dense grid per picture: occupancy, its gradient, ambient occlusion.

The grid has a fixed number of nodes and a cell of about three splats (``occupancy_cell``); it
follows the bulk of the matter in whole steps of its coarsest cell, so that nothing swims. Splats
outside (a crumb that flew far) take no part. Everything is a handful of tensor operations without
a host synchronisation: one scatter, pooling, and one lookup per quantity.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

# Splats per cell of the matter's inside, and the share of it from which a place is full; below one,
# because counts scatter.
PER_CELL = 3.0
FULL = 0.8
LEVELS = 5
"""Levels of the pyramid: each has cells twice as wide as the one before."""
COARSEST = 2 ** (LEVELS - 1)
"""Cells of the coarsest level, in finest cells."""
# Levels of the pyramid that ambient occlusion looks at, how far out along the normal in cells of
# that level, what a flat surface shows there, and how much of the sky each hides when full.
REACH = 1.0
AO_LEVELS = (1, 2, 3, 4)
AO_FLAT = 0.08
AO_SHARE = (0.28, 0.28, 0.24, 0.2)


class Occupancy(NamedTuple):
    """A pyramid of occupancies.

    Attributes:
        values: Shares of full in [0, 1] of all levels one after the other, flat; level ``l`` is a
            cube [D / 2^l]^3 in the order z, y, x (as ``grid_sample`` has it).
        frame: Corner x, y, z [m] of the grid and its finest cell [m], [4].
        nodes: D, a multiple of 16.
    """

    values: Tensor
    frame: Tensor
    nodes: int

    def level(self, index: int) -> Tensor:
        """Level ``index`` as [D, D, D] / 2^index, a view."""
        start = sum((self.nodes >> level) ** 3 for level in range(index))
        side = self.nodes >> index
        return self.values[start : start + side**3].view(side, side, side)


def box_frame(means: Tensor, cell: float, nodes: int) -> Tensor:
    """Corner and cell [4] of a grid of ``nodes``^3 around the bulk of ``means`` [N, 3]."""
    step = cell * COARSEST
    corner = means.mean(0) - 0.5 * nodes * cell
    corner = (corner / step).round() * step
    return torch.cat([corner, corner.new_full((1,), cell)])


def occupancy(means: Tensor, cell: float, nodes: int, *, per_cell: float = PER_CELL) -> Occupancy:
    """Scatter centres [N, 3] (trilinear), cut off at full, and pool; see :class:`Occupancy`.

    Args:
        means: Centres [m]; those off the grid are left out.
        cell: Finest cell [m].
        nodes: Cells along each side, a multiple of 16.
        per_cell: Splats in a full cell.
    """
    frame = box_frame(means, cell, nodes)
    place = (means - frame[:3]) / cell - 0.5
    base = place.floor()
    part = place - base
    base = base.long()
    inside = ((base >= 0) & (base < nodes - 1)).all(-1)
    first = (base[:, 2] * nodes + base[:, 1]) * nodes + base[:, 0]
    first = torch.where(inside, first, 0)
    count = torch.zeros(nodes**3, dtype=means.dtype, device=means.device)
    other = 1.0 - part
    for corner in range(8):
        x, y, z = corner & 1, corner >> 1 & 1, corner >> 2
        weight = (part if x else other)[:, 0] * (part if y else other)[:, 1]
        weight = weight * (part if z else other)[:, 2] * inside
        count.index_add_(0, first + ((z * nodes + y) * nodes + x), weight)
    full = (count / (FULL * per_cell)).clamp(max=1.0).view(1, 1, nodes, nodes, nodes)
    levels = [full]
    for _ in range(LEVELS - 1):
        levels.append(torch.nn.functional.avg_pool3d(levels[-1], 2))
    return Occupancy(torch.cat([level.flatten() for level in levels]), frame, nodes)


def sample(volume: Tensor, frame: Tensor, nodes: int, points: Tensor) -> Tensor:
    """Trilinear values [..., C] of a volume [C, D', D', D'] at points [..., 3]; 0 outside.

    Args:
        volume: Values at cell centres in the order z, y, x, any level of the grid.
        frame: Corner and finest cell of the grid, [4].
        nodes: Cells along the finest level's side.
        points: Scene points [m].
    """
    place = (points - frame[:3]) * (2.0 / (frame[3] * nodes)) - 1.0
    found = torch.nn.functional.grid_sample(
        volume[None],
        place.reshape(1, 1, 1, -1, 3),
        mode="bilinear",
        padding_mode="zeros",
        align_corners=False,
    )
    return found.reshape(volume.shape[0], -1).T.reshape(*points.shape[:-1], -1)


def ambient_occlusion(points: Tensor, normal: Tensor, grid: Occupancy) -> Tensor:
    """Share of the sky that reaches points [..., 3] with unit normals [..., 3]: [...] in [0, 1].

    One wide cone along the normal through the pyramid (voxel cone tracing, Crassin et al. 2011,
    with a single cone): at each level one look a cell of that level out; what a flat surface would
    show there is taken off.
    """
    open_sky = torch.ones_like(points[..., 0])
    for level, share in zip(AO_LEVELS, AO_SHARE, strict=True):
        out = points + normal * (grid.frame[3] * (REACH * 2**level))
        seen = sample(grid.level(level)[None], grid.frame, grid.nodes, out)[..., 0]
        open_sky = open_sky - share * ((seen - AO_FLAT) / (1.0 - AO_FLAT)).clamp(min=0.0)
    return open_sky.clamp(min=0.0)
