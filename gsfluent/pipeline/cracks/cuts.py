"""Splats cut at cracks: what a crack leaves on its side of a splat that lay across it.

Half a Gaussian is no Gaussian, but it has a mean and a variance. With ``t`` the distance of the
crack from the centre in standard deviations and ``h = phi(t) / Phi(t)`` of the normal distribution,
the part on the near side has its mean ``h`` standard deviations further in and the variance
``1 - t h - h^2`` across the crack; along it nothing changes::

    mean' = mean - h S n / s,    S' = S - (t h + h^2) (S n)(S n)^T / s^2,    s^2 = n^T S n
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gsfluent import geometry, ops

REACH = 2.0
"""Cracks further than this many standard deviations from a centre leave the splat alone."""
_BEYOND = -1.5  # cracks that left less than this many deviations of a splat cut no further
_CORNER = 0.5  # deviations by which the cut may lie in a third point's cell


def cut_at(
    mean: Tensor, covariance: Tensor, normal: Tensor, distance: Tensor
) -> tuple[Tensor, Tensor]:
    """Moments of the part of Gaussians below a plane.

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
    t = (distance / sigma).clamp(min=_BEYOND)
    density = torch.exp(-0.5 * t.square()) / math.sqrt(2.0 * math.pi)
    h = density / torch.special.ndtr(t)
    step = along / sigma[:, None]
    less = torch.nan_to_num(t * h, posinf=0.0) + h.square()
    shrunk = covariance - less[:, None, None] * step[:, :, None] * step[:, None]
    return mean - h[:, None] * step, shrunk


def cut_splats(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    owner: Tensor,
    near: Tensor,
    opened: Tensor,
    rest: Tensor,
    slack: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Cut splats at rest where the cells of their own points border on points that moved away.

    Args:
        means: Centres [m], [M, 3].
        quats: Orientations, [M, 4].
        scales: Standard deviations [m], [M, 3].
        owner: Point of each splat, int64 [M].
        near: Neighbours of every point, int64 [N, K].
        opened: Which of them have moved away, bool [N, K].
        rest: Points at rest [m], [N, 3].
        slack: Standard deviations by which cuts stay outside of the cracks.

    Returns:
        Rows of the splats that were cut, int64 [C], and their means, quats and scales.
    """
    index, gone = near[owner], opened[owner]
    points = rest[index]
    across = points - rest[owner][:, None]
    width = across.norm(dim=2)
    normal = across / width.clamp(min=1e-12)[..., None]
    halfway = (points - means[:, None]).square().sum(dim=2)
    halfway = (halfway - (rest[owner] - means).square().sum(dim=1, keepdim=True)) / (
        2.0 * width.clamp(min=1e-12)
    )
    root = geometry.quaternion_to_matrix(quats) * scales[:, None, :]
    sigma = (normal @ root).norm(dim=2)
    pair = (gone & (width > 0.0) & (halfway < REACH * sigma)).nonzero()
    m, k = pair.unbind(dim=1)
    # The face must be there: not where a third point's cell begins.
    spot = means[m] + halfway[m, k, None] * normal[m, k]
    third = (points[m] - spot[:, None]).norm(dim=2).amin(dim=1)
    own = (rest[owner[m]] - spot).norm(dim=1)
    kept = third >= own - _CORNER * sigma[m, k]
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
    new_quats, new_scales = ops.covariance_axes(geometry.pack_symmetric(covariance))
    return rows, mean, new_quats, new_scales


def cut_in_part(
    splats: tuple[Tensor, Tensor, Tensor], whole: Tensor, rows: Tensor, normal: Tensor,
    distance: Tensor, share: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Means, quaternions and scales of splats of which some are cut, each once, by a share.

    Args:
        splats: All, as earlier cuts left them.
        whole: Means of the uncut ones [m], [N, 3].
        rows: Splats that are cut, int64 [M]; none twice.
        normal: Unit normals of the faces, outward, [M, 3].
        distance: Of the uncut means from the faces [m], [M].
        share: How far they are cut, 0 to 1, [M, 1].
    """
    means, quats, scales = splats
    root = geometry.quaternion_to_matrix(quats[rows]) * scales[rows, None]
    before, mean = root @ root.mT, means[rows]
    moved = ((mean - whole[rows]) * normal).sum(dim=1)
    cut, covariance = cut_at(mean, before, normal, distance - moved)
    mean = mean + share * (cut - mean)
    covariance = before + share[..., None] * (covariance - before)
    turned = ops.covariance_axes(geometry.pack_symmetric(covariance))
    means = means.index_copy(0, rows, mean)
    quats, scales = (
        old.index_copy(0, rows, new) for old, new in zip((quats, scales), turned, strict=True)
    )
    return means, quats, scales


def in_turns(rows: Tensor) -> list[Tensor]:
    """Places in a list of rows, int64 [M]: where each row comes first, where it comes next, ..."""
    ordered, order = rows.sort(stable=True)
    steps = torch.arange(len(rows), device=rows.device)
    new = torch.ones_like(rows, dtype=torch.bool)
    new[1:] = ordered[1:] != ordered[:-1]
    turn = torch.empty_like(rows)
    turn[order] = steps - torch.where(new, steps, 0).cummax(dim=0).values
    return [(turn == n).nonzero()[:, 0] for n in range(int(turn.max()) + 1 if len(rows) else 0)]
