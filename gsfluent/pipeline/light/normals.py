"""Normals of Gaussians in any state, whole or broken, from where matter is now.

The outward normal is minus the gradient of the smoothed occupancy of space. It exists on the skin,
on crack faces and on debris alike, needs no memory of the rest state and, unlike a plane fitted to
neighbours (PCA), it has a side. Flat Gaussians add their shortest axis, and on a sheet, where the
density has no side, take it alone. Nothing but :func:`occupancy_cell` and
:func:`grid_for` waits for the device; both are called once per film.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gsfluent import geometry, ops
from gsfluent.data import INTERIOR, SPRAY, SURFACE, Gaussians
from gsfluent.pipeline.light.occlusion import COARSEST, FULL, PER_CELL, Occupancy, box_frame
from gsfluent.pipeline.light.shadow_maps import bulk

# Opacity from which a splat of a skin is matter.
_FAINT = 0.3
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

    def of(self, gaussians: Gaussians, center: tuple[float, float, float]) -> Occupancy:
        """Occupancy of Gaussians around ``center`` [m]; those off the grid are left out.

        Spray is, too: a cloud of drops is no wall, however many there are. Nor is the haze of faint
        splats that photographs leave around a skin, and into which a division makes its splats: it
        counted as matter, and whatever is seen through it was in black shadow.
        """
        means = gaussians.means
        frame = means.new_tensor(box_frame(center, self.cell, self.nodes))
        if gaussians.labels is not None:
            off = frame[:3] - 2.0 * self.cell
            faint = (gaussians.labels == SURFACE) & (gaussians.opacities < _FAINT)
            means = torch.where((faint | (gaussians.labels == SPRAY))[:, None], off, means)
        values = ops.occupancy(means, frame, self.nodes, full=FULL * self.per_cell)
        return Occupancy(values, frame, self.nodes)


def grid_for(gaussians: Gaussians, *, cell: float | None = None, radius: float = 0.0) -> Grid:
    """Size of a grid that holds the bulk of the matter.

    Args:
        gaussians: In the scene frame.
        cell: Spacing [m] at which full matter has about three splats per cell
            (:func:`occupancy_cell`); found here when None. Matter that is wide for it gets a
            coarser grid rather than one of gigabytes.
        radius: The matter will not reach farther than this from its mean [m]; found here when 0.
    """
    cell = occupancy_cell(gaussians) if cell is None else cell
    radius = radius or bulk(gaussians).radius
    most = _MOST_NODES if gaussians.device.type == "cuda" else _MOST_NODES_CPU
    coarser = max(1.0, 2.0 * radius / (cell * (most - 2 * _ROOM)))
    nodes = int(2.0 * radius / (coarser * cell)) + 2 * _ROOM
    nodes = min(most, -(-nodes // COARSEST) * COARSEST)
    return Grid(coarser * cell, nodes, PER_CELL * coarser**3)


def estimate_normals(gaussians: Gaussians, *, cell: float | None = None) -> Tensor:
    """Outward vectors of Gaussians, shape [N, 3], to be blended; length up to one by certainty."""
    matter = bulk(gaussians)
    grid = grid_for(gaussians, cell=cell, radius=matter.radius)
    return splat_normals(gaussians, grid.of(gaussians, matter.center))


def splat_normals(gaussians: Gaussians, grid: Occupancy, eye: Tensor | None = None) -> Tensor:
    """As :func:`estimate_normals`, from the occupancy of the same splats.

    Their length says how sure they are: about 0.3 on a skin, near zero deep inside, one for flat
    splats, zero for the few splats off the grid. Blending them as they are lets the sure ones
    decide.

    Args:
        gaussians: In the scene frame, any state.
        grid: Their occupancy.
        eye: Where the picture is taken from, [3]: what one sees faces that way. A shell is a sheet
            without a side to the density, from outside and from inside. When None, vectors take
            the side of the density.
    """
    return ops.density_normals(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        grid.values,
        grid.frame,
        grid.nodes,
        eye=eye,
    )


def plate_normals(gaussians: Gaussians, eye: Tensor) -> Tensor:
    """Shortest axes of Gaussians, turned to the eye [3], unit vectors [N, 3]."""
    turn = geometry.quaternion_to_matrix(gaussians.quats)
    shortest = gaussians.scales.argmin(dim=1)[:, None, None].expand(-1, 3, 1)
    axis = turn.gather(2, shortest)[..., 0]
    away = ((eye - gaussians.means) * axis).sum(dim=1, keepdim=True) < 0.0
    return torch.where(away, -axis, axis)
