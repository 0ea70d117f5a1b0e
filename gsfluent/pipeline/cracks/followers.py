"""Points that are led by others of their chunk, and how chunks have turned."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.pipeline.matter.links import PARTED, Links
from gsfluent.spatial.neighbours import nearest_in_group

WIDE = 1.5
"""Width of the blend of neighbouring points where matter is broken, in point spacings: what is
left of the crack band is rougher than a face."""
_FINE = 2.0**20


class Followers(NamedTuple):
    """Points that are led by firm ones.

    Attributes:
        rows: Which, int64 [R].
        near: The firm points around each, int64 [R, K].
        lone: Columns of these that are none, bool [R, K].
        key: What all this was found for.
    """

    rows: Tensor
    near: Tensor
    lone: Tensor
    key: Tensor

    def placed(self, links: Links, position: Tensor, moved: Tensor) -> Tensor:
        """Where the points that lead carry the places of those that follow [m], [R, 3].

        Args:
            links: Of all points, as they are now.
            position: Where these are [m], [N, 3].
            moved: Their maps, [N, 3, 3].
        """
        rows, near, lone, _ = self
        rest, spacing = links.rest, links.spacing
        # on one side of a crack: that of the nearest
        first = near[:, :1]
        before = (rest[near] - rest[first]).norm(dim=2).clamp(min=0.5 * spacing[rows, None])
        after = (position[near] - position[first]).norm(dim=2)
        parted = lone | (after > PARTED * before)
        place, _ = ops.carry_place(
            rest[rows],
            rows,
            links.near.index_copy(0, rows, near),
            torch.zeros_like(links.near, dtype=torch.bool).index_copy(0, rows, parted),
            rest,
            position[: rest.shape[0]],
            moved[: rest.shape[0]],
            WIDE * spacing,
        )
        return place


def neighbours(links: Links, chunk: Tensor, rows: Tensor, among: Tensor) -> tuple[Tensor, Tensor]:
    """Nearest points of the own chunk, int64 [R, K], and the columns that are none, bool.

    A point whose chunk has nobody has itself.

    Args:
        links: Of all points at rest.
        chunk: Of each of them, int64 [N].
        rows: Points that look, int64 [R].
        among: Those that may be found, bool [N].
    """
    its = among.nonzero()[:, 0]
    cell = 1.5 * float(links.spacing[rows].mean())
    found = nearest_in_group(
        links.rest[its], chunk[its], links.rest[rows], chunk[rows], links.near.shape[1], cell
    )[1]
    lone = found < 0
    near = its[found.clamp(min=0)] if its.numel() else found
    near = torch.where(lone, torch.where(lone[:, :1], rows[:, None], near[:, :1]), near)
    lone[:, 0] = False
    return near, lone


def turns(chunk: Tensor, count: int, rest: Tensor, now: Tensor, spacing: Tensor) -> Tensor:
    """Rotations of chunks: the best fit (Kabsch 1976), [count, 3, 3].

    Sums go in whole numbers, which have no order.

    Args:
        chunk: Of each point that drives one, int64 [D].
        count: Number of chunks.
        rest: Where the points were at rest [m], [D, 3].
        now: Where they are [m], [D, 3].
        spacing: Between them [m], [D].
    """
    scale = spacing.double()[:, None]
    many = torch.bincount(chunk, minlength=count).clamp(min=1).double()[:, None]
    arms = []
    for place in (rest.double(), now.double()):
        whole = (place / scale * _FINE).round().long()
        total = whole.new_zeros(count, 3).index_add_(0, chunk, whole)
        center = total.double() / (_FINE * many)
        arms.append(place / scale - center[chunk])
    square = (arms[1][:, :, None] * arms[0][:, None] * _FINE).round().long()
    total = square.new_zeros(count, 3, 3).index_add_(0, chunk, square)
    size = total.double().abs().amax(dim=(1, 2), keepdim=True).clamp(min=1.0)
    turn, _ = ops.polar_clamped((total.double() / size).contiguous(), 0.3, 2.0)
    return turn
