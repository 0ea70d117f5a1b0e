"""The cracks of a running simulation: what has parted, which splats it cuts, which faces it opens.

What is remembered from frame to frame is which neighbouring points have parted
(:mod:`gsfluent.pipeline.matter.links`); everything else follows from it and is kept only because
little of it changes from one frame to the next. It is part of a saved run (:meth:`Gaps.state`).
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Self

import torch
from torch import Tensor

from gsfluent import geometry, ops
from gsfluent.data import TRANSITION, Gaussians
from gsfluent.errors import InputError
from gsfluent.pipeline.cracks.faces import DEBRIS, PIECE, Elements, Fit, find_elements
from gsfluent.pipeline.cracks.sites import Sites
from gsfluent.pipeline.matter.carry import Carry, Points
from gsfluent.pipeline.matter.links import BACK, FULL, OPEN, Hanging

OPACITY = 0.98
"""Opacity of a face element where the gap is wide."""
SLACK = 0.1
"""Standard deviations by which the cuts of splats stay outside of a crack: what is left must still
cover."""
CHUNK = 100_000
"""Sites and splats that are looked at at once; bounds memory."""


class Drawn(NamedTuple):
    """Splats of one moment.

    Attributes:
        gaussians: In scene coordinates, [M].
        ids: Number of each, none twice; the same as long as it lives and when it comes back, int64
            [M].
        anchor: Material point that each follows, int64 [M].
    """

    gaussians: Gaussians
    ids: Tensor
    anchor: Tensor

    @classmethod
    def joined(cls, parts: Sequence[Self | None]) -> Self | None:
        """All of some, in their order; None where there are none."""
        some = [part for part in parts if part is not None]
        if len(some) < 2:
            return some[0] if some else None
        gaussians = Gaussians.cat([part.gaussians for part in some])
        ids, anchor = (torch.cat(values) for values in zip(*(p[1:] for p in some), strict=True))
        return cls(gaussians, ids, anchor)


class Births(Drawn):
    """Splats born on crack faces: labels TRANSITION, with normals."""


class Cracks(NamedTuple):
    """The cracks of one moment.

    Attributes:
        points: The material points, with how they hang together.
        rest: The splats at rest, those that lie across a crack cut.
        births: Splats on open faces; None where there is none.
        carry: The binding that moves the splats.
        dust: Material points that are drawn as dust, int64 [D]; None where there are none.
        lent: Points whose matter is drawn with another piece than theirs, int64 [L], and where
            that is [m], [L, 3]; None where there are none.
        unsplit: This moment as it would be without the splits of it; None where there are none, or
            their faces part too fast for anybody to see the difference.
        parting: How much of the way from there to here is done as these have parted since the last
            moment, 0 to 1.
        ease: What puts splats on their way that were drawn otherwise before splits; None where
            there are none.
    """

    points: Points
    rest: Gaussians
    births: Births | None
    carry: Carry
    dust: Tensor | None = None
    lent: tuple[Tensor, Tensor] | None = None
    unsplit: Cracks | None = None
    parting: float = 0.0
    ease: Callable[[Drawn, Carry, Points], Drawn] | None = None


class Gaps:
    """Follows the cracks of one run.

    Args:
        carry: The binding of the splats; it must know its scene (:meth:`Carry.bind`).

    Raises:
        InputError: It does not.
    """

    def __init__(self, carry: Carry) -> None:
        if carry.scene is None:
            raise InputError(
                "repair: the binding knows no scene, so there is no colour for crack faces",
                hint="bind with Carry.bind(scene, matter), or use Repair(method='mvee')",
            )
        self.carry = carry
        self._sites: Sites | None = None
        self.restore({})

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from :meth:`state` of another run of the same scene; from nothing when empty."""
        self._before: Hanging | None = self.carry.links.restored(state) if state else None
        self._opened = torch.zeros_like(self.carry.links.near, dtype=torch.bool)
        self._debris = torch.zeros_like(self._opened[:, 0])
        self._stale = torch.zeros_like(self._debris)
        self._elements: Elements | None = None
        self._rest = self.carry.gaussians

    def state(self) -> dict[str, Any]:
        """What a later run needs to go on from here."""
        return {} if self._before is None else self._before.state()

    def twin(self) -> Gaps:
        """The same, to go on from here in another way."""
        other = copy.copy(self)
        other._stale = self._stale.clone()
        return other

    def rebind(self, carry: Carry) -> None:
        """Go on with a binding of the same splats in which some points have other neighbours."""
        before, self.carry = self.carry, carry
        if carry.links is before.links and carry.owner is before.owner:
            return
        changed = (carry.links.near != before.links.near).any(dim=1)
        self._stale |= changed
        self._stale[carry.owner[carry.owner != before.owner]] = True
        if self._before is not None:
            parted, opened = (
                flag & ~changed[:, None] for flag in (self._before.parted, self._before.opened)
            )
            self._before = self._before._replace(parted=parted, opened=opened)

    def step(self, points: Points) -> Cracks:
        """Go on to the next frame.

        Args:
            points: Where the material points are now; points that joined the run later, to which no
                splat is bound, come last.
        """
        hanging = self.carry.links.look(
            points.position, points.fragments, self._before, broken=points.broken
        )
        self._before = hanging
        points = points._replace(hanging=hanging)
        debris = points.fragments[: hanging.opened.shape[0]] < 0
        changed = (hanging.opened != self._opened).any(dim=1)
        changed |= (debris != self._debris) & hanging.opened.any(dim=1)
        # what has other neighbours now
        changed |= self._stale & (hanging.opened | self._opened).any(dim=1)
        self._stale = torch.zeros_like(self._stale)
        if bool(changed.any()):
            self._opened, self._debris = hanging.opened, debris
            self._cut(changed)
            self._open(changed)
        if self._elements is None or self._elements.count == 0:
            return Cracks(points, self._rest, None, self.carry)
        births = _births(self._elements, self.carry, points)
        return Cracks(points, self._rest, births, self.carry)

    def _cut(self, changed: Tensor) -> None:
        """Cut the splats of points [N] anew."""
        carry, links = self.carry, self.carry.links
        whole, rest = carry.gaussians, self._rest
        stale = changed[carry.owner].nonzero()[:, 0]
        shape = whole.means[stale], whole.quats[stale], whole.scales[stale]
        _, *now = ops.cut_at_cells(
            *shape, owner=carry.owner[stale], near=links.near, opened=self._opened,
            rest=links.rest, slack=SLACK,
        )  # fmt: skip
        means, quats, scales = (
            before.index_copy(0, stale, after)
            for before, after in zip((rest.means, rest.quats, rest.scales), now, strict=True)
        )
        self._rest = rest.replace(means=means, quats=quats, scales=scales)

    def _open(self, changed: Tensor) -> None:
        """Find the face elements of the sites of points [N] anew."""
        carry = self.carry
        if self._sites is None:
            assert carry.scene is not None  # __init__ checks it
            self._sites = Sites.of(carry.scene, carry.matter)
        stale = changed[self._sites.owner]
        old = self._elements
        parts = [] if old is None else [old.select(~stale[old.site])]
        debris = self._debris[self._sites.owner]
        for fit, which in ((PIECE, ~debris), (DEBRIS, debris)):
            for rows in (stale & which).nonzero()[:, 0].split(CHUNK):
                if rows.numel():
                    parts.append(self._found(rows, fit))
        self._elements = Elements.sorted(parts) if parts else None

    def _found(self, rows: Tensor, fit: Fit) -> Elements:
        """Face elements of some sites, cut where other faces begin."""
        links = self.carry.links
        assert self._sites is not None  # _open sees to it
        found = find_elements(self._sites, rows, links.rest, links.near, self._opened, fit)
        _, means, quats, scales = ops.cut_at_cells(
            found.means, found.quats, found.scales, owner=found.owner, near=links.near,
            opened=self._opened, rest=links.rest, slack=fit.slack,
        )  # fmt: skip
        return dataclasses.replace(found, means=means, quats=quats, scales=scales)


def _births(elements: Elements, carry: Carry, points: Points) -> Births:
    """Elements as splats, where their points are now."""
    assert points.hanging is not None  # step puts it there
    ratio = points.hanging.ratio.view(-1)[elements.pair]
    least = BACK * OPEN
    opacity = OPACITY * ((ratio - least) / (FULL - least)).clamp(0.0, 1.0)
    cell, slot = elements.cell, elements.slot
    center, gradient, rotation = carry.cells(cell, points)
    arm = elements.means - carry.matter.rest[elements.owner]
    means = center[slot] + (gradient[slot] * arm[:, None]).sum(dim=2)
    turn = rotation[slot]
    quats, scales = ops.carry_axes(elements.quats, elements.scales, turn, turn, rigid=0.0)
    gaussians = Gaussians(
        means=means,
        quats=quats,
        scales=scales,
        opacities=opacity,
        sh=geometry.rgb_to_sh0(elements.color)[:, None],
        labels=torch.full_like(elements.owner, TRANSITION, dtype=torch.int32),
        normals=(turn * elements.normals[:, None]).sum(dim=2),
    )
    return Births(gaussians, carry.gaussians.count + elements.key, elements.owner)
