"""Reference of the spatial operators: whole tables, one operation at a time."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from gsfluent.geometry import trilinear


def nearest_labels(place: Tensor, rank: Tensor, shape: Sequence[int], radius: float) -> Tensor:
    """As :func:`gsfluent.ops.nearest_labels`, from a table of all pairs."""
    axes = [torch.arange(n, dtype=torch.float64) for n in shape]
    centers = torch.cartesian_prod(*axes)
    apart = centers[:, None] - place[None]
    total = (apart * apart * 1024.0).round().long().sum(dim=2)
    key = torch.where(total <= round(radius * radius * 1024.0), (total << 16) + rank, 1 << 62)
    best = key.amin(dim=1)
    return torch.where(best < 1 << 62, best & 0xFFFF, -1).to(torch.int16).view(list(shape))


def largest_shares(
    place: Tensor | None, shape: Sequence[int], shares: Tensor, box: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """As :func:`gsfluent.ops.largest_shares`, field by field."""
    axes = [torch.arange(n, dtype=torch.float32) for n in shape]
    where = torch.cartesian_prod(*axes) if place is None else place
    first = torch.full((len(where),), -1, dtype=torch.int16)
    second = first.clone()
    one, two = torch.zeros(len(where)), torch.zeros(len(where))
    for label, row in enumerate(box.tolist()):
        low, size, start = torch.tensor(row[:3]), torch.tensor(row[3:6]), row[6]
        count = math.prod(row[3:6])
        if min(row[3:6]) < 1 or start < 0 or start + count > len(shares):
            continue
        share = shares[start : start + count].view(row[3:6])
        local = where - low
        inside = ((where > low - 1) & (where < low + size)).all(dim=1)
        x, y, z = torch.minimum(local.round().long().clamp(min=0), size - 1).unbind(dim=1)
        if place is None:
            inside &= ((local >= 0) & (local < size)).all(dim=1)
        else:
            inside &= share[x, y, z] > 0.0
        value = torch.where(inside, trilinear(share, local), -1.0)
        ahead, next_ = value > one, value > two
        second = torch.where(ahead, first, torch.where(next_, label, second.long())).to(torch.int16)
        two = torch.where(ahead, one, torch.where(next_, value, two))
        first = torch.where(ahead, label, first.long()).to(torch.int16)
        one = torch.where(ahead, value, one)
    out = list(shape) if place is None else [len(where)]
    return first.view(out), second.view(out), (one - two).view(out)


def nearest_in_cells(
    points: Tensor, queries: Tensor, low: Sequence[float], cell: float, count: int
) -> tuple[Tensor, Tensor]:
    """As :func:`gsfluent.ops.nearest_in_cells`, from a table of all pairs."""
    corner = torch.tensor(list(low), dtype=torch.float64)
    of = ((points - corner) / cell).long()
    mine = ((queries - corner) / cell).long()
    near = ((of[None] - mine[:, None]).abs() <= 1).all(dim=2)
    apart = points[None] - queries[:, None]
    x, y, z = (apart * apart).unbind(dim=2)
    square = torch.where(near, (x + y) + z, math.inf)
    short = max(count - len(points), 0)
    square = torch.nn.functional.pad(square, (0, short), value=math.inf)
    best, rows = square.sort(dim=1, stable=True)
    best, rows = best[:, :count], rows[:, :count]
    return best, torch.where(best.isfinite(), rows, 0)
