"""Normals of Gaussians in any state, whole or broken, from where matter is now.

The outward normal is minus the gradient of the blurred occupancy of space. It exists on the skin,
on crack faces and on debris alike, needs no memory of the rest state and, unlike a plane fitted to
neighbours (PCA), it has a side. Flat Gaussians know their plane better than any neighbourhood does:
they use their shortest axis, turned outward.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gsfluent import geometry
from gsfluent.data import Gaussians

# Gaussians per occupied cell wanted in the occupancy grid: fewer leaves pinholes, more rounds edges
# away.
_PER_CELL = 3.0
_MAX_CELLS = 4_000_000
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
    # debris that flew far must not ask for a grid of its own flight
    cells = float(((high - low) / cell + 7.0).prod())
    return cell * max(1.0, (cells / _MAX_CELLS) ** (1.0 / 3.0))


def density_normals(means: Tensor, cell: float) -> Tensor:
    """Outward unit normals [N, 3]: minus the gradient of the blurred occupancy at each point.

    Occupancy saturates at one per cell; otherwise the crowded skin of a reconstruction would be a
    ridge whose inner half points inward.

    Args:
        means: Positions, shape [N, 3].
        cell: Grid spacing, see :func:`occupancy_cell`.
    """
    low = means.amin(0) - 3.0 * cell
    size = ((means.amax(0) - low) / cell).long() + 4
    nx, ny, nz = (int(s) for s in size)
    index = ((means - low) / cell).long()
    flat = (index[:, 0] * ny + index[:, 1]) * nz + index[:, 2]
    grid = torch.zeros(nx * ny * nz, dtype=means.dtype, device=means.device)
    grid[flat] = 1.0
    grid = grid.reshape(1, 1, nx, ny, nz)
    kernel = torch.tensor([1.0, 4.0, 6.0, 4.0, 1.0], dtype=means.dtype, device=means.device) / 16.0
    for axis in range(3):
        shape = [1, 1, 1, 1, 1]
        shape[2 + axis] = 5
        padding = [0, 0, 0]
        padding[axis] = 2
        grid = torch.nn.functional.conv3d(grid, kernel.reshape(shape), padding=padding)
    gradient = torch.stack(torch.gradient(grid[0, 0]))
    # grid_sample wants (z, y, x) order in [-1, 1], cell centres at +0.5
    unit = ((means - low) / cell) / size.to(means.dtype) * 2.0 - 1.0
    sampled = torch.nn.functional.grid_sample(
        gradient[None], unit.flip(-1)[None, None, None], mode="bilinear", align_corners=False
    )
    return torch.nn.functional.normalize(-sampled[0, :, 0, 0].T, dim=-1)


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
