"""Deformation operators in plain PyTorch: the definitions the kernels are tested against."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gsfluent.geometry import quaternion_to_matrix

CUT_REACH = 2.0
"""Faces further than this many standard deviations from a centre leave a Gaussian alone."""
CUT_BEYOND = -1.5
"""Faces that left less than so many deviations of it cut no further."""
CUT_CORNER = 0.5
"""Deviations by which a cut may lie in a third point's cell."""


def polar_clamped(deformation: Tensor, lo: float = 0.3, hi: float = 2.0) -> tuple[Tensor, Tensor]:
    """Rotation and stretch-clamped deformation by LAPACK's SVD; see ``gsfluent.ops``.

    Args:
        deformation: Deformation gradients, shape [N, 3, 3], finite.
        lo: Smallest stretch kept [-].
        hi: Largest stretch kept [-].

    Returns:
        ``(R, F_clamped)``, both [N, 3, 3].
    """
    u, s, vh = torch.linalg.svd(deformation)
    # LAPACK's factors may be reflections; move both signs onto the smallest singular value.
    sign = torch.linalg.det(u) * torch.linalg.det(vh)
    u = torch.cat([u[..., :2], u[..., 2:] * torch.linalg.det(u)[:, None, None]], dim=-1)
    vh = torch.cat([vh[..., :2, :], vh[..., 2:, :] * torch.linalg.det(vh)[:, None, None]], dim=-2)
    s = torch.cat([s[:, :2], s[:, 2:] * sign[:, None]], dim=-1)
    return u @ vh, (u * s.clamp(lo, hi)[:, None, :]) @ vh


def cut_at(
    mean: Tensor, covariance: Tensor, normal: Tensor, distance: Tensor
) -> tuple[Tensor, Tensor]:
    """Moments of the part of Gaussians below a plane; see :func:`gsfluent.ops.cut_at_cells`.

    Args:
        mean: [N, 3].
        covariance: [N, 3, 3].
        normal: Unit vectors to the plane, [N, 3].
        distance: Distance of the plane along the normal, [N]; infinite for none.

    Returns:
        Means [N, 3] and covariances [N, 3, 3].
    """
    along = (covariance @ normal[..., None])[..., 0]
    sigma = (along * normal).sum(dim=1).clamp(min=1e-30).sqrt()
    t = (distance / sigma).clamp(min=CUT_BEYOND)
    density = torch.exp(-0.5 * t.square()) / math.sqrt(2.0 * math.pi)
    h = density / torch.special.ndtr(t)
    step = along / sigma[:, None]
    less = torch.nan_to_num(t * h, posinf=0.0) + h.square()
    shrunk = covariance - less[:, None, None] * step[:, :, None] * step[:, None]
    return mean - h[:, None] * step, shrunk


def link_states(
    position: Tensor,
    apart: Tensor,
    near: Tensor,
    piece: Tensor,
    *,
    none: Tensor,
    together: float,
    loose: float,
    open: float,
    back: float,
    broken: Tensor | None = None,
    before: tuple[Tensor, Tensor] | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """As :func:`gsfluent.ops.link_states`, of neighbours that are rows."""
    count = near.shape[0]
    own = near == torch.arange(count, device=near.device)[:, None]
    now = (position[near] - position[:count, None]).norm(dim=2)
    ratio = torch.where(own, 1.0, now / apart.clamp(min=1e-12))
    mine, theirs = piece[:count, None], piece[near]
    limit = torch.where(mine == theirs, together, loose)
    limit = torch.where((mine < 0) | (theirs < 0), loose, limit)
    if broken is not None:
        limit = torch.where(broken[:count, None] | broken[near], loose, limit)
    opening = torch.full_like(ratio, open)
    if before is not None:
        limit = torch.where(before[0], back * limit, limit)
        opening = torch.where(before[1], back * opening, opening)
    parted = (ratio > limit) | ((mine != theirs) & (mine >= 0) & (theirs >= 0))
    return parted | none, parted & (ratio > opening) & ~none, ratio


def cut_at_cells(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    owner: Tensor,
    near: Tensor,
    opened: Tensor,
    rest: Tensor,
    slack: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """Rows of the splats that are cut, int64 [C], and their means and covariances [C, 3, 3]."""
    index, gone = near[owner], opened[owner]
    points = rest[index]
    across = points - rest[owner][:, None]
    width = across.norm(dim=2)
    normal = across / width.clamp(min=1e-12)[..., None]
    halfway = (points - means[:, None]).square().sum(dim=2)
    halfway = (halfway - (rest[owner] - means).square().sum(dim=1, keepdim=True)) / (
        2.0 * width.clamp(min=1e-12)
    )
    root = quaternion_to_matrix(quats) * scales[:, None, :]
    sigma = (normal @ root).norm(dim=2)
    pair = (gone & (width > 0.0) & (halfway < CUT_REACH * sigma)).nonzero()
    m, k = pair.unbind(dim=1)
    # The face must be there: not where a third point's cell begins.
    spot = means[m] + halfway[m, k, None] * normal[m, k]
    third = (points[m] - spot[:, None]).norm(dim=2).amin(dim=1)
    own = (rest[owner[m]] - spot).norm(dim=1)
    kept = third >= own - CUT_CORNER * sigma[m, k]
    cut = torch.zeros_like(gone)
    cut[m[kept], k[kept]] = True
    rows = cut.any(dim=1).nonzero()[:, 0]
    mean, covariance = means[rows], (root @ root.mT)[rows]
    for column in range(near.shape[1]):
        here = cut[rows, column]
        n = normal[rows, column]
        anchor = rest[owner[rows]] + 0.5 * across[rows, column]
        distance = ((anchor - mean) * n).sum(dim=1)
        distance = distance + slack * (n[:, None] @ covariance @ n[..., None])[:, 0, 0].sqrt()
        mean, covariance = cut_at(mean, covariance, n, torch.where(here, distance, torch.inf))
    return rows, mean, covariance
