"""Steps of a texture's synthesis that are many small operations of torch each.

The use of all three: :mod:`gsfluent.pipeline.texture.synthesis`. Every number is rounded where
torch rounds it, asked one operation at a time.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gsfluent._check import check_tensor
from gsfluent.ops._register import fakes, no_gradient


def rows_between(ordered: Tensor, low: Tensor, high: Tensor, share: Tensor) -> Tensor:
    """Values between two rows of each part: ``(1 - share) ordered[low] + share ordered[high]``.

    Args:
        ordered: Values of each part, float32 [P, L, D].
        low: Rows, int64 [P, K].
        high: Rows, int64 [P, K].
        share: Of the second one, float32 [P, K].

    Returns:
        The values, [P, K, D]; NaN where there is no such row.

    Raises:
        TypeError: A tensor has a wrong dtype.
        ValueError: A shape or device is wrong.

    Gradient: none.
    """
    op = "rows_between"
    check_tensor(op, "ordered", ordered, shape=("P", "L", "D"), dtype=torch.float32)
    shape: tuple[int | None, ...] = (ordered.shape[0], None)
    for name, value, dtype in (
        ("low", low, torch.int64),
        ("high", high, torch.int64),
        ("share", share, torch.float32),
    ):
        check_tensor(op, name, value, shape=shape, dtype=dtype, like=ordered)
        shape = tuple(low.shape)
    found: Tensor = torch.ops.gsfluent.rows_between.default(ordered, low, high, share)
    return found


def quantile_shift(values: Tensor, have: Tensor, want: Tensor) -> Tensor:
    """How far values move as a distribution with the quantiles ``have`` gets those of ``want``.

    Linear between quantiles, and that of the first or last one beyond. Column by column.

    Args:
        values: Of each part, float32 [P, L, D].
        have: Its quantiles, ascending, float32 [P, K, D], K >= 2.
        want: Those that it is to have, float32 [P, K, D].

    Returns:
        The moves, [P, L, D].

    Raises:
        TypeError: A tensor has a wrong dtype.
        ValueError: A shape or device is wrong.

    Gradient: none.
    """
    op = "quantile_shift"
    check_tensor(op, "values", values, shape=("P", "L", "D"), dtype=torch.float32)
    parts, _, columns = values.shape
    check_tensor(op, "have", have, shape=(parts, None, columns), dtype=torch.float32, like=values)
    check_tensor(op, "want", want, shape=tuple(have.shape), dtype=torch.float32, like=values)
    if have.shape[1] < 2:
        raise ValueError(f"{op}: have must hold at least two quantiles, got {have.shape[1]}")
    found: Tensor = torch.ops.gsfluent.quantile_shift.default(values, have, want)
    return found


def patch_votes(
    center: Tensor, offset: Tensor, best: Tensor, patches: Tensor, weight: Tensor, falloff: Tensor,
    total: Tensor, share: Tensor,
) -> None:  # fmt: skip
    """Add what patches say of the voxels about their centres, in place.

    A patch adds ``weight falloff`` to the share of each of its voxels, and that times its colour
    there to the total. Sums of a voxel have the order of the places of a patch.

    Args:
        center: Voxels in which patches stand, no two alike, int64 [n].
        offset: From a patch's centre to the voxel of each of its places, int64 [K]; voxels that do
            not exist are left out.
        best: Which patch stands there, int64 [n].
        patches: Colours of all patches, float32 [B, K, 3].
        weight: Of each vote, float32 [n].
        falloff: Of each place of a patch, float32 [K].
        total: Sums of colours, float32 [V, 3], contiguous; are added to.
        share: Sums of weights, float32 [V], contiguous; are added to.

    Raises:
        TypeError: A tensor has a wrong dtype.
        ValueError: A shape or device is wrong.

    Gradient: none.
    """
    op = "patch_votes"
    check_tensor(op, "patches", patches, shape=("B", "K", 3), dtype=torch.float32)
    check_tensor(op, "center", center, shape=("n",), dtype=torch.int64, like=patches)
    count, places = len(center), patches.shape[1]
    for name, value, size, dtype in (
        ("offset", offset, places, torch.int64),
        ("best", best, count, torch.int64),
        ("weight", weight, count, torch.float32),
        ("falloff", falloff, places, torch.float32),
    ):
        check_tensor(op, name, value, shape=(size,), dtype=dtype, like=patches)
    check_tensor(op, "total", total, shape=("V", 3), dtype=torch.float32, like=patches)
    check_tensor(op, "share", share, shape=(len(total),), dtype=torch.float32, like=patches)
    torch.ops.gsfluent.patch_votes.default(
        center, offset, best, patches, weight, falloff, total, share
    )


fakes(
    rows_between=lambda ordered, low, *rest: ordered.new_empty(
        (ordered.shape[0], low.shape[1], ordered.shape[2])
    ),
    quantile_shift=lambda values, have, want: torch.empty_like(values),
    patch_votes=lambda *given: None,
)
no_gradient("texture: no gradient", "rows_between", "quantile_shift")
