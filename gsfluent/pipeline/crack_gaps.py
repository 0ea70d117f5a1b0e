"""The gaps of a running simulation: which face elements show, frame by frame.

Two things are remembered, both per run: the points that have ever come loose from a neighbour, and
the elements that show. An element starts to show when its gap opens beyond one width and stops when
it has closed below a smaller one, so that nothing toggles; in between its opacity follows the
width, so that nothing pops. Both are part of a saved run (:meth:`Gaps.state`).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from gsfluent import geometry
from gsfluent.data import TRANSITION, Gaussians
from gsfluent.errors import InputError
from gsfluent.pipeline.carry import Carry, Points
from gsfluent.pipeline.crack_faces import Elements, find_elements
from gsfluent.pipeline.crack_sites import Sites
from gsfluent.pipeline.neighbours import nearest_rows

OPEN, CLOSED = 0.10, 0.05
"""Openings at which an element starts and stops showing, in spacings of the material points."""
FULL = 0.30
"""Opening from which it is as opaque as it gets, in spacings."""
OPACITY = 0.98
LOOSE = 0.08
"""Change of the distance of two neighbours that makes both loose, in spacings."""
NEAR = 8
"""Neighbours of a point that are watched."""
CHUNK = 100_000
"""Sites whose elements are found at once; bounds memory."""


class Births(NamedTuple):
    """Splats born on crack faces, at one moment.

    Attributes:
        gaussians: Label TRANSITION, with normals, [T].
        ids: Number of each, the same as long as it lives and when it comes back, int64 [T].
        anchor: Material point that each follows, int64 [T].
    """

    gaussians: Gaussians
    ids: Tensor
    anchor: Tensor


class Gaps:
    """Watches the gaps of one run.

    Args:
        carry: The binding of the splats; it must know its scene (:meth:`Carry.bind`).

    Raises:
        InputError: It does not.
    """

    def __init__(self, carry: Carry) -> None:
        if carry.scene is None:
            raise InputError(
                "repair: the binding knows no scene, so there is no colour for crack faces",
                mend="bind with Carry.bind(scene, matter), or use Repair(method='mvee')",
            )
        self.carry = carry
        matter = carry.matter
        count, device = matter.particles.count, matter.particles.device
        self.loose = torch.zeros(count, dtype=torch.bool, device=device)
        self._broken = self.loose.clone()
        self._shown = torch.zeros(0, dtype=torch.int64, device=device)
        self._sites: Sites | None = None
        self._elements: Elements | None = None
        self._alive = torch.zeros(0, dtype=torch.bool, device=device)
        self._spacing = torch.zeros(count, device=device)
        self._near = torch.zeros(count, NEAR, dtype=torch.int64, device=device)
        for (a, b), spacing in zip(matter.ranges, matter.spacing, strict=True):
            self._spacing[a:b] = spacing
            k = min(NEAR + 1, b - a)
            found = nearest_rows(matter.rest[a:b], matter.rest[a:b], k, 1.5 * spacing)[1] + a
            self._near[a:b] = found[:, -1:]
            self._near[a:b, : k - 1] = found[:, 1:]
        rest = matter.rest
        self._apart = (rest[self._near] - rest[:, None]).norm(dim=2)

    def step(self, points: Points) -> Births | None:
        """Go on to the next frame.

        Args:
            points: Where the material points are now; points that joined the run later, to which no
                splat is bound, come last.

        Returns:
            The splats on the faces that are open; None when there is none.
        """
        count = self.loose.shape[0]
        if points.broken.shape[0] > count:
            points = Points(*(value[:count] for value in points))
        self._watch(points)
        if self._elements is None or self._elements.count == 0:
            return None
        elements = self._elements
        gap = _opening(elements, self.carry.matter.rest, points)
        spacing = self._spacing[elements.anchor]
        alive = gap > torch.where(self._alive, CLOSED, OPEN) * spacing
        self._alive = alive
        rows = alive.nonzero()[:, 0]
        if rows.numel() == 0:
            return None
        shown = elements.select(rows)
        share = gap[rows] / spacing[rows]
        opacity = OPACITY * ((share - CLOSED) / (FULL - CLOSED)).clamp(0.0, 1.0)
        return _births(shown, opacity, self.carry, points)

    def _watch(self, points: Points) -> None:
        """Find the points that came loose or broke, and the elements around them."""
        now = (points.position[self._near] - points.position[:, None]).norm(dim=2)
        moved = (now - self._apart).abs().amax(dim=1)
        loose = self.loose | points.broken | (moved > LOOSE * self._spacing)
        changed = (loose != self.loose) | (points.broken != self._broken)
        if self._elements is None:
            changed |= loose  # after a resume
        if not bool(changed.any()):
            return
        self.loose, self._broken = loose, points.broken
        if self._sites is None:
            assert self.carry.scene is not None  # __init__ checks it
            self._sites = Sites.of(self.carry.scene, self.carry.matter)
        stale = changed[self._sites.index].any(dim=1)
        parts = (
            [] if self._elements is None else [self._elements.select(~stale[self._elements.site])]
        )
        shown = self._keys()
        rest = self.carry.matter.rest
        for rows in stale.nonzero()[:, 0].split(CHUNK):
            parts.append(find_elements(self._sites, rows, rest, points.broken, loose))
        if not parts:
            return
        self._elements = Elements.sorted(parts)
        self._alive = torch.isin(self._elements.key, shown)
        self._shown = shown[:0]

    def _keys(self) -> Tensor:
        """Keys of the elements that show, int64, ascending."""
        if self._elements is None:
            return self._shown
        return self._elements.key[self._alive]

    def state(self) -> dict[str, Any]:
        """What a later run needs to go on from here: two tensors."""
        return {"loose": self.loose.nonzero()[:, 0].cpu(), "shown": self._keys().cpu()}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from :meth:`state` of another run of the same scene; from nothing when empty."""
        self.loose, self._broken = torch.zeros_like(self.loose), torch.zeros_like(self.loose)
        self._elements = None
        self._shown = torch.zeros(0, dtype=torch.int64, device=self.loose.device)
        if state:
            self.loose[state["loose"].to(self.loose.device)] = True
            self._shown = state["shown"].to(self.loose.device)


def _turned(matrices: Tensor, vectors: Tensor) -> Tensor:
    """Products of matrices [E, 3, 3] and vectors [E, 3]; faster than a batch of tiny gemms."""
    return (matrices * vectors[:, None]).sum(dim=2)


def _opening(elements: Elements, rest: Tensor, points: Points) -> Tensor:
    """Distance [m] between where anchor and rival take each element, [E]."""
    a, r, m = elements.anchor, elements.rival, elements.means
    mine = points.position[a] + _turned(points.map[a], m - rest[a])
    theirs = points.position[r] + _turned(points.map[r], m - rest[r])
    return (mine - theirs).norm(dim=1)


def _births(shown: Elements, opacity: Tensor, carry: Carry, points: Points) -> Births:
    """Elements as splats, where their anchors are now."""
    a = shown.anchor
    rest = carry.matter.rest
    means = points.position[a] + _turned(points.map[a], shown.means - rest[a])
    turn = points.rotation[a]
    quats = geometry.quaternion_multiply(geometry.matrix_to_quaternion(turn), shown.quats)
    gaussians = Gaussians(
        means=means,
        quats=quats,
        scales=shown.scales,
        opacities=opacity,
        sh=geometry.rgb_to_sh0(shown.color)[:, None],
        labels=torch.full_like(a, TRANSITION, dtype=torch.int32),
        normals=_turned(turn, shown.normals),
    )
    return Births(gaussians, carry.gaussians.count + shown.key, a)
