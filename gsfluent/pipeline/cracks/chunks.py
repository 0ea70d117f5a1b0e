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
import functools
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from gsfluent import geometry, ops
from gsfluent.data import TRANSITION, Gaussians, Solid
from gsfluent.errors import InputError
from gsfluent.pipeline.cracks.chunk_faces import (
    ChunkCuts,
    ChunkFaces,
    colors_at,
    find_cuts,
    find_faces,
    wide_cuts,
)
from gsfluent.pipeline.cracks.cuts import cut_in_part
from gsfluent.pipeline.cracks.dust import Dust
from gsfluent.pipeline.cracks.ease import PARTS, SNAPS
from gsfluent.pipeline.cracks.followers import (
    WIDE,
    Followers,
    Lent,
    chips,
    held,
    motions,
    neighbours,
    parted,
)
from gsfluent.pipeline.cracks.gaps import Births, Cracks, Gaps
from gsfluent.pipeline.cracks.torn import Shares, Sides, Torn, flows_at
from gsfluent.pipeline.matter.carry import BLEND, Carry, Points
from gsfluent.pipeline.matter.fragments import components
from gsfluent.pipeline.matter.pieces import stiff
from gsfluent.pipeline.matter.points import body_frame
from gsfluent.pipeline.partition.roughness import amplitude, relief
from gsfluent.pipeline.partition.splits import Split, Splits
from gsfluent.pipeline.partition.tree import Partition
from gsfluent.results.partition import SavedBody, SavedPartition, SavedSplit
from gsfluent.spatial.neighbours import nearest_rows

OPACITY = 0.97
"""Opacity of a face element where the gap is wide."""
CLOSED, SHOWN = 0.1, 0.3
"""Gaps [voxels] up to which nothing shows, and from which on cuts and faces are all there."""
FIRM = 5
"""Of its neighbours at rest so many must hang together with a point, or it is crumb."""
STRAY, BAND = 1.0, 4.0
"""A broken point this many spacings from where unbroken ones of its chunk carry its place is crumb
as well; asked of points that lay so many spacings from those, the width of a crack band."""
FAR = 4.0
"""A splat does not go to a part whose points are all farther away than this [spacings]."""
LUMP = 64
"""Points of one piece that hang together, below which they are crumbs as well."""
_NUMBERS = 1 << 54  # ids of face elements begin here, beyond those of births


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
        never_bends = torch.tensor([stiff(b.material) for b in self._scene.bodies])
        self._stiff = never_bends.to(self._body.device)[self._body] & self._may
        self.restore({})

    # --- a run that is taken up again ---

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from :meth:`state` of another run of the same scene; from nothing when empty."""
        device = self._body.device
        self._partitions: dict[int, Partition] = {}
        self._solids: dict[int, Solid] = {}
        self._events: list[dict[str, Any]] = []
        self._regions, self._steps = len(self._scene.bodies), 0
        self._chunk = self._body.clone()
        self._drives = torch.ones_like(self._may)
        self._crumb = torch.zeros_like(self._may)
        # points that are dust, and for each splat of such matter which of them takes it away
        self._dust = Dust(self._scene, self.base.matter)
        self._gone = torch.zeros_like(self._may)
        self._ash = torch.full_like(self.base.owner, -1)
        self._follow: Followers | None = None
        self._unbroken: Followers | None = None
        self._unit: Tensor | None = None
        self._last: Tensor | None = None
        self._faces: ChunkFaces | None = None
        self._cuts: list[ChunkCuts] = []
        self._region = self.base.body.clone()
        self._owner = self.base.owner
        self._links = self.base.links
        self._lent = Lent(self._owner[:0], self._owner[:0])
        torn: list[Torn] = []
        for event in state.get("splits", ()):
            step = int(event.get("frame", 0))
            known = {part.region for part in torn}
            alike = step == self._steps and int(event["region"]) not in known
            if not alike or int(event["region"]) >= self._regions:
                self._divide(torn)
                torn, self._steps = [], step
            rows, rank = event["rows"].to(device), event["rank"].to(device).long()
            pieces, dust = int(rank.max()) + 1, int(event.get("dust", -1))
            torn.append(Torn(int(event["region"]), rows, rank, pieces, dust))
        self._divide(torn)
        self._steps = int(state.get("steps", 0))
        if state:
            self._crumb[state["crumbs"].to(device)] = True
            if "idle" in state:
                self._drives[state["idle"].to(device)] = False
            last = state.get("last")
            self._last = None if last is None else last.to(device)
            if "dust" in state:
                self._dust.resume(state["dust"])
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
            "idle": (~self._drives).nonzero()[:, 0].cpu(),
            "last": None if self._last is None else self._last.cpu(),
            "gaps": self._gaps.state(),
            "dust": self._dust.state(),
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
                SavedSplit(e["region"], e["frame"], e["rows"], e["rank"], e["dust"])
                for e in self._events
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
        unit, unsplit, parting = unit[:count], None, 1.0
        if self._unit is None or not torch.equal(unit, self._unit):
            self._unit = unit
            before, splits, unsplit = self._chunk, len(self._events), self._twin()
            self._look(unit)
            if self._chunk is not before:
                self._relink()
            if len(self._events) > splits and self._last is not None:
                chunks = before, self._chunk
                far = torch.where(self._stiff, SNAPS, PARTS)
                parting = parted(self.base.links, chunks, points.position, self._last, far)
        self._steps += 1
        self._last = points.position[:count].clone()
        cracks = self._cracks(points)
        if unsplit is None or not parting < 1.0:
            return cracks
        return cracks._replace(unsplit=unsplit._cracks(points), parting=parting)

    def _twin(self) -> Chunks:
        """The same, to go on from here in another way."""
        other = copy.copy(self)
        other._cuts, other._events = list(self._cuts), list(self._events)
        other._gaps, other._dust = self._gaps.twin(), self._dust.twin()
        return other

    def _cracks(self, points: Points) -> Cracks:
        """The cracks of a frame, as regions are now."""
        shown, carry = self._moved(points), self._carry(points)
        self._dust.step(points.position, shown.position)
        self._gaps.rebind(carry)
        cracks = self._gaps.step(shown)
        if not self._events:
            return cracks
        rest = self._cut(cracks.rest, carry, cracks.points)
        dust = self._dust.born(points.position)
        births = Births.joined([cracks.births, self._born(carry, cracks.points), dust])
        thrown = None if dust is None else self._dust.thrown()
        lent = carry.place(self.base.matter.rest[self._lent.rows], self._lent.owner, cracks.points)
        return Cracks(cracks.points, rest, births, carry, thrown, (self._lent.rows, lent[0]))

    # --- what belongs together ---

    def _look(self, unit: Tensor) -> None:
        """Split regions whose points belong to several pieces, and see which points drive them.

        Dust is a piece of its own: one label for all of it in a region. A chip is not divided, it
        goes with most of its points; when they are dust, with all of them.
        """
        count = unit.shape[0]
        label = torch.where(unit < 0, count, unit)
        while True:
            counted = (self._may & ~self._gone).nonzero()[:, 0]
            shares = Shares.of(self._chunk[counted], label[counted], count)
            torn = shares.parting(self._regions, len(self._scene.bodies))
            if not torn:
                break
            self._divide(shares.torn(torn, counted, self.base.matter.rest))
        chunk, piece, many = shares.chunk, shares.piece, shares.many
        # a region moves with the piece that most of its points belong to
        most = torch.zeros(self._regions, dtype=torch.int64, device=unit.device)
        most.scatter_reduce_(0, chunk, many, "amax")
        lead = torch.full_like(most, count)
        best = many == most[chunk]
        lead.scatter_reduce_(0, chunk[best], piece[best], "amin")
        theirs = lead[self._chunk]
        self._drives = ~self._may | (unit == theirs) | (theirs == count)

    def _divide(self, torn: list[Torn]) -> None:
        """Divide regions, those of a body that part into pieces at once: it costs little more."""
        together: dict[int, tuple[list[int], list[Torn]]] = {}

        def split() -> None:
            for body, (numbers, parts) in together.items():
                self._split(body, numbers, parts)
            together.clear()

        for part in torn:
            event = {"region": part.region, "rows": part.rows, "rank": part.rank.to(torch.int32)}
            self._events.append({**event, "dust": part.dust, "frame": self._steps})
            if part.pieces > 1:
                numbers, parts = together.setdefault(int(self._body[part.rows[0]]), ([], []))
                numbers.append(len(self._events) - 1)
                parts.append(part)
            else:
                split()
                self._vanish(part)
        split()

    def _vanish(self, part: Torn) -> None:
        """All points of a region have become dust: it keeps its voxels, and is led by others."""
        body, region = int(self._body[part.rows[0]]), part.region
        self._throw(body, part.rows)
        theirs = self._chunk == region
        firm = self._may & ~self._gone & (self._body == body) & ~theirs
        self._led_by(theirs.nonzero()[:, 0], firm.nonzero()[:, 0])
        sides = self._sides(body, [part], [[region]])
        self._burn((self._region == region).nonzero()[:, 0], sides)
        self._reassign(sides, self._partition(body))

    def _split(self, body: int, numbers: list[int], torn: list[Torn]) -> None:
        """Divide regions of a body by the pieces of some of their points, as so many splits."""
        matter, splats = self.base.matter, self.base.gaussians
        partition, solid = self._partition(body), self._solid(body)
        splits: list[Split] = []
        for part in torn:
            new = range(self._regions, self._regions + part.pieces - 1)
            self._regions = new.stop
            rest, ids = matter.rest[part.rows], [part.region, *new]
            splits.append(partition.split(part.region, rest, part.rank, ids, part.dust))
            self._chunk = partition.assign(
                self._chunk, splits[-1], matter.rest, part.rows, part.rank
            )
        sides = self._sides(body, torn, [split.ids for split in splits])
        self._throw(body, sides.thrown)
        # dust goes on belonging to a chunk, which leads it
        within = self._gone & (sides.of[self._chunk] >= 0)
        lone = (within | sides.ash[self._chunk]).nonzero()[:, 0]
        near = sides.firm(matter.rest[lone], self._chunk[lone])
        self._chunk = self._chunk.index_copy(0, lone, self._chunk[near])
        self._reassign(sides, partition)
        rows = sides.among(self._region)
        seen, of = Splits(splits), sides.of[self._region[rows]]
        here, cuts = find_cuts(partition, seen, splats, rows, of)
        owner, means = self._owner[rows], splats.means[rows]
        # what follows a liquid stays with it
        wrong = ((self._chunk[owner] != here) & self._may[owner]).nonzero()[:, 0]
        other = sides.own(means[wrong], here[wrong])
        # off the matter a label may be that of a part which is nowhere near
        stays = (matter.rest[other] - means[wrong]).norm(dim=1) > FAR * matter.spacing[body]
        owner[wrong[~stays]] = other[~stays]
        lost = wrong[stays]
        here[lost] = self._chunk[owner[lost]]
        cuts = ChunkCuts(*(part[~torch.isin(cuts.splat, rows[lost])] for part in cuts))
        self._region = self._region.index_copy(0, rows, here)
        self._owner = self._owner.index_copy(0, rows, owner)
        self._burn(rows[sides.ash[here]], sides)
        high = relief(self._scene.bodies[body].material.name)
        made = find_faces(partition, seen, solid, numbers, high)
        wet = flows_at(made.means, body, self._may, matter)
        made = made.select(~(sides.ash[made.region] | wet))
        cuts = wide_cuts(splats, rows, here, cuts, made, matter.spacing[body])
        cuts = ChunkCuts(*(part[~sides.ash[self._region[cuts.splat]]] for part in cuts))
        rival = sides.across(splats.means[cuts.splat], cuts.beyond)
        self._cuts.append(cuts._replace(rival=rival))
        owner, rival = sides.own(made.means, made.region), sides.across(made.means, made.beyond)
        made = dataclasses.replace(made, owner=owner, rival=rival)
        old = [] if self._faces is None else [self._faces]
        self._faces = ChunkFaces.joined([*old, made])

    def _sides(self, body: int, torn: list[Torn], ids: Sequence[Sequence[int]]) -> Sides:
        matter = self.base.matter
        return Sides(matter.rest, matter.spacing[body], self._chunk, self._regions, torn, ids)

    def _throw(self, body: int, rows: Tensor) -> None:
        """Some points of a body have become dust."""
        if rows.numel():
            self._gone = self._gone.index_fill(0, rows, True)
            colors = functools.partial(colors_at, self._partition(body), self._solid(body))
            self._dust.add(rows, colors)

    def _partition(self, body: int) -> Partition:
        """The partition of a body, made when it first comes apart."""
        if body not in self._partitions:
            a, b = self.base.matter.ranges[body]
            its = self._scene.bodies[body]
            self._partitions[body] = Partition(
                self._solid(body), body_frame(its, self._scene), self.base.matter.rest[a:b],
                self.base.matter.spacing[body], body, amplitude(its.material.name), keep=False,
            )  # fmt: skip
        return self._partitions[body]

    def _solid(self, body: int) -> Solid:
        """The solid of a body, where its points are."""
        solid = self._scene.bodies[body].solid
        assert solid is not None  # _may sees to it
        if body not in self._solids:
            self._solids[body] = solid.to(self.base.matter.rest.device)
        return self._solids[body]

    def _led_by(self, lone: Tensor, rows: Tensor) -> None:
        """Some points go on with the chunk of the nearest of some rows, where there are any."""
        if lone.numel() and rows.numel():
            rest = self.base.matter.rest
            spacing = self.base.matter.spacing[int(self._body[rows[0]])]
            near = rows[nearest_rows(rest[rows], rest[lone], 1, spacing)[1][:, 0]]
            self._chunk = self._chunk.index_copy(0, lone, self._chunk[near])

    def _burn(self, splats: Tensor, sides: Sides) -> None:
        """Splats whose matter has become dust go when that is seen to leave."""
        near = sides.burnt(self.base.gaussians.means[splats], self._region[splats])
        self._ash = self._ash.index_copy(0, splats, near)

    def _reassign(self, sides: Sides, partition: Partition) -> None:
        """Older elements of divided regions go with the part that their voxel lies in."""
        faces = self._faces
        if faces is None:
            return
        stale = sides.among(faces.region)
        now = partition.region.view(-1)[faces.voxel[stale]].long()
        owner, means = faces.owner[stale], faces.means[stale]
        wrong = (self._chunk[owner] != now).nonzero()[:, 0]
        owner[wrong] = sides.own(means[wrong], now[wrong])
        burnt = sides.ash[now].nonzero()[:, 0]
        near = sides.burnt(means[burnt], now[burnt])
        self._faces = dataclasses.replace(
            faces,
            region=faces.region.index_copy(0, stale, now),
            owner=faces.owner.index_copy(0, stale, owner),
            ash=faces.ash.index_copy(0, stale[burnt], near),
        )

    # --- motion ---

    def _relink(self) -> None:
        """Every point has neighbours of its own chunk."""
        base, chunk = self.base.links, self._chunk
        self._lent = Lent.of(self._partitions, self.base.matter, chunk, self._may & ~self._gone)
        stale = (chunk[base.near] != chunk[:, None]).any(dim=1).nonzero()[:, 0]
        if stale.numel() == 0:
            self._links = base
            return
        near, lone = base.near.clone(), torch.zeros_like(base.near, dtype=torch.bool)
        near[stale], lone[stale] = neighbours(base, chunk, stale, torch.ones_like(self._may))
        self._links = base.rewired(near, lone)

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

        Broken matter has no shape to keep: it turns with its chunk. What is stiff is never seen to
        bend, however soft it is simulated: it goes with the rigid motion of its chunk. What hangs
        on next to nothing says nothing about where the chunk is, so it is put where the firm points
        around it are.
        """
        count = self._chunk.shape[0]
        broken = points.broken[:count] & self._may
        loose = (points.fragments[:count] < 0) & self._may
        if not bool((broken | loose | self._stiff).any()):
            return points
        chunk = points.fragments.clone()
        chunk[:count] = torch.where(self._may, self._chunk.to(chunk.dtype), chunk[:count])
        position, rest, spacing = points.position, self.base.matter.rest, self.base.links.spacing
        drive = self._drives & self._may
        rigid = motions(
            self._chunk[drive], self._regions, rest[drive], position[:count][drive],
            spacing[drive], self._stiff[drive],
        )  # fmt: skip
        turn = rigid.turn[self._chunk].to(points.map)
        bodies = len(self._scene.bodies)
        small = chips(self._chunk, self._may & ~self._gone, drive, self._regions, bodies)
        chip = self._may & small[self._chunk]
        firm = drive & ~self._crumb & self._stiff
        whole = held(
            rigid, self._chunk[firm], rest[firm], position[:count][firm], spacing[firm]
        )[self._chunk].to(points.map)  # fmt: skip
        shape = torch.where(broken | loose | chip, 1.0, torch.where(self._stiff, whole, 0.0))
        moved, rotation = points.map.clone(), points.rotation.clone()
        moved[:count] = torch.lerp(moved[:count], turn, shape[:, None, None])
        rotation[:count] = torch.lerp(rotation[:count], turn, shape[:, None, None])
        self._crumb = self._crumb | self._crumbs(position, chunk, points.broken)
        self._crumb = self._crumb | self._strayed(position, moved, broken)
        position = self._led(position, moved)
        rows = (chip | self._stiff).nonzero()[:, 0]
        if rows.numel():
            place = rigid.placed(self._chunk[rows], rest[rows]).to(position)
            share = torch.where(chip[rows], 1.0, whole[rows])
            place = torch.lerp(position[rows], place, share[:, None])
            position = position.index_copy(0, rows, place)
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

    def _strayed(self, position: Tensor, moved: Tensor, broken: Tensor) -> Tensor:
        """Broken points that are no longer where the unbroken ones of their chunk are."""
        held = self._drives & ~self._crumb
        rows = (held & broken).nonzero()[:, 0]
        found = torch.zeros_like(held)
        if rows.numel() == 0:
            return found
        self._unbroken = self._following(self._unbroken, rows, held & ~broken)
        apart = (self._unbroken.placed(self._links, position, moved) - position[rows]).norm(dim=1)
        rest, spacing = self.base.links.rest, self._links.spacing[rows]
        close = (rest[self._unbroken.near[:, 0]] - rest[rows]).norm(dim=1) <= BAND * spacing
        return found.index_copy(0, rows, close & (apart > STRAY * spacing))

    def _led(self, position: Tensor, moved: Tensor) -> Tensor:
        """Positions in which crumbs, and what has left its piece, follow the firm points."""
        leads = self._drives & ~self._crumb
        rows = (self._may & ~leads).nonzero()[:, 0]
        if rows.numel() == 0:
            return position
        self._follow = self._following(self._follow, rows, leads)
        return position.index_copy(0, rows, self._follow.placed(self._links, position, moved))

    def _following(self, before: Followers | None, rows: Tensor, leads: Tensor) -> Followers:
        """The leading points around some rows; those found before if nothing has changed."""
        key = torch.stack([self._chunk, leads.long()])
        if before is not None and torch.equal(rows, before.rows) and torch.equal(key, before.key):
            return before
        return Followers(rows, *neighbours(self.base.links, self._chunk, rows, leads), key)

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
        if len(self._cuts) > 1:
            self._cuts = [ChunkCuts(*(torch.cat(part) for part in zip(*self._cuts, strict=True)))]
        for cuts in self._cuts:
            rows = cuts.splat
            _, _, share = self._gap(carry, points, whole[rows], carry.owner[rows], cuts.rival)
            share = self._opened(share, cuts.rival)
            open_ = (share > 0.0).nonzero()[:, 0]
            means, quats, scales = cut_in_part(
                (means, quats, scales), whole, rows[open_], cuts.normal[open_],
                cuts.distance[open_], share[open_],
            )  # fmt: skip
        rest = rest.replace(means=means, quats=quats, scales=scales)
        if self._dust.rows.numel() == 0:
            return rest
        left = torch.where(self._ash >= 0, 1.0 - self._dust.share(self._ash.clamp(min=0)), 1.0)
        return rest.replace(opacities=rest.opacities * left.to(rest.opacities))

    def _opened(self, share: Tensor, rival: Tensor) -> Tensor:
        """How far faces are open [E]: before dust as far as that has left."""
        if self._dust.rows.numel() == 0:
            return share
        left = self._dust.share(rival).to(share)
        return torch.where(self._gone[rival], torch.maximum(left, share), share)

    def _born(self, carry: Carry, points: Points) -> Births | None:
        """Face elements where faces have opened."""
        faces = self._faces
        if faces is None:
            return None
        means, blend, share = self._gap(carry, points, faces.means, faces.owner, faces.rival)
        share = self._opened(share, faces.rival)
        if self._dust.rows.numel():
            left = 1.0 - self._dust.share(faces.ash.clamp(min=0))
            share = torch.where(faces.ash >= 0, share * left.to(share), share)
        rows = (share > 0.0).nonzero()[:, 0]
        if rows.numel() == 0:
            return None
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
        return Births(gaussians, _NUMBERS + faces.key[rows], faces.owner[rows])
