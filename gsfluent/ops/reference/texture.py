"""The ops of a texture's synthesis by plain means: one operation of torch at a time."""

from __future__ import annotations

import torch
from torch import Tensor


def rows_between(ordered: Tensor, low: Tensor, high: Tensor, share: Tensor) -> Tensor:
    """As :func:`gsfluent.ops.rows_between`, of rows that exist."""
    first, last = (at[..., None].expand(-1, -1, ordered.shape[2]) for at in (low, high))
    share = share[..., None]
    return ordered.gather(1, first) * (1 - share) + ordered.gather(1, last) * share


def quantile_shift(values: Tensor, have: Tensor, want: Tensor) -> Tensor:
    """As :func:`gsfluent.ops.quantile_shift`."""
    count = have.shape[1]
    knots = have.mT.contiguous()
    # equal quantiles (flat colour) would make the inverse ambiguous
    knots = knots + 1e-5 * torch.arange(count, device=knots.device)
    moves = (want - have).mT.contiguous()
    at = values.mT.contiguous()
    right = torch.searchsorted(knots, at).clamp_(1, count - 1)
    left_knot, right_knot = knots.gather(2, right - 1), knots.gather(2, right)
    share = ((at - left_knot) / (right_knot - left_knot)).clamp_(0.0, 1.0)
    left, last = moves.gather(2, right - 1), moves.gather(2, right)
    return (left + share * (last - left)).mT


def patch_votes(
    center: Tensor, offset: Tensor, best: Tensor, patches: Tensor, weight: Tensor, falloff: Tensor,
    total: Tensor, share: Tensor,
) -> None:  # fmt: skip
    """As :func:`gsfluent.ops.patch_votes`, of voxels and patches that exist."""
    for k in range(len(offset)):
        # within one offset no voxel is met twice: the sums are the same in every run
        at = center + offset[k]
        votes = weight * falloff[k]
        total.index_add_(0, at, patches[best, k] * votes[:, None])
        share.index_add_(0, at, votes)
