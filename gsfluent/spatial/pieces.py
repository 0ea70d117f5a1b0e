"""Matter cut into small pieces along a space-filling curve: the ground that Gaussians stand on."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from gsfluent.spatial.voxels import small_convolutions

_PER_SPACING = 1.7  # pieces per spacing and axis, at least
_FINEST = 8  # pieces per voxel and axis, at most


def hilbert_code(cells: Tensor, bits: int) -> Tensor:
    """Position of cells along a Hilbert curve: neighbours on the curve are neighbours in space.

    Args:
        cells: Non-negative integers below ``2**bits``, [N, 3].
        bits: Bits per axis, at most 20.

    Returns:
        Positions int64 [N], each below ``8**bits``, all different for different cells.

    Source: Skilling, "Programming the Hilbert curve", 2004.
    """
    if not 1 <= bits <= 20:
        raise ValueError(f"hilbert_code: bits must be in 1..20, got {bits}")
    axes = [cells[:, i].long() for i in range(3)]
    zero = torch.zeros_like(axes[0])
    for level in range(bits - 1, 0, -1):
        low = (1 << level) - 1
        for i in range(3):
            high = (axes[i] >> level & 1).bool()
            swap = torch.where(high, zero, (axes[0] ^ axes[i]) & low)
            axes[0] = torch.where(high, axes[0] ^ low, axes[0] ^ swap)
            if i:
                axes[i] = axes[i] ^ swap
    axes[1] = axes[1] ^ axes[0]
    axes[2] = axes[2] ^ axes[1]
    turn = zero
    for level in range(bits - 1, 0, -1):
        turn = torch.where((axes[2] >> level & 1).bool(), turn ^ ((1 << level) - 1), turn)
    code = zero
    axes = [axis ^ turn for axis in axes]
    for level in range(bits - 1, -1, -1):
        for axis in axes:
            code = code << 1 | (axis >> level & 1)
    return code


def signed_depth(inside: Tensor, depth: Tensor) -> Tensor:
    """Depth [voxels] that changes sign half a voxel outside the outermost centres, [X, Y, Z].

    Stairs of whole voxels are smoothed with weights 1, 2, 1 along each axis.

    Args:
        inside: Voxels, bool [X, Y, Z].
        depth: Depth of inner voxels [voxels], [X, Y, Z].
    """
    field = torch.where(inside, depth.float(), -0.5)[None, None]
    for axis in range(3):
        size = [1, 1, 1]
        size[axis] = 3
        pad = [0] * 6
        pad[4 - 2 * axis] = pad[5 - 2 * axis] = 1
        kernel = field.new_tensor([0.25, 0.5, 0.25]).view(1, 1, *size)
        with small_convolutions():
            field = functional.conv3d(functional.pad(field, pad, mode="replicate"), kernel)
    # sheets one voxel thick stay inside
    return torch.where(inside, field[0, 0].clamp_min(0.05), field[0, 0])


def sample(field: Tensor, points: Tensor) -> Tensor:
    """Trilinear values [N] of a field [X, Y, Z] at points [N, 3] in voxel units.

    Of several fields [C, X, Y, Z] at once the values are [C, N].
    """
    size = torch.tensor(field.shape[-3:], device=field.device)
    place = (2.0 * points.to(field) / size - 1.0).flip(-1)
    several = field if field.dim() == 4 else field[None]
    value = functional.grid_sample(
        several[None], place[None, None, None], align_corners=False, padding_mode="border"
    )[0, :, 0, 0]
    return value if field.dim() == 4 else value[0]


def small_pieces(index: Tensor, spacing: Tensor, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Cut voxels into cubes so small that several share one Gaussian.

    Args:
        index: Voxels, int64 [N, 3].
        spacing: Wanted distance between Gaussians there [voxels], [N].
        seed: Seed of the jitter of the cubes' points.

    Returns:
        One point per cube [M, 3] in voxel units, uniform inside its cube; the voxel each belongs to
        (row of ``index``), int64 [M]; volume of each cube [voxels cubed], [M].
    """
    cuts = (_PER_SPACING / spacing).ceil().clamp(1, _FINEST).to(torch.int64)
    draw = torch.Generator().manual_seed(seed)
    points, rows, volumes = [], [], []
    for cut in cuts.unique().tolist():
        row = (cuts == cut).nonzero()[:, 0]
        line = torch.arange(cut, device=index.device)
        corner = torch.cartesian_prod(line, line, line).view(-1, 3)
        place = index[row][:, None] * cut + corner
        shift = torch.rand(place.shape, generator=draw).to(index.device)
        points.append(((place + shift) / cut).reshape(-1, 3))
        rows.append(row.repeat_interleave(len(corner)))
        volumes.append(torch.full_like(points[-1][:, 0], cut**-3))
    if not points:
        empty = index.new_zeros(0)
        return index.new_zeros(0, 3).float(), empty, empty.float()
    return torch.cat(points), torch.cat(rows), torch.cat(volumes)
