"""Chunks: the pieces of a running simulation, cut from the rest solid and carried by their points.

A region of the rest solid (:mod:`gsfluent.pipeline.partition`) moves with those of its points that
belong to its piece; the points only carry it. When they are seen to belong to several pieces, the
region is split, once and for good. A crack inside one piece, which is not through yet, is left to
:mod:`gsfluent.pipeline.cracks.gaps`.

Cuts and faces fade in with the gap, so that a split by itself changes no picture.
"""

from __future__ import annotations

import copy
import dataclasses
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gsfluent import geometry, ops
from gsfluent.data import TRANSITION, Gaussians
from gsfluent.errors import InputError
from gsfluent.pipeline.cracks.chunk_faces import (
    ChunkCuts,
    ChunkFaces,
    find_cuts,
    find_faces,
    wide_cuts,
)
from gsfluent.pipeline.cracks.cuts import cut_at
from gsfluent.pipeline.cracks.gaps import Births, Cracks, Gaps
from gsfluent.pipeline.matter.carry import BLEND, Carry, Points
from gsfluent.pipeline.matter.fragments import components
from gsfluent.pipeline.matter.links import PARTED
from gsfluent.pipeline.matter.pieces import CHIP
from gsfluent.pipeline.matter.points import body_frame
from gsfluent.pipeline.partition.roughness import amplitude
from gsfluent.pipeline.partition.tree import Partition, ranked
from gsfluent.results.partition import SavedBody, SavedPartition, SavedSplit
from gsfluent.spatial.neighbours import nearest_rows

OPACITY = 0.97
"""Opacity of a face element where the gap is wide."""
CLOSED, SHOWN = 0.1, 0.3
"""Gaps [voxels] up to which nothing shows, and from which on cuts and faces are all there."""
WIDE = 1.5
"""Width of the blend of neighbouring points where matter is broken, in point spacings: what is
left of the crack band is rougher than a face."""
FIRM = 5
"""Of its neighbours at rest so many must hang together with a point, or it is crumb."""
LUMP = 64
"""Points of one piece that hang together, below which they are crumbs as well."""
MOST = 32_000
"""Pieces that a region is split into at once, at most."""
_NUMBERS = 1 << 54  # ids of face elements begin here, beyond those of births
_FINE = 2.0**20


class _Followers(NamedTuple):
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


class Chunks:
    """Follows the chunks of one run.

    Args:
        carry: The binding of the splats; it must know its scene (:meth:`Carry.bind`).

    Raises:
        InputError: It does not.
    """

    def __init__(self, carry: Carry) -> None:
        if carry.scene is None:
            raise InputError(
                "repair: the binding knows no scene, so there is no solid to cut pieces from",
                hint="bind with Carry.bind(scene, matter), or use Repair(method='mvee')",
            )
        self.base, self._scene = carry, carry.scene
        self._gaps = Gaps(carry)
        matter = carry.matter
        flowing = matter.of_law("fluid", "drucker_prager")
        self._body = matter.particles.body.long()
        solid = torch.tensor(
            [b.solid is not None for b in self._scene.bodies], device=self._body.device
        )
        self._may = solid[self._body] & ~flowing
        self.restore({})

    # --- a run that is taken up again ---

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from :meth:`state` of another run of the same scene; from nothing when empty."""
        device = self._body.device
        self._partitions: dict[int, Partition] = {}
        self._events: list[dict[str, Any]] = []
        self._regions, self._steps = len(self._scene.bodies), 0
        self._chunk = self._body.clone()
        self._drives = torch.ones_like(self._may)
        self._crumb = torch.zeros_like(self._may)
        self._follow: _Followers | None = None
        self._unit: Tensor | None = None
        self._faces: ChunkFaces | None = None
        self._cuts: list[ChunkCuts] = []
        self._region = self.base.body.clone()
        self._owner = self.base.owner
        self._links = self.base.links
        for event in state.get("splits", ()):
            rows, rank = event["rows"].to(device), event["rank"].to(device)
            self._steps = int(event.get("frame", 0))
            self._split(int(event["region"]), rows, rank)
        self._steps = int(state.get("steps", 0))
        if state:
            self._crumb[state["crumbs"].to(device)] = True
            self._relink()
        self._gaps.restore({})
        self._gaps.rebind(self._carry())
        if state:
            self._gaps.restore(state["gaps"])

    def state(self) -> dict[str, Any]:
        """What a later run needs to go on from here."""
        return {
            "splits": [
                {k: v.cpu() if torch.is_tensor(v) else v for k, v in event.items()}
                for event in self._events
            ],
            "crumbs": self._crumb.nonzero()[:, 0].cpu(),
            "gaps": self._gaps.state(),
            "steps": self._steps,
        }

    def partition(self) -> SavedPartition:
        """All splits so far, with what it takes to make them again."""
        matter, scene = self.base.matter, self._scene
        bodies = tuple(
            SavedBody(
                number, body.name, body_frame(body, scene), float(matter.spacing[number]),
                amplitude(body.material.name),
            )
            for number, body in enumerate(scene.bodies)
            if body.solid is not None and bool(self._may[self._body == number].any())
        )  # fmt: skip
        return SavedPartition(
            rest=matter.rest,
            body=self._body,
            carries=self._may,
            crumbs=self._crumb.nonzero()[:, 0],
            regions=len(scene.bodies),
            bodies=bodies,
            splits=tuple(
                SavedSplit(e["region"], e["frame"], e["rows"], e["rank"]) for e in self._events
            ),
        )

    # --- frames ---

    def step(self, points: Points) -> Cracks:
        """Go on to the next frame.

        Args:
            points: Where the material points are now, with what each moves with (``unit``); points
                that joined the run later, to which no splat is bound, come last.
        """
        count = self._chunk.shape[0]
        unit = points.unit if points.unit is not None else points.fragments.long()
        unit = unit[:count]
        if self._unit is None or not torch.equal(unit, self._unit):
            self._unit = unit
            before = self._chunk
            self._look(unit)
            if self._chunk is not before:
                self._relink()
        self._steps += 1
        shown, carry = self._moved(points), self._carry(points)
        self._gaps.rebind(carry)
        cracks = self._gaps.step(shown)
        if self._faces is None:
            return cracks
        points = cracks.points
        rest = self._cut(cracks.rest, carry, points)
        births = self._born(carry, points, cracks.births)
        return Cracks(points, rest, births, carry)

    # --- what belongs together ---

    def _look(self, unit: Tensor) -> None:
        """Split regions whose points belong to several pieces, and see which points drive them."""
        count = unit.shape[0]
        while True:
            counted = self._may & (unit >= 0)
            pair, many = torch.unique(
                self._chunk[counted] * count + unit[counted], return_counts=True
            )
            chunk, piece = pair // count, pair % count
            enough = many >= CHIP
            times = torch.bincount(chunk[enough], minlength=self._regions)
            torn = (times > 1).nonzero()[:, 0].tolist()
            if not torn:
                break
            for region in torn:
                units, members = (x[enough & (chunk == region)] for x in (piece, many))
                if units.numel() > MOST:  # labels are small numbers; the rest goes where it lay
                    units = units[members.argsort(descending=True, stable=True)[:MOST]]
                mine = self._may & (self._chunk == region)
                rows = (mine & torch.isin(unit, units)).nonzero()[:, 0]
                _, rank = ranked(unit[rows], self.base.matter.rest[rows])
                self._split(region, rows, rank)
        # a region moves with the piece that most of its points belong to
        most = torch.zeros(self._regions, dtype=torch.int64, device=unit.device)
        most.scatter_reduce_(0, chunk, many, "amax")
        lead = torch.full_like(most, count)
        best = many == most[chunk]
        lead.scatter_reduce_(0, chunk[best], piece[best], "amin")
        theirs = lead[self._chunk]
        self._drives = ~self._may | (unit == theirs) | (theirs == count)

    def _split(self, region: int, rows: Tensor, rank: Tensor) -> None:
        """Divide a region by the pieces of some of its points."""
        event = {"region": region, "rows": rows, "rank": rank.to(torch.int32)}
        self._events.append({**event, "frame": self._steps})
        matter = self.base.matter
        body = int(self._body[rows[0]])
        partition = self._partitions.get(body)
        rest, rank = matter.rest, rank.long()
        solid = self._scene.bodies[body].solid
        assert solid is not None  # _may sees to it
        solid = solid.to(rest.device)
        if partition is None:
            a, b = matter.ranges[body]
            partition = Partition(
                solid, body_frame(self._scene.bodies[body], self._scene), rest[a:b],
                matter.spacing[body], body, amplitude(self._scene.bodies[body].material.name),
            )  # fmt: skip
            self._partitions[body] = partition
        pieces = int(rank.max()) + 1
        ids = [region, *range(self._regions, self._regions + pieces - 1)]
        self._regions += pieces - 1
        split = partition.split(region, rest[rows], rank, ids)
        chunk = partition.assign(self._chunk, split, rest, rows, rank)
        self._chunk = chunk
        self._reassign(region, partition, chunk, rows)
        splats = (self._region == region).nonzero()[:, 0]
        here, cuts = find_cuts(partition, split, self.base.gaussians, splats)
        self._region = self._region.index_copy(0, splats, here)
        owner, means = self._owner[splats], self.base.gaussians.means[splats]
        wrong = self._chunk[owner] != here
        owner[wrong] = self._nearest(means[wrong], here[wrong], rows)
        self._owner = self._owner.index_copy(0, splats, owner)
        made = find_faces(partition, split, solid, len(self._events) - 1)
        spacing = matter.spacing[body]
        cuts = wide_cuts(self.base.gaussians, splats, here, cuts, made, spacing)
        rival = self._nearest(self.base.gaussians.means[cuts.splat], cuts.beyond, rows)
        self._cuts.append(cuts._replace(rival=rival))
        made = dataclasses.replace(
            made,
            owner=self._nearest(made.means, made.region, rows),
            rival=self._nearest(made.means, made.beyond, rows),
        )
        old = [] if self._faces is None else [self._faces]
        self._faces = ChunkFaces.joined([*old, made])

    def _reassign(self, region: int, partition: Partition, chunk: Tensor, rows: Tensor) -> None:
        """Older elements of a region go with the part that their voxel lies in."""
        faces = self._faces
        if faces is None:
            return
        stale = (faces.region == region).nonzero()[:, 0]
        now = partition.region.view(-1)[faces.voxel[stale]].long()
        owner = faces.owner[stale]
        wrong = chunk[owner] != now
        owner[wrong] = self._nearest(faces.means[stale[wrong]], now[wrong], rows)
        self._faces = dataclasses.replace(
            faces,
            region=faces.region.index_copy(0, stale, now),
            owner=faces.owner.index_copy(0, stale, owner),
        )

    def _nearest(self, places: Tensor, region: Tensor, rows: Tensor) -> Tensor:
        """Nearest of some rows of each place's region; of all where there is none."""
        found = torch.full_like(region, -1)
        rest, chunk = self.base.matter.rest, self._chunk[rows]
        spacing = self.base.matter.spacing[int(self._body[rows[0]])]
        for number in torch.unique(region).tolist():
            mine, its = (region == number).nonzero()[:, 0], rows[chunk == number]
            its = its if its.numel() else rows
            near = nearest_rows(rest[its], places[mine], 1, spacing)[1][:, 0]
            found[mine] = its[near]
        return found

    # --- motion ---

    def _relink(self) -> None:
        """Every point has neighbours of its own chunk."""
        base, chunk = self.base.links, self._chunk
        stale = (chunk[base.near] != chunk[:, None]).any(dim=1).nonzero()[:, 0]
        if stale.numel() == 0:
            self._links = base
            return
        near, lone = base.near.clone(), torch.zeros_like(base.near, dtype=torch.bool)
        near[stale], lone[stale] = self._neighbours(stale, torch.ones_like(self._may))
        self._links = base.rewired(near, lone)

    def _neighbours(self, rows: Tensor, among: Tensor) -> tuple[Tensor, Tensor]:
        """Nearest points of the own chunk, int64 [R, K], and the columns that are none, bool.

        A point whose chunk has nobody has itself.
        """
        rest, chunk = self.base.links.rest, self._chunk
        width = self.base.links.near.shape[1]
        near = rows[:, None].repeat(1, width)
        lone = torch.ones_like(near, dtype=torch.bool)
        lone[:, 0] = False
        for number in torch.unique(chunk[rows]).tolist():
            its = ((chunk == number) & among).nonzero()[:, 0]
            mine = (chunk[rows] == number).nonzero()[:, 0]
            k = min(width, its.numel())
            if k == 0:
                continue
            spacing = float(self.base.links.spacing[rows[mine[0]]])
            found = its[nearest_rows(rest[its], rest[rows[mine]], k, 1.5 * spacing)[1]]
            near[mine] = found[:, :1]
            near[mine, :k] = found
            lone[mine, :k] = False
        return near, lone

    def _carry(self, points: Points | None = None) -> Carry:
        """The binding as it is now."""
        carry = copy.copy(self.base)
        carry.links, carry.owner = self._links, self._owner
        if points is not None:
            broken = points.broken[: self._chunk.shape[0]] & self._may
            if bool(broken.any()):
                carry.width = torch.where(broken, WIDE, BLEND) * self._links.spacing
        return carry

    def _moved(self, points: Points) -> Points:
        """Points as they carry: pieces are chunks, and crumbs follow what is firm.

        Broken matter has no shape to keep: it turns with its chunk. What hangs on next to nothing
        says nothing about where the chunk is, so it is put where the firm points around it are.
        """
        count = self._chunk.shape[0]
        broken = points.broken[:count] & self._may
        loose = (points.fragments[:count] < 0) & self._may
        if not bool((broken | loose).any()):
            return points
        chunk = points.fragments.clone()
        chunk[:count] = torch.where(self._may, self._chunk.to(chunk.dtype), chunk[:count])
        position = points.position
        shapeless = (broken | loose)[:, None, None]
        turn = self._turns(position[:count]).to(points.map)
        moved, rotation = points.map.clone(), points.rotation.clone()
        moved[:count] = torch.where(shapeless, turn, moved[:count])
        rotation[:count] = torch.where(shapeless, turn, rotation[:count])
        self._crumb = self._crumb | self._crumbs(position, chunk, points.broken)
        position = self._led(position, moved)
        return points._replace(position=position, fragments=chunk, map=moved, rotation=rotation)

    def _crumbs(self, position: Tensor, chunk: Tensor, broken: Tensor) -> Tensor:
        """Points that are broken and hang on next to nothing."""
        hanging = self._links.look(position, chunk, broken=broken)
        holds, near = ~hanging.parted, self._links.near
        count = near.shape[0]
        firm = self._drives & ~self._crumb & (holds.sum(dim=1) > FIRM)
        link = holds & firm[:, None] & firm[near]
        a, k = link.nonzero().unbind(dim=1)
        root = components(a, near[a, k], count)
        size = torch.bincount(root[firm], minlength=count)[root]
        firm &= size >= LUMP
        # a chunk that has nothing firm goes with all of its points
        whole = torch.zeros(self._regions, dtype=torch.bool, device=firm.device)
        whole[self._chunk[firm]] = True
        return self._may & ~firm & whole[self._chunk] & broken[:count]

    def _led(self, position: Tensor, moved: Tensor) -> Tensor:
        """Positions in which crumbs, and what has left its piece, follow the firm points."""
        leads = self._drives & ~self._crumb
        rows = (self._may & ~leads).nonzero()[:, 0]
        if rows.numel() == 0:
            return position
        key = torch.stack([self._chunk, leads.long()])
        if self._follow is None or not torch.equal(key, self._follow.key):
            near, lone = self._neighbours(rows, leads)
            self._follow = _Followers(rows, near, lone, key)
        near, lone = self._follow.near, self._follow.lone
        rest, spacing = self.base.links.rest, self._links.spacing
        # on one side of a crack: that of the nearest
        first = near[:, :1]
        before = (rest[near] - rest[first]).norm(dim=2).clamp(min=0.5 * spacing[rows, None])
        after = (position[near] - position[first]).norm(dim=2)
        parted = lone | (after > PARTED * before)
        links = self._links
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
        return position.index_copy(0, rows, place)

    def _turns(self, now: Tensor) -> Tensor:
        """Rotation of each point's chunk: the best fit (Kabsch 1976), [N, 3, 3].

        Sums go in whole numbers, which have no order.
        """
        drives = self._drives & self._may
        chunk, scale = self._chunk[drives], self.base.links.spacing[drives].double()[:, None]
        many = torch.bincount(chunk, minlength=self._regions).clamp(min=1).double()[:, None]
        arms = []
        for place in (self.base.matter.rest[drives].double(), now[drives].double()):
            whole = (place / scale * _FINE).round().long()
            total = whole.new_zeros(self._regions, 3).index_add_(0, chunk, whole)
            center = total.double() / (_FINE * many)
            arms.append(place / scale - center[chunk])
        square = (arms[1][:, :, None] * arms[0][:, None] * _FINE).round().long()
        total = square.new_zeros(self._regions, 3, 3).index_add_(0, chunk, square)
        size = total.double().abs().amax(dim=(1, 2), keepdim=True).clamp(min=1.0)
        turn, _ = ops.polar_clamped((total.double() / size).contiguous(), 0.3, 2.0)
        return turn[self._chunk]

    # --- pictures ---

    def _gap(
        self, carry: Carry, points: Points, places: Tensor, owner: Tensor, rival: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Where places have gone, the map there, and how far their face has opened, 0 to 1."""
        here, blend = carry.place(places, owner, points)
        there, _ = carry.place(places, rival, points)
        edge = torch.ones(len(self._scene.bodies), device=places.device)
        for body, partition in self._partitions.items():
            edge[body] = partition.voxel
        gap = (here - there).norm(dim=1) / edge[self._body[owner]]
        return here, blend, ((gap - CLOSED) / (SHOWN - CLOSED)).clamp(0.0, 1.0)

    def _cut(self, rest: Gaussians, carry: Carry, points: Points) -> Gaussians:
        """Splats at rest, cut at faces as far as these have opened."""
        means, quats, scales = rest.means, rest.quats, rest.scales
        whole = self.base.gaussians.means
        for cuts in self._cuts:
            rows = cuts.splat
            _, _, share = self._gap(carry, points, whole[rows], carry.owner[rows], cuts.rival)
            open_ = share > 0.0
            rows, share = rows[open_], share[open_, None]
            if rows.numel() == 0:
                continue
            normal = cuts.normal[open_]
            root = geometry.quaternion_to_matrix(quats[rows]) * scales[rows, None]
            before, mean = root @ root.mT, means[rows]
            moved = ((mean - whole[rows]) * normal).sum(dim=1)
            cut, covariance = cut_at(mean, before, normal, cuts.distance[open_] - moved)
            mean = mean + share * (cut - mean)
            covariance = before + share[..., None] * (covariance - before)
            turned = ops.covariance_axes(geometry.pack_symmetric(covariance))
            means = means.index_copy(0, rows, mean)
            quats, scales = (
                old.index_copy(0, rows, new)
                for old, new in zip((quats, scales), turned, strict=True)
            )
        return rest.replace(means=means, quats=quats, scales=scales)

    def _born(self, carry: Carry, points: Points, births: Births | None) -> Births | None:
        """Face elements where faces have opened, after the births inside of pieces."""
        faces = self._faces
        assert faces is not None  # step sees to it
        means, blend, share = self._gap(carry, points, faces.means, faces.owner, faces.rival)
        rows = (share > 0.0).nonzero()[:, 0]
        if rows.numel() == 0:
            return births
        turn, _ = ops.polar_clamped(blend[rows].contiguous(), 0.3, 2.0)
        quats, scales = ops.carry_axes(faces.quats[rows], faces.scales[rows], turn, turn, rigid=0.0)
        gaussians = Gaussians(
            means=means[rows],
            quats=quats,
            scales=scales,
            opacities=OPACITY * share[rows],
            sh=geometry.rgb_to_sh0(faces.color[rows])[:, None],
            labels=torch.full_like(rows, TRANSITION, dtype=torch.int32),
            normals=(turn * faces.normals[rows, None]).sum(dim=2),
        )
        made = Births(gaussians, _NUMBERS + faces.key[rows], faces.owner[rows])
        if births is None:
            return made
        return Births(
            Gaussians.cat([births.gaussians, made.gaussians]),
            torch.cat([births.ids, made.ids]),
            torch.cat([births.anchor, made.anchor]),
        )
