"""Where bodies touch: pairs of their points that heat flows between."""

from __future__ import annotations

import torch
from torch import Tensor

from gsfluent.spatial.neighbours import nearest_rows

REACH = 1.5
"""Spacings within which the nearest points of two bodies touch.

Faces that lie on each other have their points one apart, and 1.22 where the lattices are off by
half a spacing along both axes of the face.
"""
SHARE = 0.5
"""Share of a face that a pair of :func:`touching` stands for."""


def touching(first: Tensor, second: Tensor, spacing: float) -> Tensor:
    """Pairs of points of two bodies that touch: every point with the nearest of the other body.

    A face of a point is met half by its own pair, and half by those that the points of the other
    body make: the area of all pairs is the mean of what both bodies show each other.

    Args:
        first, second: Points of two bodies that may have an open face [m], [N, 3] and [M, 3].
        spacing: Edge of a point's cell [m].

    Returns:
        Rows of ``first`` and ``second``, int64 [L, 2]; a pair that is nearest both ways is there
        twice.
    """
    reach = REACH * spacing
    found = []
    for own, other in ((first, second), (second, first)):
        near = torch.zeros(0, 2, dtype=torch.int64, device=first.device)
        if len(own) and len(other):
            low, high = other.amin(dim=0) - reach, other.amax(dim=0) + reach
            rows = ((own >= low) & (own <= high)).all(dim=1).nonzero()[:, 0]
            if len(rows):
                distance, index = nearest_rows(other, own[rows], 1, spacing)
                met = distance[:, 0] <= reach
                near = torch.stack([rows[met], index[met, 0]], dim=1)
        found.append(near)
    return torch.cat([found[0], found[1].flip(1)])


def groups(count: int, pairs: list[tuple[int, int]]) -> list[list[int]]:
    """What hangs together of 0 to ``count`` - 1 by pairs, each set in ascending order."""
    sets = [[n] for n in range(count)]
    for a, b in pairs:
        one, two = (next(s for s in sets if n in s) for n in (a, b))
        if one is not two:
            one.extend(two)
            sets.remove(two)
    return [sorted(s) for s in sets]
