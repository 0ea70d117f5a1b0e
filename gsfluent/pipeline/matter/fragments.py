"""Fragments: links between neighbours at rest, connected components, and masses of pieces.

How pieces are found is in :mod:`gsfluent.pipeline.matter.pieces`.
"""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from gsfluent import ops

LINK_RADIUS = 1.5
"""Points closer than this many mean spacings at rest are linked."""
STRETCH_LIMIT = 2.0
"""Neighbours of one piece have parted at this many times their distance at rest."""
DEBRIS = -1


@dataclasses.dataclass(frozen=True, eq=False)
class Fragments:
    """The pieces of one moment.

    Args:
        labels: Piece of each point, of broken ones, too, int32 [N]: the row of its first point that
            never broke, so that a piece keeps its label as long as it keeps that point; -1 for
            loose matter (chips, dust) and for what flows.
        ids: Labels of the pieces, largest mass first, int64 [F].
        mass_fractions: Share of the total mass of each piece, float64 [F].
        debris_fraction: Share of the mass in no piece.
    """

    labels: Tensor
    ids: Tensor
    mass_fractions: Tensor
    debris_fraction: float

    @property
    def count(self) -> int:
        """Number of pieces."""
        return int(self.ids.shape[0])

    @property
    def largest(self) -> float:
        """Mass fraction of the largest piece; 0 when all is debris."""
        return float(self.mass_fractions[0]) if self.count else 0.0


def rest_links(
    rest: Tensor, ranges: tuple[tuple[int, int], ...], spacing: tuple[float, ...]
) -> Tensor:
    """Link points of the same body that are close at rest.

    Args:
        rest: Rest positions [m], [N, 3].
        ranges: First and last + 1 row of each body.
        spacing: Mean point spacing of each body [m].

    Returns:
        Pairs of rows, int64 [L, 2], first row smaller.
    """
    from scipy.spatial import cKDTree

    found = []
    for (a, b), distance in zip(ranges, spacing, strict=True):
        tree = cKDTree(rest[a:b].cpu().numpy())
        pairs = tree.query_pairs(LINK_RADIUS * distance, output_type="ndarray")
        found.append(torch.from_numpy(pairs).to(torch.int64) + a)
    return torch.cat(found) if found else torch.zeros(0, 2, dtype=torch.int64)


def components(a: Tensor, b: Tensor, count: int) -> Tensor:
    """Connected components of a graph, on its device.

    Args:
        a: One end of each link, int64 [L].
        b: The other end.
        count: Number of points.

    Returns:
        The smallest row of each point's component, int64 [count].
    """
    return ops.components(torch.stack([a, b], dim=1), count)


def ranked(unit: Tensor, rest: Tensor) -> tuple[Tensor, Tensor]:
    """Pieces of some points by size, then by place, whatever the order of the points.

    Args:
        unit: What each hangs together with, int64 [P].
        rest: Where they are at rest [m], [P, 3].

    Returns:
        The values of ``unit`` in that order, int64 [F], and the rank of each point's, int64 [P].
    """
    ids, index = torch.unique(unit, return_inverse=True)
    low = torch.full((len(ids), 3), torch.inf, dtype=torch.float64, device=unit.device)
    low.scatter_reduce_(0, index[:, None].expand(-1, 3), rest.double(), "amin")
    x, y, z = low.unbind(dim=1)
    order = torch.arange(len(ids), device=unit.device)
    size = torch.bincount(index, minlength=len(ids))
    for key in (z, y, x, -size):  # the last counts most
        order = order[torch.argsort(key[order], stable=True)]
    rank = torch.empty_like(order)
    rank[order] = torch.arange(len(ids), device=unit.device)
    return ids[order], rank[index]


_SHARES = 2.0**40


def mass_shares(mass: Tensor) -> Tensor:
    """Shares of the whole mass in whole numbers, which have no order when they are summed.

    Args:
        mass: Masses [kg], [N].

    Returns:
        int64 [N]; they sum to about 2^40.
    """
    mass = mass.double()
    return (mass / mass.sum() * _SHARES).round().long()


def weigh(labels: Tensor, share: Tensor) -> Fragments:
    """The pieces of labelled points.

    Args:
        labels: Piece of each point, [N]: a row, or -1 for none.
        share: Of the mass (:func:`mass_shares`), int64 [N].
    """
    rows = (labels >= 0).nonzero()[:, 0]
    held = labels[rows].long()
    weight = torch.zeros_like(share).index_add_(0, held, share[rows])
    there = torch.zeros_like(labels, dtype=torch.bool).index_fill_(0, held, True)
    ids = there.nonzero()[:, 0].cpu()
    fractions = weight.cpu()[ids].double() / int(share.sum())
    order = torch.argsort(fractions, descending=True, stable=True)
    fractions = fractions[order]
    return Fragments(labels.to(torch.int32), ids[order], fractions, float(1.0 - fractions.sum()))
