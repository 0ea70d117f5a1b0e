"""Reference of the spatial operators: whole tables and grids, one operation at a time."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
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


def nearest_points(
    points: Tensor,
    queries: Tensor,
    count: int,
    *,
    group: Tensor | None = None,
    asked: Tensor | None = None,
    reach: float = math.inf,
) -> tuple[Tensor, Tensor]:
    """As :func:`gsfluent.ops.nearest_points`, from a table of all pairs."""
    apart = points[None] - queries[:, None]
    x, y, z = (apart * apart).unbind(dim=2)
    away = torch.from_numpy(np.sqrt(((x + y) + z).numpy()))  # torch rounds the last bit elsewhere
    may = away <= reach
    if group is not None and asked is not None:
        may &= group[None] == asked[:, None]
    away = torch.where(may, away, math.inf)
    away = torch.nn.functional.pad(away, (0, max(count - len(points), 0)), value=math.inf)
    best, rows = away.sort(dim=1, stable=True)
    best, rows = best[:, :count], rows[:, :count]
    return best, torch.where(best.isfinite(), rows, -1)


def box_blur(indicator: Tensor, width: int, times: int = 3) -> Tensor:
    """As :func:`gsfluent.ops.box_blur`, by differences of running sums."""
    field, half = indicator.to(torch.int64), width // 2
    for axis in (2, 1, 0):
        count = field.shape[axis]
        place = torch.arange(count)
        last, first = (place + half).clamp(max=count - 1) + 1, (place - half).clamp(min=0)
        for _ in range(times):
            before = torch.zeros_like(field.narrow(axis, 0, min(1, count)))
            total = torch.cat([before, field.cumsum(axis)], dim=axis)
            field = total.index_select(axis, last) - total.index_select(axis, first)
    return field.to(torch.int32)


def distance_transform(occupied: Tensor) -> tuple[Tensor, Tensor]:
    """As :func:`gsfluent.ops.distance_transform`, from a table of all pairs."""
    place = torch.cartesian_prod(*[torch.arange(n) for n in occupied.shape]).view(-1, 3)
    empty = (~occupied).reshape(-1).nonzero()[:, 0]
    if not len(empty):
        own = torch.arange(occupied.numel(), dtype=torch.int32).view(occupied.shape)
        return torch.full_like(own, 1 << 28), own
    square = ((place[:, None] - place[empty]) ** 2).sum(2)
    least = square.min(1).values
    # of several as near, the first
    first = (square == least[:, None]).int().argmax(1)
    return least.int().view(occupied.shape), empty[first].int().view(occupied.shape)


_MASK = 0xFFFFFFFF


def value_noise(
    voxels: Tensor, spacings: Sequence[float], shifts: Sequence[float], weights: Sequence[float]
) -> Tensor:
    """As :func:`gsfluent.ops.value_noise`, octave by octave."""
    total = torch.zeros(voxels.shape, dtype=torch.float32)
    for octave, (spacing, shift, weight) in enumerate(zip(spacings, shifts, weights, strict=True)):
        place = voxels.double() / spacing + shift
        base = place.floor()
        t = (place - base).float()
        share = t * t * (3.0 - 2.0 * t)
        corners = torch.cartesian_prod(*[torch.arange(2)] * 3)
        value = _hashed(base.long()[:, None] + corners, octave).view(-1, 2, 2, 2, 3)
        for axis in range(3):
            near, far = value.unbind(dim=1)
            by = share[:, axis].view(-1, *[1] * (near.ndim - 1))
            value = near + by * (far - near)
        total = total + value * weight
    return total


def _hashed(node: Tensor, octave: int) -> Tensor:
    """Three uniform values in -1 to 1 at nodes [..., 3] of a lattice."""
    x, y, z = node.unbind(dim=-1)
    h = ((x * 0x8DA6B343) & _MASK) ^ ((y * 0xD8163841) & _MASK) ^ ((z * 0xCB1AB31F) & _MASK)
    h = h ^ ((octave * 0x9E3779B1 + 0x2545F491) & _MASK)
    parts = []
    for turn in (0x7FEB352D, 0x846CA68B, 0x9E3779B1):
        h = ((h ^ (h >> 16)) * turn) & _MASK
        h = ((h ^ (h >> 15)) * 0x2C1B3C6D) & _MASK
        parts.append((h ^ (h >> 16)).to(torch.float64) * (2.0 / 4294967296.0) - 1.0)
    return torch.stack(parts, dim=-1).to(torch.float32)


def hashes(seed: Tensor, turns: Sequence[int]) -> Tensor:
    """Values in -1 to 1 by a hash of 32 bits (:func:`gsfluent.ops.hashes`)."""
    mask = 0xFFFFFFFF
    salt = [(turn * 0x9E3779B1 + 0x2545F491) & mask for turn in turns]
    h = (seed[..., None] ^ torch.tensor(salt, device=seed.device)) & mask
    for factor in (0x7FEB352D, 0x846CA68B):
        h = ((h ^ (h >> 16)) * factor) & mask
    h = h ^ (h >> 16)
    return h.double() * (2.0 / 4294967296.0) - 1.0


def label_boxes(labels: Tensor, count: int) -> Tensor:
    """First and last index of each label (:func:`gsfluent.ops.label_boxes`)."""
    ends = []
    for axis, size in enumerate(labels.shape):
        steps = torch.arange(size).view([-1 if a == axis else 1 for a in range(3)])
        there = [labels == label for label in range(count)]
        ends.append([int(torch.where(t, steps, size).amin()) for t in there])
        ends.append([int(torch.where(t, steps, -1).amax()) for t in there])
    return torch.tensor(ends, dtype=torch.int32).T


def margin_counts(
    lead: Tensor, first: Tensor, second: Tensor, offset: Tensor, width: float
) -> Tensor:
    """Voxels of labels, and of bands (:func:`gsfluent.ops.margin_counts`)."""
    now = lead.double() + (offset[first] - offset[second])
    band = now.abs() < width
    found = []
    for label in range(len(offset)):
        has = torch.where(now >= 0.0, first, second) == label
        near = band & ((first == label) | (second == label))
        found.append([int(has.sum()), int(near.sum())])
    return torch.tensor(found).T
