"""Normals of Gaussians in any state, whole or broken, from where matter is now.

The outward normal is minus the gradient of the blurred occupancy of space. It exists on the skin,
on crack faces and on debris alike, needs no memory of the rest state and, unlike a plane fitted to
neighbours (PCA), it has a side. Flat Gaussians know their plane better than any neighbourhood does:
they use their shortest axis, turned outward.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gsfluent import geometry, ops
from gsfluent.data import INTERIOR, Gaussians

# Gaussians per occupied cell wanted in the occupancy grid: fewer leaves pinholes, more rounds edges
# away.
_PER_CELL = 3.0
# Share of the full count from which a place is full; below one, because counts scatter.
_FULL = 0.8
# Debris all over the place gets a coarser grid rather than a look-up table of gigabytes.
_MAX_CELLS_ACROSS = 800
# Cell of the wide look that settles which side is out, in fine cells, and how clear it must be.
_WIDER = 4.0
_CLEAR = 0.1
# A Gaussian is called flat when its shortest axis is below this share of the middle one.
_FLAT = 0.5


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
        if 0.7 * _PER_CELL < per_cell < 1.4 * _PER_CELL:
            break
        cell *= float(min(2.0, max(0.5, (_PER_CELL / per_cell) ** (1.0 / 3.0))))
    return cell


def density_normals(means: Tensor, cell: float) -> Tensor:
    """Outward vectors [N, 3]: minus the gradient of the occupancy of space, times ``cell``.

    Their length, at most one, says how sure they are: about 0.3 on a skin, near zero deep inside,
    zero for the few splats that flew far from all others. Blending them as they are lets the sure
    ones decide.

    Occupancy is the scattered count over what full matter has, cut off below one; otherwise the
    crowded skin of a reconstruction would be a ridge whose inner half points inward. A second, four
    times wider look turns what still points inward. Scatter and gather are the solver's own: the
    affine part of the gather is the least-squares gradient.

    Args:
        means: Positions, shape [N, 3].
        cell: Grid spacing, see :func:`occupancy_cell`.
    """
    core = _together(means)
    normals = torch.zeros_like(means)
    extent = float((means[core].amax(0) - means[core].amin(0)).amax())
    coarser = max(1.0, extent / (_MAX_CELLS_ACROSS * cell))
    fine = _occupancy_gradient(means[core], coarser * cell, _PER_CELL * coarser**3)
    coarser *= _WIDER
    wide = _occupancy_gradient(means[core], coarser * cell, _PER_CELL * coarser**3)
    # a skin with a gap below it is a sheet to the fine grid, and a sheet has no inside
    against = ((fine * wide).sum(-1) < 0) & (wide.norm(dim=-1) > _CLEAR)
    normals[core] = torch.where(against[:, None], -fine, fine)
    return normals


def _together(means: Tensor) -> Tensor:
    """Mask [N] without the few splats that flew much farther than the rest.

    The look-up table of the sparse grid spans their bounding box; a crumb metres away would make it
    huge, and has no surface that anyone could see.
    """
    sample = means[:: max(1, means.shape[0] // 20_000)].double()
    tails = torch.tensor([0.01, 0.99], dtype=torch.float64, device=means.device)
    low, high = torch.quantile(sample, tails, dim=0).to(means)
    reach = (high - low).amax()
    return ((means >= low - reach) & (means <= high + reach)).all(dim=1)


def _occupancy_gradient(means: Tensor, cell: float, full: float) -> Tensor:
    """Minus the gradient of the occupancy [N, 3] per cell, where ``full`` points fill a cell."""
    blocks = ops.build_blocks(means, cell)
    still = torch.zeros_like(means)
    flat = torch.zeros(means.shape[0], 3, 3, dtype=means.dtype, device=means.device)
    count = torch.ones_like(means[:, 0])
    grid, _ = ops.p2g(means, still, flat, count, dx=cell, blocks=blocks)
    field = torch.zeros_like(grid[..., :3])
    field[..., 0] = (grid[..., 3] / full).clamp(max=_FULL)
    _, _, affine, _ = ops.g2p(field, means, dx=cell, dt=0.0, blocks=blocks)
    outward = -cell * affine[:, 0]
    return outward / outward.norm(dim=-1, keepdim=True).clamp(min=1.0)


def estimate_normals(gaussians: Gaussians, *, cell: float | None = None) -> Tensor:
    """Outward vectors of Gaussians, shape [N, 3], to be blended; length up to one by certainty.

    Args:
        gaussians: In the scene frame, any state.
        cell: Grid spacing; found from the positions when not given.
    """
    means = gaussians.means
    outward = density_normals(means, occupancy_cell(gaussians) if cell is None else cell)
    scales = gaussians.scales
    shortest_scale, index = scales.min(dim=-1)
    middle_scale = scales.sum(-1) - shortest_scale - scales.amax(-1)
    flat = (shortest_scale < _FLAT * middle_scale).nonzero()[:, 0]
    axes = geometry.quaternion_to_matrix(gaussians.quats[flat])
    shortest = torch.gather(axes, 2, index[flat, None, None].expand(-1, 3, 1)).squeeze(-1)
    sure = torch.nn.functional.normalize(outward[flat], dim=-1)
    agreement = (shortest * sure).sum(-1)
    # an axis across the density gradient is a splat standing on edge (hair, seams): trust the
    # density
    trusted = agreement.abs() > 0.5
    turned = shortest[trusted] * agreement[trusted].sign()[:, None]
    return outward.index_copy(0, flat[trusted], turned)
