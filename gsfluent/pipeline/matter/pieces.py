"""Pieces of broken bodies: each owns its half of the crack band.

A crack is a band of broken points some two cells wide. What hangs together without a broken point,
with enough points that never broke, is the *seed* of a piece, and every other point belongs to the
seed that is nearest along links that still hold, where a stretched link is a long way: so the
border between two pieces runs where the band has opened most, and no point is left over in between.
A link between two pieces is cut for good, also after the band has been welded
(:mod:`gsfluent.pipeline.matter.weld`). What no seed reaches is loose: a chip, or dust.

Costs are whole numbers and every sum is one of whole numbers, so that the pieces do not depend on
the order of the points, on threads, or on the device.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.materials import Material
from gsfluent.ops.blade import cut_apart
from gsfluent.ops.graph import FAR_KEY
from gsfluent.pipeline.matter.fragments import DEBRIS, Fragments, mass_shares, ranked, weigh
from gsfluent.spatial.neighbours import nearest_rows

LEAST = 64
"""Points of a seed: 8 cells, less has no node of the grid to itself."""
CHIP = 8
"""Points of the smallest chip: a cell of them. Less has no shape on this grid and is drawn as a
pebble; it is dust, which has grains by the law of sizes, or joins its piece."""
OPEN = 1.5
"""Ratio of a link's length to that at rest from which it is cut when an end of it is broken."""
TORN = 2.0
"""Ratio from which any link is cut."""
_STEEP = 4.0
_COST = 1024.0  # of a link as long as the spacing, unstretched
_RANKS = 24  # bits of a key that hold the rank of a seed
NEAR = 1.5
"""Point spacings from a piece's rigid motion within which a small bit belongs to it."""
REACH = 3.0
"""Point spacings from a piece's points within which dust beyond the bound joins it: the reach of
the kernel."""
STIFF = 3e-3
"""Strain at which a material breaks below which its pieces are never seen to bend."""
_FINE = 2.0**20


def stiff(material: Material) -> bool:
    """Whether nobody sees a piece of a material bend: glass, china, shell, stone.

    What is simulated is softer for the sake of longer steps, and bends before it breaks.
    """
    return material.failure_strain / material.softening**0.5 < STIFF


@dataclass(frozen=True, eq=False)
class Web:
    """What hangs together at rest; does not change.

    Args:
        links: Pairs of rows of one body, int64 [L, 2].
        rest: Positions at rest [m], [N, 3].
        body: Body of each point, int64 [N].
        spacing: Mean distance between the points of each body [m], float64 [bodies].
        mass: Masses [kg], [N].
        flowing: Points that run apart and together, which have no pieces, bool [N].
        may_break: Bodies that can break, or that a blade has touched, bool [bodies].
        dust: Share of a body's mass that may be dust where a piece is one spacing large,
            float64 [bodies]; see :func:`dust_limit`.
        stiff: Bodies of which no piece bends, bool [bodies]; see :func:`stiff`. A crack through
            one is not held together by a neck, nor by what was welded: that would be a hinge.
    """

    links: Tensor
    rest: Tensor
    body: Tensor
    spacing: Tensor
    mass: Tensor
    flowing: Tensor
    may_break: Tensor
    dust: Tensor
    stiff: Tensor

    @functools.cached_property
    def length(self) -> Tensor:
        """Length of each link at rest [m], float64 [L]."""
        a, b = self.links.unbind(dim=1)
        return _length(self.rest[a], self.rest[b])

    @functools.cached_property
    def fixed(self) -> Tensor:
        """Links of points that do not flow, bool [L]."""
        a, b = self.links.unbind(dim=1)
        return ~(self.flowing[a] | self.flowing[b])

    @functools.cached_property
    def share(self) -> Tensor:
        """Share of the mass that each body has, float64 [bodies]."""
        mass = self.mass.double()
        # on the CPU, where sums have an order
        body, part = self.body.cpu(), (mass / mass.sum()).cpu()
        share = torch.zeros(self.may_break.shape[0], dtype=torch.float64)
        return share.index_add_(0, body, part).to(mass.device)

    @functools.cached_property
    def amount(self) -> Tensor:
        """Share of the whole mass that each point has, in whole numbers, int64 [N]."""
        return mass_shares(self.mass)

    @functools.cached_property
    def amounts(self) -> Tensor:
        """The same of the bodies, int64 [bodies]."""
        total = torch.zeros_like(self.may_break, dtype=torch.int64)
        return total.index_add_(0, self.body, self.amount)

    @functools.cached_property
    def spaced(self) -> Tensor:
        """Mean distance between the points of each point's body [m], float64 [N]."""
        return self.spacing[self.body]

    @functools.cached_property
    def size(self) -> Tensor:
        """Points of each body, int64 [bodies]."""
        return torch.bincount(self.body, minlength=self.may_break.shape[0])

    @functools.cached_property
    def whole(self) -> Tensor:
        """First row of each point's body, int64 [N]."""
        rows = torch.arange(self.body.shape[0], device=self.body.device)
        first = torch.full_like(self.may_break, len(rows), dtype=torch.int64)
        return first.scatter_reduce(0, self.body, rows, "amin")[self.body]

    def hurt_by(self, broken: Tensor) -> Tensor:
        """Points that are broken, or linked to one that is, bool [N]."""
        a, b = self.links[self.fixed].unbind(dim=1)
        hurt = broken.index_fill(0, a[broken[b]], True)
        return hurt.index_fill(0, b[broken[a]], True)

    def check(self) -> None:
        """Raise a ValueError where a shape does not match or a link names no point."""
        links, count = self.links, self.rest.shape[0]
        if links.ndim != 2 or links.shape[1] != 2:
            raise ValueError(f"find_pieces: links must have shape [L, 2], got {list(links.shape)}")
        if not self._named:
            raise ValueError(f"find_pieces: links must name rows 0 to {count - 1}")

    @functools.cached_property
    def _named(self) -> bool:
        links, count = self.links, self.rest.shape[0]
        return not links.numel() or (int(links.min()) >= 0 and int(links.max()) < count)


class Pieces(NamedTuple):
    """What hangs together at one moment.

    Attributes:
        fragments: The pieces; of broken points, too. -1 for loose matter and for what flows.
        unit: What each point moves with, int64 [N]: the label of its piece (the lowest row of its
            seed that never broke), the lowest row of its chip, the first row of its body where
            that is whole; -1 for dust, and for what flows and lies on no piece.
        cut_links: Links that are cut for good, bool [L].
        dust: Points that belong to nothing, bool [N].
        chip: Points of chips, bool [N].
    """

    fragments: Fragments
    unit: Tensor
    cut_links: Tensor
    dust: Tensor
    chip: Tensor


def find_pieces(
    web: Web,
    position: Tensor,
    broken: Tensor,
    cut_links: Tensor,
    *,
    ever: Tensor | None = None,
    sides: Tensor | None = None,
    gone: Tensor | None = None,
    least: int = LEAST,
) -> Pieces:
    """Give every point its piece.

    Args:
        web: What hangs together at rest.
        position: Positions now [m], [N, 3].
        broken: Broken points, bool [N].
        cut_links: Links that were cut before, bool [L].
        ever: Points that ever broke, bool [N]; those that are broken when absent. What was welded
            is no seed alone: a weld near a crack must not part what lies behind it.
        sides: Sides of blades, int32 [N]; a link between opposite sides is cut.
        gone: Dust that left the grid before, bool [N]; nothing hangs on it.
        least: Points of a seed that never broke; a body of less than twice as many needs half of
            its own.

    Returns:
        The pieces. A body in which nothing is broken or cut is whole, whatever its size.

    Raises:
        ValueError: A shape does not match, or a link names a point that does not exist.
    """
    _check(web, position, broken, cut_links)
    body, count = web.body, web.body.shape[0]
    a, b = web.links.unbind(dim=1)
    if sides is not None:
        cut_links = cut_links | (cut_apart(sides[a], sides[b]) & web.fixed)
    cut, cost, ends = ops.link_costs(
        web.links, web.length, web.spaced, position.double(), broken, web.flowing,
        web.may_break[body], cut_links, gone, open=OPEN, torn=TORN, steep=_STEEP, unit=_COST,
        shift=_RANKS,
    )  # fmt: skip

    unit, size = web.whole, web.size
    hurt = torch.zeros_like(web.may_break)
    hurt[body[(broken | ends).nonzero()[:, 0]]] = True
    split = hurt & web.may_break
    if not bool(split.any()):
        labels = torch.where(web.flowing, DEBRIS, unit)
        none = torch.zeros_like(broken)
        return Pieces(weigh(labels, web.amount), unit, cut, none, none)

    here = split[body]
    whole = here & ~broken & ~web.flowing
    enough = torch.minimum(torch.full_like(size, least), (size + 1) // 2)[body]
    whole = _firm(web, whole, broken if ever is None else ever, cut, enough)
    root = ops.components(web.links, count, apart=cut, inside=whole)
    fresh = (whole if ever is None else whole & ~ever).nonzero()[:, 0]
    seed = whole & (torch.bincount(root[fresh], minlength=count)[root] >= enough)
    name = root.new_full((count,), count).scatter_reduce(0, root[fresh], fresh, "amin")
    unit = torch.where(seed, name[root], torch.where(here, DEBRIS, unit))
    unit = _nearest_seed(web, unit, seed, here & ~seed, cost)

    # What no seed reaches: lumps of broken matter are pieces all the same, smaller things are not.
    lost = here & (unit < 0) & ~web.flowing
    chip = torch.zeros_like(lost)
    bits = chip
    if bool(lost.any()):
        root = ops.components(web.links, count, apart=cost <= 0, inside=lost)
        members = torch.bincount(root, minlength=count)[root]
        lump = lost & (members >= enough)
        chip = lost & ~lump & (members >= CHIP)
        bits = lost & ~lump & ~chip
        unit = torch.where(lump | chip, root, unit)
        if gone is not None:
            bits = bits & ~gone
    solid = (unit >= 0) & ~chip & ~web.flowing
    if bool(bits.any()):
        unit = _join(web, unit, position, solid, bits, gone, sides)
        solid = (unit >= 0) & ~chip & ~web.flowing
    cut = cut | ((unit[a] != unit[b]) & web.fixed & here[a])
    labels = torch.where(solid, unit, DEBRIS)
    return Pieces(weigh(labels, web.amount), unit, cut, lost & (unit < 0), chip)


def dust_limit(share: Tensor, points: Tensor) -> Tensor:
    """Largest share of a body's mass that may be dust.

    ``share (h / L)^(4 - 3.5)``: fragments of a solid are as frequent as their size to the power
    -3.5 (Villermaux, Phys. Rev. Lett. 135, 2025, 228201), L is the size of the largest.

    Args:
        share: Of the material, float64 [bodies].
        points: Points of the largest piece, int64 [bodies]; 0 counts as one.

    Returns:
        float64 [bodies].
    """
    return share * points.clamp(min=1).double() ** (-0.5 / 3.0)


def _check(web: Web, position: Tensor, broken: Tensor, cut_links: Tensor) -> None:
    web.check()
    links, count = web.links, web.rest.shape[0]
    for name, value in (("position", position), ("broken", broken), ("mass", web.mass)):
        if value.shape[0] != count:
            raise ValueError(
                f"find_pieces: {name} must have {count} rows (from rest), got {value.shape[0]}"
            )
    if cut_links.shape[0] != links.shape[0]:
        raise ValueError(
            f"find_pieces: cut_links must have {links.shape[0]} rows (from links), "
            f"got {cut_links.shape[0]}"
        )


def _length(a: Tensor, b: Tensor) -> Tensor:
    """Distances [m], float64: one operation at a time, which rounds alike on every device."""
    x, y, z = (a.double() - b.double()).unbind(dim=1)
    return (x * x + y * y + z * z).sqrt()


def _firm(web: Web, whole: Tensor, ever: Tensor, cut: Tensor, enough: Tensor) -> Tensor:
    """Whole points, less the necks of what is stiff.

    Where two parts with enough points each hang together only by points that broke once, or by such
    as lie beside one, all of those go: they hold two halves at an angle, as a hinge does.

    Args:
        web: What hangs together at rest.
        whole: Points that are not broken now, bool [N].
        ever: Points that broke once, bool [N].
        cut: Links that do not count, bool [L].
        enough: Points of a part, int64 [N].
    """
    own = web.stiff[web.body] & whole
    if not bool(own.any()):
        return whole
    count = len(whole)
    root = ops.components(web.links, count, apart=cut, inside=own)
    core = own & ~web.hurt_by(ever)
    part = ops.components(web.links, count, apart=cut, inside=core)
    size = torch.bincount(part[core], minlength=count)
    first = core & (part == torch.arange(count, device=part.device)) & (size >= enough)
    parts = torch.bincount(root[first], minlength=count)
    neck = own & (parts[root] >= 2) & ~(core & (size[part] >= enough))
    return whole & ~neck


def _nearest_seed(web: Web, unit: Tensor, seed: Tensor, other: Tensor, cost: Tensor) -> Tensor:
    """Units in which every other point that a seed reaches has that seed's; the rest as it was.

    What costs the same goes to the larger seed.
    """
    rows = seed.nonzero()[:, 0]
    if rows.numel() == 0:
        return unit
    ids, rank = ranked(unit[rows], web.rest[rows])
    key = torch.full_like(unit, FAR_KEY).index_copy(0, rows, rank)
    key = ops.nearest_seeds(web.links, cost, key, other)
    reached = other & (key < FAR_KEY)
    return torch.where(reached, ids[(key & ((1 << _RANKS) - 1)).clamp(max=len(ids) - 1)], unit)


def _join(
    web: Web, unit: Tensor, position: Tensor, solid: Tensor, bits: Tensor, gone: Tensor | None,
    sides: Tensor | None,
) -> Tensor:  # fmt: skip
    """Let bits join the piece beside them, where they have moved with it.

    Of the others so many stay dust as the bound on its mass allows, the farthest from their piece
    first; what is too much joins its piece as well, if it is within reach of it still: what has
    flown off cannot.
    """
    rows, among = bits.nonzero()[:, 0], solid.nonzero()[:, 0]
    beside = torch.full_like(rows, -1)
    away = torch.full((rows.shape[0],), torch.inf, dtype=torch.float64, device=rows.device)
    for body in torch.unique(web.body[rows]).tolist():
        mine, its = web.body[rows] == body, among[web.body[among] == body]
        if its.numel() == 0:
            continue
        cell = REACH * float(web.spacing[body])
        found = nearest_rows(position[its], position[rows[mine]], 1, cell)[1]
        beside[mine] = its[found[:, 0]]
    known = beside >= 0
    if sides is not None:
        known = known & ~cut_apart(sides[rows], sides[beside.clamp(min=0)])
    piece = torch.where(known, unit[beside.clamp(min=0)], -1)
    near = known.nonzero()[:, 0]
    if near.numel():
        place = _moved(web, unit, position, piece[near], web.rest[rows[near]])
        away[near] = _length(place, position[rows[near]])
    spacing = web.spacing[web.body[rows]]
    stays = known & (away <= NEAR * spacing)
    apart = _length(position[beside.clamp(min=0)], position[rows])
    surplus = _surplus(web, unit, solid, rows, stays, away, gone)
    stays = stays | (surplus & known & (apart <= REACH * spacing))
    return unit.index_copy(0, rows, torch.where(stays, piece, -1))


def _surplus(
    web: Web, unit: Tensor, solid: Tensor, rows: Tensor, stays: Tensor, away: Tensor,
    gone: Tensor | None,
) -> Tensor:  # fmt: skip
    """Bits that are beyond the bound on dust, bool as ``rows``."""
    share, total = web.amount, web.amounts
    members = torch.bincount(unit[solid], minlength=unit.shape[0])[unit.clamp(min=0)]
    members = torch.where(solid, members, 0)
    largest = torch.zeros_like(total).scatter_reduce(0, web.body, members, "amax")
    left = (dust_limit(web.dust, largest) * total.double()).floor().long()
    if gone is not None:
        left = left.index_add(0, web.body[gone], -share[gone])
    # By body, then the farthest first; bodies begin anew in the running sum.
    order = torch.argsort(away, descending=True, stable=True)
    order = order[~stays[order]]
    order = order[torch.argsort(web.body[rows[order]], stable=True)]
    owner, amount = web.body[rows[order]], share[rows[order]]
    spent = torch.zeros_like(total).index_add(0, owner, amount)
    running = torch.cumsum(amount, 0) - (torch.cumsum(spent, 0) - spent)[owner]
    surplus = torch.zeros_like(stays)
    surplus[order] = running > left[owner]
    return surplus


def _moved(web: Web, unit: Tensor, position: Tensor, label: Tensor, places: Tensor) -> Tensor:
    """Where places at rest [M, 3] would be, had they moved with their pieces as rigid bodies.

    The best rotation by the covariance (Kabsch 1976), in whole numbers of ``spacing / 2^20``, which
    have no order.

    Args:
        web: The points at rest.
        unit: Piece of each, int64 [N].
        position: Where they are [m], [N, 3].
        label: Piece of each place, int64 [M].
        places: [m], [M, 3].
    """
    names, of = torch.unique(label, return_inverse=True)
    slot = torch.searchsorted(names, unit).clamp(max=len(names) - 1)
    points = (names[slot] == unit).nonzero()[:, 0]
    slot = slot[points]
    order = torch.argsort(slot, stable=True)
    points, slot = points[order], slot[order]
    count = torch.bincount(slot, minlength=len(names))
    ends = torch.cumsum(count, 0)
    spacing = web.spacing[web.body[points]].double()
    scale = spacing[ends - count]  # of one body, of one spacing

    last = (torch.arange(9, device=points.device)[:, None] * len(points) + ends - 1).flatten()

    def total(values: list[Tensor]) -> Tensor:
        """Sums by piece of values [P] that are whole numbers when they are finer, int64 [S, K]."""
        whole = (torch.stack(values) * (_FINE / spacing)).round().long().flatten()
        # one running sum of one row: of several a GPU makes slow ones
        sums = torch.cumsum(whole, 0)[last[: len(values) * len(names)]]
        sums = torch.diff(sums, prepend=torch.zeros_like(sums[:1]))
        return sums.view(len(values), -1).T

    arms, middles = [], []
    for x in (web.rest[points].double(), position[points].double()):
        middle = total(list(x.unbind(dim=1))).double() / count[:, None] * (scale / _FINE)[:, None]
        middles.append(middle)
        arms.append((x - middle[slot]).unbind(dim=1))
    square = total([arms[1][i] * arms[0][j] / spacing for i in range(3) for j in range(3)])
    u, _, vh = torch.linalg.svd(square.cpu().double().reshape(-1, 3, 3))
    turn = torch.ones(len(names), 1, 3, dtype=torch.float64)
    turn[:, 0, 2] = torch.sign(torch.linalg.det(u) * torch.linalg.det(vh))
    rotation = ((u * turn) @ vh).to(places.device)[of]
    x, y, z = (places.double() - middles[0][of]).unbind(dim=1)
    moved = [
        middles[1][of, i] + (rotation[:, i, 0] * x + rotation[:, i, 1] * y + rotation[:, i, 2] * z)
        for i in range(3)
    ]
    return torch.stack(moved, dim=1)
