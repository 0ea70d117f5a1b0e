"""Points that are led by others of their chunk, and how chunks have turned."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.pipeline.matter.links import PARTED, Links
from gsfluent.pipeline.matter.points import Matter
from gsfluent.pipeline.partition.threshold import CHIP
from gsfluent.pipeline.partition.tree import Partition
from gsfluent.spatial.neighbours import nearest_in_group

WIDE = 1.5
"""Width of the blend of neighbouring points where matter is broken, in point spacings: what is
left of the crack band is rougher than a face."""
HELD, YIELDS = 1.5, 3.0
"""Way [spacings] from the rigid motion of their chunk within which nine tenths of the points are
where what is stiff is drawn rigid, and from which on it is drawn as its points are."""
MOST = 0.9
STRAY, ROUNDS = 1.5, 3
"""Way [spacings] from which on a point of something stiff has strayed from its chunk, and how often
these are left out anew."""
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


def parted(
    links: Links, chunks: tuple[Tensor, Tensor], position: Tensor, last: Tensor, far: Tensor
) -> float:
    """How far neighbours that no longer go together went apart in a frame, half of them.

    Where only dust has left, all the way: that leaves by degrees of its own.

    Args:
        links: Of all points at rest.
        chunks: What each went with before, and now, int64 [N].
        position: Where they are [m], [N', 3].
        last: Where they were [m], [N, 3].
        far: Way that counts as one [spacings], [N].
    """
    near = links.near
    together, parts = (chunk[near] == chunk[:, None] for chunk in chunks)
    row, column = (together & ~parts).nonzero().unbind(dim=1)
    if row.numel() == 0:
        return 1.0
    way = position[: len(last)] - last
    apart = (way[row] - way[near[row, column]]).norm(dim=1)
    return float((apart / (far * links.spacing)[row]).median())


class Lent(NamedTuple):
    """Points whose matter is drawn with another chunk than theirs.

    A partition is smooth: of a spike of points that sticks out of its piece, the neighbour has the
    voxels. What these points are of is seen there.

    Attributes:
        rows: Which, int64 [R].
        owner: The nearest point of the chunk that has their voxels, int64 [R].
    """

    rows: Tensor
    owner: Tensor

    @classmethod
    def of(
        cls, partitions: Mapping[int, Partition], matter: Matter, chunk: Tensor, there: Tensor
    ) -> Lent:
        """Find them, in the order of the bodies.

        Args:
            partitions: Of the bodies that have one.
            matter: The points.
            chunk: Of each of them, int64 [N].
            there: Points that are not dust, bool [N].
        """
        rows, owner = [chunk[:0]], [chunk[:0]]
        for body, partition in partitions.items():
            a, b = matter.ranges[body]
            rest, its = matter.rest[a:b], there[a:b].nonzero()[:, 0]
            voxel, mine = partition.at(rest[its]), chunk[a:b]
            off = ((voxel >= 0) & (voxel != mine[its])).nonzero()[:, 0]
            if off.numel() == 0:
                continue
            near = nearest_in_group(
                rest[its], mine[its], rest[its[off]], voxel[off], 1, matter.spacing[body]
            )[1][:, 0]
            found = near >= 0  # a region that has become dust has nobody
            rows.append(its[off[found]] + a)
            owner.append(its[near[found]] + a)
        return cls(torch.cat(rows), torch.cat(owner))


def chips(chunk: Tensor, there: Tensor, drive: Tensor, count: int, first: int) -> Tensor:
    """Chunks that are chips which something drives, bool [count].

    A chip is too small to say how it bends, and the points of one would be seen as beads: it keeps
    its shape and goes where they go.

    Args:
        chunk: Of each point, int64 [N].
        there: Points that are not dust, bool [N].
        drive: Those that carry their chunk, bool [N].
        count: Number of chunks.
        first: Chunks below this are whole bodies, however small.
    """
    chip = torch.bincount(chunk[there], minlength=count) < CHIP
    chip[:first] = False
    driven = torch.zeros_like(chip)
    driven[chunk[drive]] = True
    return chip & driven


class Motions(NamedTuple):
    """Rigid motions of chunks.

    Attributes:
        turn: Rotations, [C, 3, 3].
        rest: Means of their points at rest [m], float64 [C, 3].
        now: The same now.
    """

    turn: Tensor
    rest: Tensor
    now: Tensor

    def placed(self, chunk: Tensor, rest: Tensor) -> Tensor:
        """Where places [m], [M, 3], of these chunks, int64 [M], are now [m], float64 [M, 3]."""
        arm = rest.double() - self.rest[chunk]
        return self.now[chunk] + (self.turn[chunk].double() @ arm[..., None])[..., 0]


def held(rigid: Motions, chunk: Tensor, rest: Tensor, now: Tensor, spacing: Tensor) -> Tensor:
    """How far each chunk is held in shape, 0 to 1, [C].

    All the way while nine tenths of its points are where its rigid motion takes them; what has
    been crushed, or was never one piece, is not: drawn rigid it would stand in the floor.

    Args:
        rigid: The motions.
        chunk: Of some points, int64 [D].
        rest: Where they were at rest [m], [D, 3].
        now: Where they are [m], [D, 3].
        spacing: Between them [m], [D].
    """
    off = (rigid.placed(chunk, rest) - now.double()).norm(dim=1) / spacing.double()
    most = _quantiles(off, chunk, rigid.turn.shape[0], MOST)
    return ((YIELDS - most) / (YIELDS - HELD)).clamp(0.0, 1.0)


def _quantiles(values: Tensor, chunk: Tensor, count: int, share: float) -> Tensor:
    """Quantiles of values [D] by chunk, int64 [D], of ``count`` chunks; 0 where one has none."""
    order = values.argsort(stable=True)
    order = order[chunk[order].argsort(stable=True)]
    many = torch.bincount(chunk, minlength=count)
    # a whole number of thousandths, so that no device rounds another way
    place = many.cumsum(0) - many + (many - 1).clamp(min=0) * round(1000 * share) // 1000
    sorted_ = torch.cat([values[order], values.new_zeros(1)])
    return torch.where(many > 0, sorted_[place], 0.0)


def motions(
    chunk: Tensor, count: int, rest: Tensor, now: Tensor, spacing: Tensor, stiff: Tensor
) -> Motions:
    """Rigid motions of chunks: the best fit (Kabsch 1976).

    What is stiff is one thing, whatever was crushed at its rim: its fit leaves out what is more
    than :data:`STRAY` from the last one, a few times, but never more than half of the points.

    Args:
        chunk: Of each point that drives one, int64 [D].
        count: Number of chunks.
        rest: Where the points were at rest [m], [D, 3].
        now: Where they are [m], [D, 3].
        spacing: Between them [m], [D]; one value for a chunk.
        stiff: Those of what is stiff, bool [D]; one value for a chunk.
    """
    found = _fitted(chunk, count, rest, now, spacing)
    rows = stiff.nonzero()[:, 0]
    if rows.numel() == 0:
        return found
    chunk, rest, now, spacing = (values[rows] for values in (chunk, rest, now, spacing))
    some = torch.bincount(chunk, minlength=count) > 0
    for _ in range(ROUNDS):
        off = (found.placed(chunk, rest) - now.double()).norm(dim=1) / spacing.double()
        keep = off <= _quantiles(off, chunk, count, 0.5).clamp(min=STRAY)[chunk]
        better = _fitted(chunk[keep], count, rest[keep], now[keep], spacing[keep])
        pairs = zip(better, found, strict=True)
        found = Motions(*(torch.where(some.view(-1, *[1] * (b.dim() - 1)), a, b) for a, b in pairs))
    return found


def _fitted(chunk: Tensor, count: int, rest: Tensor, now: Tensor, spacing: Tensor) -> Motions:
    """The best fits to points; sums go in whole numbers, which have no order."""
    scale = spacing.double()[:, None]
    edge = scale.new_zeros(count, 1).index_copy(0, chunk, scale)
    many = torch.bincount(chunk, minlength=count).clamp(min=1).double()[:, None]
    arms, centers = [], []
    for place in (rest.double(), now.double()):
        whole = (place / scale * _FINE).round().long()
        total = whole.new_zeros(count, 3).index_add_(0, chunk, whole)
        center = total.double() / (_FINE * many)
        arms.append(place / scale - center[chunk])
        centers.append(center * edge)
    square = (arms[1][:, :, None] * arms[0][:, None] * _FINE).round().long()
    total = square.new_zeros(count, 3, 3).index_add_(0, chunk, square)
    size = total.double().abs().amax(dim=(1, 2), keepdim=True).clamp(min=1.0)
    turn, _ = ops.polar_clamped((total.double() / size).contiguous(), 0.3, 2.0)
    return Motions(turn, *centers)
