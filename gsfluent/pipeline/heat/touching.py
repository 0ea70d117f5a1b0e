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
_NEIGHBOURS = 4  # of a point, on the face of another body


def touching(first: Tensor, second: Tensor, spacing: float) -> tuple[Tensor, Tensor]:
    """Pairs of points of two bodies that touch, and the share of a face that each stands for.

    Half of a point's face is spread over the nearest points of the other body, the nearer the more,
    and half is what those spread over it. No point gets more than that half: what lies beside the
    edge of a body that stands on it touches nothing.

    Args:
        first: Points of a body that may have an open face, where they are without the jitter of
            their sampling [m], [N, 3].
        second: Those of another body, [M, 3].
        spacing: Edge of a point's cell [m].

    Returns:
        Rows of ``first`` and ``second``, int64 [L, 2], and the shares, [L]; a pair that was found
        from both sides is there twice.
    """
    reach, pairs, shares = REACH * spacing, [], []
    for own, other, flipped in ((first, second, False), (second, first, True)):
        if not (len(own) and len(other)):
            continue
        low, high = other.amin(dim=0) - reach, other.amax(dim=0) + reach
        rows = ((own >= low) & (own <= high)).all(dim=1).nonzero()[:, 0]
        if not len(rows):
            continue
        distance, index = nearest_rows(other, own[rows], min(_NEIGHBOURS, len(other)), spacing)
        beyond = (distance**2 - distance[:, :1] ** 2) / spacing**2
        share = (1.0 - beyond).clamp(min=0.0) * (distance[:, :1] <= reach)
        share = 0.5 * share / share.sum(dim=1, keepdim=True).clamp(min=1e-9)
        got = summed(share.reshape(-1), index.reshape(-1), len(other))
        share = share * (0.5 / got.clamp(min=0.5))[index]
        at, column = share.nonzero().unbind(dim=1)
        pair = torch.stack([rows[at], index[at, column]], dim=1)
        pairs.append(pair.flip(1) if flipped else pair)
        shares.append(share[at, column].to(first))
    if not pairs:
        return torch.zeros(0, 2, dtype=torch.int64, device=first.device), first.new_zeros(0)
    return torch.cat(pairs), torch.cat(shares)


def summed(share: Tensor, at: Tensor, count: int) -> Tensor:
    """Shares added up at points [count], in whole 2^-40: in any order the same."""
    units = torch.round(share.double() * 2.0**40).long()
    return units.new_zeros(count).index_add(0, at, units).to(share) * 2.0**-40


def turned(rest: Tensor, now: Tensor) -> Tensor:
    """Rotation that takes points at rest to where they are, best in the mean, [3, 3].

    Args:
        rest: [m], [N, 3].
        now: The same points [m], [N, 3].

    Source: Kabsch 1976.
    """
    left, _, right = torch.linalg.svd((now - now.mean(dim=0)).T @ (rest - rest.mean(dim=0)))
    flip = torch.ones_like(left[0])
    flip[2] = torch.linalg.det(left @ right)
    return (left * flip) @ right


def groups(count: int, pairs: list[tuple[int, int]]) -> list[list[int]]:
    """What hangs together of 0 to ``count`` - 1 by pairs, each set in ascending order."""
    sets = [[n] for n in range(count)]
    for a, b in pairs:
        one, two = (next(s for s in sets if n in s) for n in (a, b))
        if one is not two:
            one.extend(two)
            sets.remove(two)
    return [sorted(s) for s in sets]
