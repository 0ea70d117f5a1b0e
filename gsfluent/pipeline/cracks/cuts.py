"""Splats cut at faces that open little by little."""

from __future__ import annotations

import torch
from torch import Tensor

from gsfluent import geometry, ops


def cut_in_part(
    splats: tuple[Tensor, Tensor, Tensor], whole: Tensor, rows: Tensor, normal: Tensor,
    distance: Tensor, share: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Means, quaternions and scales of splats of which some are cut, each cut by a share.

    Args:
        splats: All, as earlier cuts left them.
        whole: Means of the uncut ones [m], [N, 3].
        rows: Splat of each cut, int64 [M]; what is cut more than once is so in this order.
        normal: Unit normals of the faces, outward, [M, 3].
        distance: Of the uncut means from the faces [m], [M].
        share: How far they are cut, 0 to 1, [M].
    """
    if not rows.numel():
        return splats
    ordered, order = rows.sort(stable=True)
    mine, counts = torch.unique_consecutive(ordered, return_counts=True)
    means, quats, scales = splats
    now = ops.cut_by_planes(
        means[mine],
        geometry.covariance(quats[mine], scales[mine]),
        first=torch.nn.functional.pad(counts.cumsum(0), (1, 0)),
        normal=normal[order],
        distance=distance[order],
        share=share[order],
        whole=whole[mine],
    )
    means, quats, scales = (
        old.index_copy(0, mine, new) for old, new in zip(splats, now, strict=True)
    )
    return means, quats, scales
