"""Opacity density of a splat cloud on a voxel grid.

``d(x) = sum_p alpha_p exp(-1/2 (x - x_p)^T A_p^-1 (x - x_p))`` (GaussianFluent, Eq. 2) evaluated
with the exact anisotropic covariance of every splat. What makes it safe for real files: standard
deviations are clamped to a range given in voxels, so a needle of size 1e-15 cannot slip between
voxels or divide by zero, and a splat as large as the room costs a bounded number of voxels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gsfluent.geometry import quaternion_to_matrix

_RADII = (2, 3, 4, 6, 8, 12, 16, 20)  # half-widths [voxels] that splats are grouped into
_CUTOFF = 2.5  # standard deviations; exp(-3.1) = 0.044 of the peak is dropped
_MIN_SIGMA = 0.5  # voxels: a surface sampled about once per voxel stays closed
_MAX_SIGMA = _RADII[-1] / _CUTOFF
# kernel values per batch: 16 MB of float32 stay in the caches of a CPU, a GPU wants to be filled
_CHUNK, _CHUNK_CUDA = 4_000_000, 64_000_000
_FIXED = float(1 << 32)  # fixed-point unit of the sums on a GPU


@dataclass(frozen=True)
class GridBox:
    """An axis-aligned voxel grid; voxel ``i`` is centred on ``origin + (i + 0.5) * voxel``."""

    origin: tuple[float, float, float]
    voxel: float
    shape: tuple[int, int, int]

    @staticmethod
    def of(origin: Tensor | np.ndarray, voxel: float, shape: Sequence[int]) -> GridBox:
        """A grid from its corner [3] and its numbers of voxels."""
        x, y, z = (float(part) for part in origin)
        return GridBox((x, y, z), voxel, (int(shape[0]), int(shape[1]), int(shape[2])))

    def centers(self, index: np.ndarray) -> np.ndarray:
        """World positions [M, 3] of voxel indices [M, 3]."""
        return np.asarray(self.origin) + (index + 0.5) * self.voxel


def choose_grid(means: Tensor, opacities: Tensor, resolution: int) -> tuple[GridBox, int]:
    """Grid around the splats that matter.

    A few stray splats far away ("floaters") must not blow the box up: when the box of all visible
    splats is more than 1.5 times the box of the central 99 % along some axis, that axis falls back
    to the central 99 % widened by a quarter.

    Args:
        means: Splat centres [N, 3], world units.
        opacities: [N] in 0..1.
        resolution: Voxels along the longest side of the object (the grid adds a rim of three
            voxels).

    Returns:
        The grid and the number of visible splats that lie outside it.
    """
    visible = means[opacities > 0.05]
    if visible.shape[0] < 8:
        visible = means
    points = visible.detach().double()
    ordered = points.T.contiguous().sort(dim=1).values
    low, high = ordered[:, 0].cpu().numpy(), ordered[:, -1].cpu().numpy()
    inner_low, inner_high = (_quantile(ordered, share) for share in (0.005, 0.995))
    inner = np.maximum(inner_high - inner_low, 1e-12)
    stray = (high - low) > 1.5 * inner + 1e-9
    low = np.where(stray, np.maximum(low, inner_low - 0.25 * inner), low)
    high = np.where(stray, np.minimum(high, inner_high + 0.25 * inner), high)
    extent = float((high - low).max())
    voxel = max(extent, 1e-9) / max(resolution - 1, 1)
    rim = 3
    shape = np.ceil((high - low) / voxel).astype(int) + 1 + 2 * rim
    middle = 0.5 * (low + high)
    origin = middle - 0.5 * shape * voxel
    corners = torch.from_numpy(np.stack([origin, origin + shape * voxel])).to(points.device)
    outside = int(((points < corners[0]) | (points > corners[1])).any(1).sum())
    return GridBox.of(origin, voxel, shape), outside


def _quantile(ordered: Tensor, share: float) -> np.ndarray:
    """Linear quantile [3] of the sorted rows of ``ordered`` [3, N]."""
    place = share * (ordered.shape[1] - 1)
    below = int(place)
    above = min(below + 1, ordered.shape[1] - 1)
    between = torch.lerp(ordered[:, below], ordered[:, above], place - below)
    value: np.ndarray = between.cpu().numpy()
    return value


def density_field(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    box: GridBox,
) -> Tensor:
    """Sum of opacity-weighted Gaussians at every voxel centre.

    Splats are grouped by the voxel half-widths of their box; within a group the quadratic form of
    all splats at all offsets is one matrix product, because ``(o - f)^T P (o - f)`` is linear in
    ten monomials of the offset ``o``. It runs where ``means`` live. On a GPU the terms are summed
    in fixed point (2^-32), because sums of integers do not depend on the order in which threads
    come: the same splats give the same field.

    Args:
        means: [N, 3] world units.
        quats: [N, 4] wxyz, any non-zero norm.
        scales: [N, 3] standard deviations, world units, > 0.
        opacities: [N] in 0..1.
        box: Target grid.

    Returns:
        Density float32 [X, Y, Z], dimensionless, on the device of ``means``.
    """
    device = means.device
    fixed = device.type == "cuda"
    pad = _RADII[-1]
    shape = tuple(s + 2 * pad for s in box.shape)
    field = torch.zeros(
        shape[0] * shape[1] * shape[2],
        dtype=torch.int64 if fixed else torch.float32,
        device=device,
    )
    origin = torch.tensor(box.origin, dtype=torch.float64, device=device)
    position = (means.detach().double() - origin) / box.voxel - 0.5
    limit = torch.tensor(box.shape, dtype=torch.float64, device=device) - 0.5
    keep = ((position > -0.5) & (position < limit)).all(1) & (opacities.detach() > 1e-3)
    position = position[keep]
    sigma = (scales.detach().double()[keep] / box.voxel).clamp(_MIN_SIGMA, _MAX_SIGMA)
    rotation = quaternion_to_matrix(quats.detach().double()[keep])
    alpha = opacities.detach().float()[keep]
    precision = torch.einsum("nij,nj,nkj->nik", rotation, sigma**-2, rotation)
    reach = _CUTOFF * torch.einsum("nij,nj->ni", rotation**2, sigma**2).sqrt()

    radii = torch.tensor(_RADII, dtype=torch.float64, device=device)
    bucket = torch.bucketize(reach, radii).clamp_(max=len(_RADII) - 1)
    key = (bucket[:, 0] * len(_RADII) + bucket[:, 1]) * len(_RADII) + bucket[:, 2]
    base = position.round().long()
    fraction = position - base
    flat_base = ((base[:, 0] + pad) * shape[1] + base[:, 1] + pad) * shape[2] + base[:, 2] + pad
    coefficients = _quadratic_coefficients(precision, fraction).float()

    for value in key.unique().tolist():
        members = (key == value).nonzero()[:, 0]
        size = len(_RADII)
        half = [_RADII[value // size // size], _RADII[value // size % size], _RADII[value % size]]
        offset = torch.cartesian_prod(*(torch.arange(-h, h + 1, device=device) for h in half))
        flat_offset = (offset[:, 0] * shape[1] + offset[:, 1]) * shape[2] + offset[:, 2]
        monomials = _monomials(offset.float())
        step = max(1, (_CHUNK_CUDA if fixed else _CHUNK) // offset.shape[0])
        for start in range(0, members.shape[0], step):
            part = members[start : start + step]
            weight = (coefficients[part] @ monomials.T).clamp_(min=0.0).mul_(-0.5).exp_()
            weight *= alpha[part, None]
            index = flat_base[part, None] + flat_offset[None]
            if fixed:
                weight = weight.double().mul_(_FIXED).long()
            field.index_add_(0, index.reshape(-1), weight.reshape(-1))
    inner = field.view(shape)[pad:-pad, pad:-pad, pad:-pad]
    return (inner.double() / _FIXED).float() if fixed else inner.clone()


def _quadratic_coefficients(precision: Tensor, fraction: Tensor) -> Tensor:
    """Coefficients [N, 10] of ``(o - f)^T P (o - f)`` in the monomials of :func:`_monomials`."""
    linear = torch.einsum("nij,nj->ni", precision, fraction)
    constant = torch.einsum("ni,ni->n", linear, fraction)
    p = precision
    columns = [p[:, 0, 0], p[:, 1, 1], p[:, 2, 2], 2 * p[:, 0, 1], 2 * p[:, 0, 2], 2 * p[:, 1, 2]]
    columns += [-2 * linear[:, 0], -2 * linear[:, 1], -2 * linear[:, 2], constant]
    return torch.stack(columns, dim=1)


def _monomials(offset: Tensor) -> Tensor:
    """Monomials [M, 10] xx, yy, zz, xy, xz, yz, x, y, z, 1 of integer offsets [M, 3]."""
    x, y, z = offset.unbind(1)
    return torch.stack(
        [x * x, y * y, z * z, x * y, x * z, y * z, x, y, z, torch.ones_like(x)], dim=1
    )
