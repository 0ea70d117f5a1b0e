"""The ops on graphs by plain means: one operation at a time, and sweeps until nothing changes."""

from __future__ import annotations

import torch
from torch import Tensor

from gsfluent.ops.graph import FAR_KEY


def link_costs(
    links: Tensor, length: Tensor, spacing: Tensor, position: Tensor, broken: Tensor,
    flowing: Tensor, may_break: Tensor, before: Tensor, gone: Tensor | None = None, *,
    open: float, torn: float, steep: float, unit: float, shift: int,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """As :func:`gsfluent.ops.link_costs`, of links that all name points."""
    a, b = links.unbind(dim=1)
    x, y, z = (position[a] - position[b]).unbind(dim=1)
    ratio = (x * x + y * y + z * z).sqrt() / length.clamp(min=1e-30)
    far = ratio > torch.where(broken[a] | broken[b], open, torn)
    cut = before | (far & ~(flowing[a] | flowing[b]) & may_break[a])
    if gone is not None:
        cut = cut | gone[a] | gone[b]
    price = length / spacing[a] * (1.0 + steep * (ratio - 1.0).clamp(0.0, 2.0))
    cost = (price * unit).round().long().clamp(1, 1 << 30) << shift
    ends = torch.zeros_like(broken)
    ends[links[cut].flatten()] = True
    return cut, torch.where(~cut & (ratio < torn), cost, 0), ends


def components(
    links: Tensor, count: int, apart: Tensor | None = None, inside: Tensor | None = None
) -> Tensor:
    """As :func:`gsfluent.ops.components`."""
    if apart is not None:
        links = links[~apart]
    if inside is not None:
        links = links[inside[links].all(dim=1)]
    root = torch.arange(count)
    while True:
        least = root[links].amin(dim=1)
        now = root.clone()
        for end in links.unbind(dim=1):
            now = now.scatter_reduce(0, end, least, "amin")
        if torch.equal(now, root):
            return root
        root = now


def nearest_seeds(links: Tensor, cost: Tensor, key: Tensor, other: Tensor) -> Tensor:
    """As :func:`gsfluent.ops.nearest_seeds`."""
    links, cost = links[cost > 0], cost[cost > 0]
    while True:
        now = key
        for source, target in (links.unbind(dim=1), links.flip(1).unbind(dim=1)):
            leads = other[target] & (key[source] < FAR_KEY)
            offer = key[source[leads]] + cost[leads]
            now = now.scatter_reduce(0, target[leads], offer, "amin")
        if torch.equal(now, key):
            return key
        key = now
