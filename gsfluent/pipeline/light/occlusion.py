"""Where matter is now, on one dense grid per picture: occupancy, its gradient, ambient occlusion.

The grid has a fixed number of nodes and a cell of about three splats (``occupancy_cell``); it
follows the bulk of the matter in whole steps of its coarsest cell, so that nothing swims. Splats
outside (debris that flew far) take no part. Everything is a handful of tensor operations without
a host synchronisation: one scatter, pooling, and one lookup per quantity.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from gsfluent.ops.density import LEVELS

# Splats per cell of the matter's inside, and the share of it from which a place is full; below one,
# because counts scatter.
PER_CELL = 3.0
FULL = 0.8
COARSEST = 2 ** (LEVELS - 1)
"""Cells of the coarsest level, in finest cells."""
# Ambient occlusion: levels of the pyramid that each cone steps through, how far out in cells of
# that level, what is taken off for the surface's own blur, and how fast a cone fills. Fitted to
# ray-traced truth in cracks of three widths, a corner, beside a ball and on open faces
# (scripts/accuracy/light.py).
AO_LEVELS = (1, 2, 3, 4)
AO_REACH = 2.16
AO_FLAT = 0.02
AO_GAIN = 1.23
# One cone along the normal with this weight, four tilted by this angle's cosine and sine.
AO_CENTER = 0.43
AO_COS, AO_SIN = 0.445, 0.8955


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


def box_frame(center: Sequence[float], cell: float, nodes: int) -> list[float]:
    """Corner x, y, z and cell of a grid of ``nodes``^3 around ``center`` [m], in whole steps."""
    step = cell * COARSEST
    return [*(round((x - 0.5 * nodes * cell) / step) * step for x in center), cell]


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

    Voxel cone tracing (Crassin et al. 2011): five cones, one along the normal and four tilted, each
    with one look per level of the pyramid, that let through what the looks before left. Points
    without a normal see the whole sky.
    """
    cell = grid.frame[3]
    x, y, z = normal.unbind(-1)
    # any frame around the normal: across x, or across y where the normal is nearly x
    steep = (x.abs() > 0.6).to(normal.dtype)
    zero = torch.zeros_like(x)
    across = torch.stack([-z * steep, z * (1.0 - steep), x * steep - y * (1.0 - steep)], -1)
    across = torch.nn.functional.normalize(across, dim=-1)
    other = torch.linalg.cross(normal, across)
    diagonal = AO_SIN * math.sqrt(0.5)
    ways = [normal]
    for a, b in ((1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0)):
        ways.append(AO_COS * normal + diagonal * (a * across + b * other))
    weights = [AO_CENTER] + [0.25 * (1.0 - AO_CENTER)] * 4
    open_sky = zero
    for way, weight in zip(ways, weights, strict=True):
        left = torch.full_like(x, weight)
        for level in AO_LEVELS:
            out = points + way * (cell * (AO_REACH * 2**level))
            seen = sample(grid.level(level)[None], grid.frame, grid.nodes, out)[..., 0]
            hidden = AO_GAIN / (1.0 - AO_FLAT) * (seen - AO_FLAT).clamp(min=0.0)
            left = left * (1.0 - hidden).clamp(min=0.0)
        open_sky = open_sky + left
    return torch.where(normal.square().sum(-1) > 0.5, open_sky, 1.0)
