"""The picture of a split, spread over some frames.

A split changes what splats look like at once: they go with another piece, are cut elsewhere, and
faces between points give way to those of the partition. So every splat that changes begins where it
would have been drawn without the split, carried along by its point, and goes from there to how it
is drawn now; what is no longer there goes, and what is new comes.
"""

from __future__ import annotations

import copy
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gsfluent import geometry, ops
from gsfluent.data import Gaussians
from gsfluent.pipeline.cracks.gaps import Cracks, Drawn
from gsfluent.pipeline.matter.carry import STRETCH, Carry, Points
from gsfluent.results.frames import DUST

FRAMES = 8
"""Frames in which the picture of a split comes to be where its faces stand still; the first shows
nothing of it."""
PARTS, SNAPS = 1.0, 0.25
"""Way [spacings] that new faces part in which it comes to be in any case, of what bends and of what
is stiff: what flies apart is not seen to change and must not be dragged along, and glass snaps."""
FAR = 1.5
"""Splats that change sides, or leave what is around them, do not cross what is wider than this
[spacings]: they go here and come there."""
_SAME = 1e-3  # of a spacing, or of a map: below it nothing has changed
_WHOLE = 1.0 - 1e-6  # a sum of paces
_ALIKE = 0.02  # of a spacing, of the shape, of opacities: below it nobody sees a change


class Easing(NamedTuple):
    """Splats on their way from one picture to another.

    Attributes:
        ids: Those that were drawn otherwise before, ascending, int64 [K].
        done: Part of the way that is done, [K].
        pace: Part that is done in a frame, [K].
        anchor: Point that each of them goes with, int64 [K].
        jumps: Which of them go here and come there, bool [K].
        before: How they were drawn, in coordinates of the matter at their point, [K].
        coming: Those that were not there, ascending, int64 [J].
        there: Part of the way that is done, [J].
        haste: Part that is done in a frame, [J].
    """

    ids: Tensor
    done: Tensor
    pace: Tensor
    anchor: Tensor
    jumps: Tensor
    before: Gaussians
    coming: Tensor
    there: Tensor
    haste: Tensor

    def older(self) -> Easing | None:
        """One frame later; None when all is done."""
        done, there = self.done + self.pace, self.there + self.haste
        keep, new = done < _WHOLE, there < _WHOLE
        if not bool(keep.any()) and not bool(new.any()):
            return None
        return Easing(
            self.ids[keep], done[keep], self.pace[keep], self.anchor[keep],
            self.jumps[keep], self.before.select(keep),
            self.coming[new], there[new], self.haste[new],
        )  # fmt: skip

    def state(self) -> dict[str, Any]:
        """As plain tensors."""
        own = {k: v.cpu() for k, v in self._asdict().items() if torch.is_tensor(v)}
        kept = {k: v.cpu() for k, v in vars(self.before).items() if torch.is_tensor(v)}
        return own | {"before": kept}

    @staticmethod
    def restored(state: dict[str, Any], device: torch.device) -> Easing:
        """From :meth:`state`."""
        before = Gaussians(**{k: v.to(device) for k, v in state["before"].items()})
        rest = {k: v.to(device) for k, v in state.items() if k != "before"}
        return Easing(**rest, before=before)

    def apply(self, drawn: Drawn, carry: Carry, points: Points, leaving: bool = True) -> Drawn:
        """Splats as they are on the way.

        Args:
            drawn: As they will be.
            carry: The binding.
            points: The material points.
            leaving: Whether to add those that are there no longer.
        """
        splats = drawn.gaussians
        share = self.done.to(splats.means)
        old = _placed(self.before, self.anchor, carry, points)
        rows, k = _matches(drawn.ids, self.ids)
        if rows.numel():
            splats = _between(splats, rows, old.select(k), share[k], self.jumps[k])
        rows, k = _matches(drawn.ids, self.coming)
        there = (2.0 * self.there[k].to(splats.means)).clamp(max=1.0)
        opacity = splats.opacities.index_copy(0, rows, splats.opacities[rows] * there)
        drawn = drawn._replace(gaussians=splats.replace(opacities=opacity))
        gone = (~torch.isin(self.ids, drawn.ids)).nonzero()[:, 0] if leaving else rows[:0]
        if gone.numel() == 0:
            return drawn
        last = old.select(gone)
        there = (1.5 * (1.0 - share[gone])).clamp(max=1.0).square()
        last = last.replace(opacities=last.opacities * there)
        whole = Drawn.joined([drawn, Drawn(last, self.ids[gone], self.anchor[gone])])
        assert whole is not None  # both are there
        return whole


def begun(before: Cracks, after: Cracks, easing: Easing | None) -> Easing:
    """The way from the picture without a split to that with it.

    Args:
        before: The cracks of this moment as if nothing had split.
        after: As they are.
        easing: What was on its way already, at this moment.
    """
    rows = _touched(before, after)
    if easing is not None:
        own = easing.ids[easing.ids < before.carry.gaussians.count]
        rows[own] = True
    rows = rows.nonzero()[:, 0]
    old, new = (_drawn(cracks, rows) for cracks in (before, after))
    if easing is not None:
        old = easing.apply(old, before.carry, before.points, leaving=False)
    first, second = _matches(old.ids, new.ids.sort()[0])[0], _matches(new.ids, old.ids.sort()[0])[0]
    # of the splats that are in both, in the order of their numbers
    first = first[old.ids[first].argsort()]
    second = second[new.ids[second].argsort()]
    edge = after.carry.links.spacing[new.anchor[second]]
    moved = _differs(old.gaussians.select(first), new.gaussians.select(second), edge)
    lone = ~torch.isin(old.ids, new.ids) & (old.gaussians.opacities > 0.0)
    lone = lone.nonzero()[:, 0]
    which = torch.cat([first[moved], lone])
    anchor = torch.cat([new.anchor[second[moved]], old.anchor[lone]])
    way = old.gaussians.means[first] - new.gaussians.means[second]
    jumps = way.norm(dim=1) > FAR * edge
    jumps &= (old.anchor[first] != new.anchor[second]) | _alone(before, after)[new.anchor[second]]
    jumps = torch.cat([jumps[moved], torch.zeros_like(lone, dtype=torch.bool)])
    was = old.gaussians.select(which)
    was = was.replace(sh=was.sh[:, :1])
    held = _held(was, anchor, after.carry, after.points)
    ids, coming = old.ids[which], new.ids[~torch.isin(new.ids, old.ids)]
    begin = after.parting
    step = begin + 1.0 / FRAMES
    each = [was.means.new_full((len(n),), v) for n in (ids, coming) for v in (begin, step)]
    done, pace, there, haste = each
    if easing is not None:
        go_on = ~torch.isin(easing.ids, torch.cat([old.ids, new.ids]))
        ids, done, pace, anchor, jumps = (
            torch.cat([mine, theirs[go_on]])
            for mine, theirs in zip((ids, done, pace, anchor, jumps), easing[:5], strict=True)
        )
        held = Gaussians.cat([held, easing.before.select(go_on)])
    order, sort = ids.argsort(), coming.argsort()
    return Easing(
        ids[order], done[order], pace[order], anchor[order], jumps[order], held.select(order),
        coming[sort], there[sort], haste[sort],
    )  # fmt: skip


def _touched(before: Cracks, after: Cracks) -> Tensor:
    """Bound splats that may be drawn otherwise, bool [M]."""
    one, two = before.carry, after.carry
    count = one.links.near.shape[0]
    way = (before.points.position[:count] - after.points.position[:count]).norm(dim=1)
    moved = way > _SAME * one.links.spacing
    turned = (before.points.map[:count] - after.points.map[:count]).abs().amax(dim=(1, 2))
    moved |= turned > _SAME
    moved |= (one.links.near != two.links.near).any(dim=1)
    for links in (one.links, two.links):
        moved = moved | moved[links.near].any(dim=1)
    hanging = (before.points.hanging, after.points.hanging)
    assert hanging[0] is not None and hanging[1] is not None  # step puts it there
    moved |= (hanging[0].parted != hanging[1].parted).any(dim=1)
    rows = moved[one.owner] | moved[two.owner] | (one.owner != two.owner)
    for name in ("means", "scales", "quats", "opacities"):
        a, b = getattr(before.rest, name), getattr(after.rest, name)
        if a is not b:
            rows = rows | (a != b).view(len(rows), -1).any(dim=1)
    return rows


def _alone(before: Cracks, after: Cracks) -> Tensor:
    """Points that are shown elsewhere than before and leave those around them, bool [N]."""
    links = after.carry.links
    count = links.near.shape[0]
    way = after.points.position[:count] - before.points.position[:count]
    around = way[links.near].median(dim=1).values
    return (way - around).norm(dim=1) > 0.5 * FAR * links.spacing


def _drawn(cracks: Cracks, rows: Tensor) -> Drawn:
    """Some of the bound splats, and all births but dust, as they are drawn."""
    carry, rest = copy.copy(cracks.carry), cracks.rest.select(rows)
    carry.owner = carry.owner[rows]
    splats = carry.apply(carry.follow(cracks.points, rest), rest)
    parts = [Drawn(splats, rows, carry.owner)]
    if cracks.births is not None:
        stays = cracks.births.ids < DUST  # dust comes by degrees of its own
        born, *names = cracks.births
        parts.append(Drawn(born.select(stays), *(name[stays] for name in names)))
    whole = Drawn.joined(parts)
    assert whole is not None  # the first is there
    return whole


def _matches(ids: Tensor, wanted: Tensor) -> tuple[Tensor, Tensor]:
    """Rows of the numbers that are among some ascending ones, and where these stand there."""
    if wanted.numel() == 0:
        return ids[:0], ids[:0]
    place = torch.searchsorted(wanted, ids.contiguous()).clamp(max=len(wanted) - 1)
    rows = (wanted[place] == ids).nonzero()[:, 0]
    return rows, place[rows]


def _frames(anchor: Tensor, carry: Carry, points: Points) -> tuple[Tensor, Tensor]:
    """Where points are drawn [K, 3], and how the matter there has turned [K, 3, 3]."""
    place, blend = carry.place(carry.matter.rest[anchor], anchor, points)
    return place, ops.polar_clamped(blend.contiguous(), *STRETCH)[0]


def _held(splats: Gaussians, anchor: Tensor, carry: Carry, points: Points) -> Gaussians:
    """Splats in coordinates of the matter at their points."""
    place, turn = _frames(anchor, carry, points)
    return _turned(splats, turn.mT, splats.means - place)


def _placed(splats: Gaussians, anchor: Tensor, carry: Carry, points: Points) -> Gaussians:
    """The other way round."""
    place, turn = _frames(anchor, carry, points)
    made = _turned(splats, turn, splats.means)
    return made.replace(means=made.means + place)


def _turned(splats: Gaussians, turn: Tensor, means: Tensor) -> Gaussians:
    normals = splats.normals
    return splats.replace(
        means=(turn @ means[..., None])[..., 0],
        quats=geometry.quaternion_multiply(geometry.matrix_to_quaternion(turn), splats.quats),
        normals=None if normals is None else (turn @ normals[..., None])[..., 0],
    )


def _between(
    splats: Gaussians, rows: Tensor, old: Gaussians, share: Tensor, jumps: Tensor
) -> Gaussians:
    """Some splats part of the way from how they were drawn.

    Args:
        splats: As they will be, [M].
        rows: Which are on the way, int64 [R].
        old: How these were, [R].
        share: Part of the way that is done, [R].
        jumps: Which go and come rather than move, bool [R].
    """
    new = splats.select(rows)
    done = torch.where(jumps, (share >= 0.5).to(share), share)[:, None]
    quats, scales = ops.covariance_axes(torch.lerp(old.covariances(), new.covariances(), done))
    opacity = torch.lerp(old.opacities, new.opacities, done[:, 0])
    opacity = opacity * torch.where(jumps, (1.0 - 2.0 * share).abs(), 1.0)
    parts = {
        "means": torch.lerp(old.means, new.means, done),
        "quats": quats,
        "scales": scales,
        "opacities": opacity,
    }
    if new.normals is not None and old.normals is not None:
        normals = torch.lerp(old.normals, new.normals, done)
        parts["normals"] = torch.nn.functional.normalize(normals, dim=1)
    whole = vars(splats)
    return splats.replace(**{k: whole[k].index_copy(0, rows, v) for k, v in parts.items()})


def _differs(old: Gaussians, new: Gaussians, edge: Tensor) -> Tensor:
    """Whether anybody may see a change, bool [R]; ``edge``: spacing of their points [m], [R]."""
    changed = (old.means - new.means).norm(dim=1) > _ALIKE * edge
    changed |= (old.opacities - new.opacities).abs() > _ALIKE
    one, two = old.covariances(), new.covariances()
    changed |= (one - two).abs().amax(dim=1) > _ALIKE * two.abs().amax(dim=1)
    if old.normals is not None and new.normals is not None:
        changed |= (old.normals - new.normals).norm(dim=1) > _ALIKE
    return changed
