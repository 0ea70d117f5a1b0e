"""Regions that come apart at one time, and what of their points the rest of them goes with."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from gsfluent.pipeline.matter.carry import nearest_points
from gsfluent.pipeline.matter.fragments import ranked
from gsfluent.pipeline.matter.points import Matter
from gsfluent.pipeline.partition.threshold import CHIP
from gsfluent.spatial.neighbours import nearest_in_group

PART = 3
"""Points of a piece in a region for which that is divided; a chip may lie across two."""
TRICKLE = 512
"""Dust that is less than this part of its region stays in it until there is more: it costs as much
to take out as a piece."""
MOST = 32_000
"""Pieces that a region is split into at once, at most."""


class Torn(NamedTuple):
    """A region whose points belong to several pieces, or have become dust.

    Attributes:
        region: Its number.
        rows: Its points that are of a piece, int64 [P].
        rank: Which one, int64 [P]; 0 the largest, and so on.
        pieces: How many.
        dust: The piece that is dust, single points; -1 for none.
    """

    region: int
    rows: Tensor
    rank: Tensor
    pieces: int
    dust: int


class Shares(NamedTuple):
    """How many points of every piece each region holds.

    Attributes:
        chunk: Regions, ascending, int64 [S].
        piece: Piece in each, ascending in a region, int64 [S].
        many: Points of it there, int64 [S].
        share: Row above of every point, int64 [P].
        dust: The piece that is dust.
    """

    chunk: Tensor
    piece: Tensor
    many: Tensor
    share: Tensor
    dust: int

    @classmethod
    def of(cls, chunk: Tensor, piece: Tensor, dust: int) -> Shares:
        """Of points in these regions that belong to these pieces, int64 [P]; dust is the last."""
        pair, share, many = torch.unique(
            chunk * (dust + 1) + piece, return_inverse=True, return_counts=True
        )
        return cls(pair // (dust + 1), pair % (dust + 1), many, share, dust)

    @property
    def _enough(self) -> Tensor:
        return (self.many >= PART) | (self.piece == self.dust)

    def parting(self, regions: int, bodies: int) -> list[int]:
        """Regions that must be divided.

        Args:
            regions: Number of regions.
            bodies: The first so many are bodies that were whole; a small one is no chip.
        """
        chunk, many, dusty = self.chunk, self.many, self.piece == self.dust
        pieces = torch.bincount(chunk[self._enough & ~dusty], minlength=regions)
        size, lost = (torch.zeros_like(pieces) for _ in range(2))
        size.index_add_(0, chunk, many)
        lost.index_add_(0, chunk, torch.where(dusty, many, 0))
        chip = size < CHIP
        chip[:bodies] = False
        torn = ((pieces > 1) | ((lost > 0) & (TRICKLE * lost >= size))) & ~chip
        return torn.nonzero()[:, 0].tolist()

    def torn(self, regions: list[int], rows: Tensor, rest: Tensor) -> list[Torn]:
        """What some regions fall into.

        Args:
            regions: Which, ascending.
            rows: The points, int64 [P].
            rest: All points at rest [m], [N, 3].
        """
        among = torch.isin(self.chunk, self.chunk.new_tensor(regions)) & self._enough
        # labels are small numbers; the rest goes where it lay
        for number in regions if int(among.sum()) > MOST else ():
            its = (among & (self.chunk == number)).nonzero()[:, 0]
            if len(its) > MOST:
                among[its[self.many[its].argsort(descending=True, stable=True)[MOST:]]] = False
        mine = among[self.share].nonzero()[:, 0]
        share = self.share[mine]
        region = self.chunk[share]
        order = torch.argsort(region, stable=True)
        place = torch.searchsorted(self.chunk.new_tensor(regions), region)
        sizes = torch.bincount(place, minlength=len(regions))
        found = []
        for number, part in zip(regions, order.split(sizes.tolist()), strict=True):
            points = rows[mine[part]]
            names, rank = ranked(self.piece[share[part]], rest[points])
            dust = (names == self.dust).nonzero()[:, 0].tolist()
            found.append(Torn(number, points, rank, len(names), dust[0] if dust else -1))
        return found


class Sides:
    """Points of regions of one body that have just been divided.

    Args:
        rest: All points at rest [m], [N, 3].
        cell: Distance between those of this body [m].
        chunk: Region of every point now, int64 [N].
        regions: Number of regions now.
        torn: What was divided.
        ids: For each, the regions of its pieces.
    """

    def __init__(
        self, rest: Tensor, cell: float, chunk: Tensor, regions: int, torn: Sequence[Torn],
        ids: Sequence[Sequence[int]],
    ) -> None:  # fmt: skip
        origin, ash = [-1] * regions, [False] * regions
        for index, (part, its) in enumerate(zip(torn, ids, strict=True)):
            for region in its:
                origin[region] = index
            if part.dust >= 0:
                ash[its[part.dust]] = True
        self._rest, self._cell, self._chunk = rest, cell, chunk
        self.of = torch.tensor(origin, device=chunk.device)
        """Number in ``torn`` that each region comes from, int64 [R]; -1 for all others."""
        self.ash = torch.tensor(ash, device=chunk.device)
        """Regions that are dust, bool [R]."""
        rows = torch.cat([part.rows for part in torn])
        thrown = torch.cat([part.rank == part.dust for part in torn])
        number = torch.arange(len(torn), device=rows.device).repeat_interleave(
            torch.tensor([len(part.rows) for part in torn], device=rows.device),
            output_size=len(rows),
        )
        self.thrown = rows[thrown]
        """Points that have become dust, int64 [K]."""
        # what is all dust has no other points to go by
        whole = torch.tensor([part.pieces == 1 for part in torn], device=rows.device)[number]
        firm = ~thrown | whole
        self._firm, self._firm_of, self._thrown_of = rows[firm], number[firm], number[thrown]

    def among(self, regions: Tensor) -> Tensor:
        """Rows of what belongs to a divided region, by what they come from, int64 [M]."""
        number = self.of[regions]
        rows = (number >= 0).nonzero()[:, 0]
        return rows[torch.argsort(number[rows], stable=True)]

    def own(self, places: Tensor, region: Tensor) -> Tensor:
        """Nearest point of each place's region; of all that came from the same if it has none."""
        near = self._near(self._firm, self._chunk[self._firm], places, region)
        lost = (near < 0).nonzero()[:, 0]
        return near.index_copy(0, lost, self.firm(places[lost], region[lost]))

    def across(self, places: Tensor, region: Tensor) -> Tensor:
        """:meth:`own` of regions across a face; of what is thrown where that is dust."""
        found = self.own(places, region)
        dust = self.ash[region].nonzero()[:, 0]
        return found.index_copy(0, dust, self.burnt(places[dust], region[dust]))

    def firm(self, places: Tensor, region: Tensor) -> Tensor:
        """Nearest point that is no dust and comes from the same as each place's region."""
        return self._near(self._firm, self._firm_of, places, self.of[region])

    def burnt(self, places: Tensor, region: Tensor) -> Tensor:
        """Nearest point that is dust and comes from the same as each place's region."""
        return self._near(self.thrown, self._thrown_of, places, self.of[region])

    def _near(self, rows: Tensor, group: Tensor, places: Tensor, wanted: Tensor) -> Tensor:
        """Nearest of some rows of the wanted group, -1 where it has none."""
        if len(places) == 0:
            return rows[:0]
        near = nearest_in_group(self._rest[rows], group, places, wanted, 1, self._cell)[1][:, 0]
        return torch.where(near < 0, near, rows[near.clamp(min=0)]) if len(rows) else near


def flows_at(places: Tensor, body: int, firm: Tensor, matter: Matter) -> Tensor:
    """Whether places at rest lie in what flows, which has no faces, bool [P].

    Args:
        places: In a body [m], [P, 3].
        body: Its number.
        firm: Points that do not flow, bool [N].
        matter: The material points.
    """
    start, end = matter.ranges[body]
    if bool(firm[start:end].all()):
        return torch.zeros_like(places[:, 0], dtype=torch.bool)
    own = torch.full_like(places[:, 0], body, dtype=torch.int64)
    return ~firm[nearest_points(places, own, matter)]
