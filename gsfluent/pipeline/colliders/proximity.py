"""Distances between groups of points, coarse and cheap: what may stay off the grid, and how long.

A distance is only ever needed from below, and only in cells: points in cubes of an edge that do not
touch are at least that edge apart.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

_EDGES = (16.0, 8.0, 4.0, 2.0)
"""Edges tried when boxes overlap, in cells."""
_SHIFT = 2**20


def boxes(position: Tensor, label: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Bounding boxes of labelled points: low and high corners, float64 [count, 3] on the CPU.

    Labels run from 0; a label without points has an empty box (low above high).
    """
    index = label.long()[:, None].expand(-1, 3)
    low = position.new_full((count, 3), math.inf).scatter_reduce(0, index, position, "amin")
    high = position.new_full((count, 3), -math.inf).scatter_reduce(0, index, position, "amax")
    return low.to("cpu", torch.float64), high.to("cpu", torch.float64)


def box_gaps(low_a: Tensor, high_a: Tensor, low_b: Tensor, high_b: Tensor) -> Tensor:
    """Distances between boxes [m], [A, B]; 0 where they overlap."""
    gap = torch.maximum(low_a[:, None] - high_b[None], low_b[None] - high_a[:, None])
    return gap.clamp(min=0.0).norm(dim=2)


def distance(a: Tensor, b: Tensor, dx: float) -> float:
    """Lower bound of the distance between two sets of points [m]; 0 below two cells.

    Args:
        a: Points [m], [A, 3].
        b: Points [m], [B, 3].
        dx: Grid spacing [m].
    """
    for edge in _EDGES:
        if not _cubes_meet(a, b, edge * dx):
            return edge * dx
    return 0.0


def proximity_pairs(position: Tensor, label: Tensor, edge: float) -> Tensor:
    """Pairs of labels with points in the same or in touching cubes of ``edge`` metres.

    Args:
        position: Points [m], [N, 3].
        label: Label of each, int [N].
        edge: Edge of the cubes [m]; sets that are closer than it are always found.

    Returns:
        Pairs, smaller label first, int64 [P, 2].
    """
    cell = torch.floor(position / edge).to(torch.int64)
    cell = cell - cell.amin(dim=0) + 1
    cubes, home = torch.unique(_key(cell), return_inverse=True)
    labels, name = torch.unique(label.long(), return_inverse=True)
    # Pairs of cube and label as one number each: sorting rows costs ten times as much.
    found = torch.unique(home * labels.shape[0] + name)
    total = labels.shape[0]
    start, owner = found // total, found % total  # owners by their place in labels
    key = cubes[start]
    counts = torch.bincount(start, minlength=cubes.shape[0])
    first = torch.cumsum(counts, 0) - counts
    most = int(counts.max()) if counts.numel() else 0
    # All steps at once: on a GPU what counts is how many operations there are.
    wanted = key + torch.tensor(_half_star(), device=key.device)[:, None]
    at = torch.searchsorted(cubes, wanted).clamp(max=max(cubes.shape[0] - 1, 0))
    there = cubes[at] == wanted
    owners = owner.expand_as(at)
    pairs = []
    for i in range(most):
        other = owner[(first[at] + i).clamp(max=owner.shape[0] - 1)]
        both = there & (i < counts[at]) & (other != owners)
        pair = torch.minimum(owners, other) * total + torch.maximum(owners, other)
        pairs.append(pair[both])
    if not pairs:
        return torch.zeros(0, 2, dtype=torch.int64, device=position.device)
    found = torch.unique(torch.cat(pairs))
    return torch.stack([labels[found // total], labels[found % total]], dim=1)


def time_to_meet(gap: float, speed: float, pull: float) -> float:
    """Least time in which two things can close a gap [s].

    Args:
        gap: Distance [m].
        speed: Sum of their speeds now [m/s].
        pull: Their relative acceleration at most [m/s^2].
    """
    if gap <= 0.0:
        return 0.0
    if speed <= 0.0 and pull <= 0.0:
        return math.inf
    return 2.0 * gap / (speed + math.sqrt(speed * speed + 2.0 * pull * gap))


def _key(cell: Tensor) -> Tensor:
    return (cell[:, 0] * _SHIFT + cell[:, 1]) * _SHIFT + cell[:, 2]


def _half_star() -> list[int]:
    """Key steps to a cube itself and to one of each pair of opposite neighbours."""
    steps = []
    for x in (-1, 0, 1):
        for y in (-1, 0, 1):
            for z in (-1, 0, 1):
                if (x, y, z) >= (0, 0, 0):
                    steps.append((x * _SHIFT + y) * _SHIFT + z)
    return steps


def _cubes_meet(a: Tensor, b: Tensor, edge: float) -> bool:
    """Tell whether points of both lie in the same or in touching cubes of ``edge``."""
    label = torch.cat([torch.zeros_like(a[:, 0]), torch.ones_like(b[:, 0])])
    return proximity_pairs(torch.cat([a, b]), label, edge).shape[0] > 0
