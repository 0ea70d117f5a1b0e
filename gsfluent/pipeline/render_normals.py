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
from gsfluent.data import Gaussians

# Gaussians per occupied cell wanted in the occupancy grid: fewer leaves pinholes, more rounds edges
# away.
_PER_CELL = 3.0
# A Gaussian is called flat when its shortest axis is below this share of the middle one.
_FLAT = 0.5


def occupancy_cell(means: Tensor) -> float:
    """Cell size [units of ``means``] at which occupied cells hold about three Gaussians.

    Args:
        means: Positions, shape [N, 3].
    """
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
    """Outward unit normals [N, 3]: minus the gradient of the blurred occupancy at each point.

    Occupancy is the scattered count, cut off at what full matter has; otherwise the crowded skin of
    a reconstruction would be a ridge whose inner half points inward. Scatter and gather are the
    solver's own: its sparse grid costs nothing where there is nothing, however far debris flies,
    and the affine part of the gather is the least-squares gradient.

    Args:
        means: Positions, shape [N, 3].
        cell: Grid spacing, see :func:`occupancy_cell`.
    """
    blocks = ops.build_blocks(means, cell)
    still = torch.zeros_like(means)
    flat = torch.zeros(means.shape[0], 3, 3, dtype=means.dtype, device=means.device)
    count = torch.ones_like(means[:, 0])
    grid, _ = ops.p2g(means, still, flat, count, dx=cell, blocks=blocks)
    field = torch.zeros_like(grid[..., :3])
    field[..., 0] = grid[..., 3].clamp(max=_PER_CELL)
    _, _, affine, _ = ops.g2p(field, means, dx=cell, dt=0.0, blocks=blocks)
    return torch.nn.functional.normalize(-affine[:, 0], dim=-1)


def estimate_normals(gaussians: Gaussians, *, cell: float | None = None) -> Tensor:
    """Outward unit normals of Gaussians, shape [N, 3]; zero deep inside, where there is no outward.

    Args:
        gaussians: In the scene frame, any state.
        cell: Grid spacing; found from the positions when not given.
    """
    means = gaussians.means
    outward = density_normals(means, occupancy_cell(means) if cell is None else cell)
    scales = gaussians.scales
    shortest_scale, index = scales.min(dim=-1)
    middle_scale = scales.sum(-1) - shortest_scale - scales.amax(-1)
    flat = (shortest_scale < _FLAT * middle_scale).nonzero()[:, 0]
    axes = geometry.quaternion_to_matrix(gaussians.quats[flat])
    shortest = torch.gather(axes, 2, index[flat, None, None].expand(-1, 3, 1)).squeeze(-1)
    agreement = (shortest * outward[flat]).sum(-1)
    # an axis across the density gradient is a splat standing on edge (hair, seams): trust the
    # density
    trusted = agreement.abs() > 0.5
    turned = shortest[trusted] * agreement[trusted].sign()[:, None]
    return outward.index_copy(0, flat[trusted], turned)
