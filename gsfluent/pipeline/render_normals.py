"""Normals of Gaussians in any state, whole or broken, from where matter is now.

The outward normal is minus the gradient of the smoothed occupancy of space. It exists on the skin,
on crack faces and on debris alike, needs no memory of the rest state and, unlike a plane fitted to
neighbours (PCA), it has a side. Flat Gaussians know their plane better than any neighbourhood does:
they use their shortest axis, turned outward. Nothing but :func:`occupancy_cell` and
:func:`grid_for` waits for the device; both are called once per film.
"""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import conv3d, normalize

from gsfluent.data import INTERIOR, Gaussians
from gsfluent.pipeline.occlusion import COARSEST, PER_CELL, Occupancy, occupancy, sample

__all__ = ["Grid", "estimate_normals", "grid_for", "occupancy_cell", "splat_normals"]

# Binomial smoothing before the gradient, in passes of [1, 2, 1] / 4: counts scatter, and without
# it a ball's normals are 5 to 18 degrees off; with four passes 1.6.
_PASSES = 4
# Level of the pyramid whose gradient settles which side is out, and how clear it must be.
_WIDE = 2
_CLEAR = 0.1
# Half the gradient up to which a sheet without sides does not say which way its splats lie.
_UNCLEAR = 0.05
# A Gaussian is called flat when its shortest axis is below this share of the middle one.
_FLAT = 0.5
# Nodes along a side of the grid: room around the matter, and the most.
_ROOM = 16
_MOST_NODES = 256
_MOST_NODES_CPU = 192


def occupancy_cell(gaussians: Gaussians) -> float:
    """Cell size [m] at which cells inside the object hold about three Gaussians.

    The interior ones decide, where there are any: the skin of a reconstruction is far more crowded.
    """
    means = gaussians.means
    if gaussians.labels is not None:
        interior = gaussians.labels == INTERIOR
        if int(interior.sum()) > 1000:
            means = means[interior]
    low, high = means.amin(0), means.amax(0)
    extent = float((high - low).amax())
    if extent <= 0.0 or means.shape[0] < 2:
        return 1.0
    cell = extent / max(2.0, means.shape[0] ** (1.0 / 3.0))
    for _ in range(3):
        index = ((means - low) / cell).long()
        key = (index[:, 0] * 2_000_003 + index[:, 1]) * 2_000_003 + index[:, 2]
        per_cell = means.shape[0] / max(1, key.unique().numel())
        if 0.7 * PER_CELL < per_cell < 1.4 * PER_CELL:
            break
        cell *= float(min(2.0, max(0.5, (PER_CELL / per_cell) ** (1.0 / 3.0))))
    return cell


class Grid(NamedTuple):
    """Size of the occupancy grid, fixed for a film.

    Attributes:
        cell: Finest cell [m].
        nodes: Cells along each side.
        per_cell: Splats in a full cell.
    """

    cell: float
    nodes: int
    per_cell: float

    def of(self, means: Tensor) -> Occupancy:
        """Occupancy of centres [N, 3]."""
        return occupancy(means, self.cell, self.nodes, per_cell=self.per_cell)


def grid_for(gaussians: Gaussians, *, cell: float | None = None, radius: float = 0.0) -> Grid:
    """Size of a grid that holds the bulk of the matter.

    Args:
        gaussians: In the scene frame.
        cell: Spacing [m] at which full matter has about three splats per cell
            (:func:`occupancy_cell`); found here when None. Matter that is wide for it gets a
            coarser grid rather than one of gigabytes.
        radius: The matter will not reach farther than this from its mean [m]; found here when 0.
    """
    from gsfluent.pipeline.light_maps import bulk

    cell = occupancy_cell(gaussians) if cell is None else cell
    radius = radius or float(bulk(gaussians)[1])
    most = _MOST_NODES if gaussians.device.type == "cuda" else _MOST_NODES_CPU
    coarser = max(1.0, 2.0 * radius / (cell * (most - 2 * _ROOM)))
    nodes = int(2.0 * radius / (coarser * cell)) + 2 * _ROOM
    nodes = min(most, -(-nodes // COARSEST) * COARSEST)
    return Grid(coarser * cell, nodes, PER_CELL * coarser**3)


def estimate_normals(gaussians: Gaussians, *, cell: float | None = None) -> Tensor:
    """Outward vectors of Gaussians, shape [N, 3], to be blended; length up to one by certainty.

    Args:
        gaussians: In the scene frame, any state.
        cell: Grid spacing; found from the positions when not given.
    """
    return splat_normals(gaussians, grid_for(gaussians, cell=cell).of(gaussians.means))


def splat_normals(gaussians: Gaussians, grid: Occupancy, eye: Tensor | None = None) -> Tensor:
    """As :func:`estimate_normals`, from the occupancy of the same splats.

    Their length says how sure they are: about 0.3 on a skin, near zero deep inside, one for flat
    splats that agree with the density, zero for the few splats off the grid. Blending them as they
    are lets the sure ones decide.

    Args:
        gaussians: In the scene frame, any state.
        grid: Their occupancy.
        eye: Where the picture is taken from, [3]: what one sees of a flat splat faces that way. A
            shell is a sheet without a side to the density, from outside and from inside. When
            None, flat splats take the side of the density.
    """
    means = gaussians.means
    fine = -sample(gradient(grid.level(0), _PASSES), grid.frame, grid.nodes, means)
    wide = -sample(gradient(grid.level(_WIDE), 1), grid.frame, grid.nodes, means)
    # a skin with a gap below it is a sheet to the fine grid, and a sheet has no inside
    against = ((fine * wide).sum(-1) < 0) & (wide.norm(dim=-1) > _CLEAR)
    outward = torch.where(against[:, None], -fine, fine)
    axis, flat = _shortest_axis(gaussians)
    agreement = (axis * outward).sum(-1)
    # an axis across a clear density gradient is a splat standing on edge (hair, seams): trust the
    # density
    trusted = flat & (agreement.abs() > 0.5 * outward.norm(dim=-1) - _UNCLEAR)
    side = agreement if eye is None else (axis * (eye - means)).sum(-1)
    return torch.where(trusted[:, None], axis * side.sign()[:, None], outward)


def gradient(volume: Tensor, passes: int) -> Tensor:
    """Gradient per cell [3, D, D, D] in x, y, z of a volume [D, D, D] (z, y, x), smoothed before.

    Args:
        volume: Values at cell centres; zero outside.
        passes: Passes of [1, 2, 1] / 4 along each axis.
    """
    smooth, slope = _kernels(passes, volume.dtype, volume.device)
    for axis in range(3):
        shape, pad = [1, 1, 1, 1, 1], [0, 0, 0]
        shape[2 + axis], pad[axis] = 2 * passes + 1, passes
        volume = conv3d(volume.view(1, 1, *volume.shape[-3:]), smooth.view(shape), padding=pad)
    return conv3d(volume, slope, padding=1)[0]


@functools.lru_cache(maxsize=16)
def _kernels(passes: int, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """Binomial kernel [2 passes + 1] and central differences [3, 1, 3, 3, 3]."""
    row = [math.comb(2 * passes, k) / 4.0**passes for k in range(2 * passes + 1)]
    slope = torch.zeros(3, 1, 3, 3, 3, dtype=torch.float64)
    slope[0, 0, 1, 1, 0] = slope[1, 0, 1, 0, 1] = slope[2, 0, 0, 1, 1] = -0.5
    slope[0, 0, 1, 1, 2] = slope[1, 0, 1, 2, 1] = slope[2, 0, 2, 1, 1] = 0.5
    smooth = torch.tensor(row, dtype=torch.float64)
    return smooth.to(device, dtype), slope.to(device, dtype)


def _shortest_axis(gaussians: Gaussians) -> tuple[Tensor, Tensor]:
    """Unit shortest axis [N, 3] of each splat, and whether it is flat, bool [N]."""
    scales, quats = gaussians.scales, normalize(gaussians.quats, dim=-1)
    shortest, index = scales.min(dim=-1)
    middle = scales.sum(-1) - shortest - scales.amax(-1)
    along = torch.nn.functional.one_hot(index, 3).to(scales)
    w, vector = quats[:, :1], quats[:, 1:]
    once = torch.linalg.cross(vector, along)
    return along + 2.0 * (w * once + torch.linalg.cross(vector, once)), shortest < _FLAT * middle
