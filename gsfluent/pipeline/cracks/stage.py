"""Repair of cracks: splats that give both sides of a crack a face.

Three ways, see docs/theory/cracks.md and docs/theory/partition.md:

* ``chunks`` (the default) cuts pieces from the rest solid by a smooth partition and puts fine,
  flat splats on its faces (:mod:`gsfluent.pipeline.cracks.chunks`); inside of a piece it does as
  ``gap``;
* ``gap`` puts fine, flat splats with the colour of the matter on the faces that open
  (:mod:`gsfluent.pipeline.cracks.faces`);
* ``mvee`` adds transition splats shaped as the overlap of broken splats and their unbroken
  neighbours, as the Fracture-GS notes describe it (:mod:`gsfluent.pipeline.cracks.mvee`).
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gsfluent.data import Gaussians
from gsfluent.errors import InputError
from gsfluent.pipeline.cracks.chunks import Chunks
from gsfluent.pipeline.cracks.ease import Easing, begun
from gsfluent.pipeline.cracks.gaps import Cracks, Drawn, Gaps
from gsfluent.pipeline.cracks.mvee import CROSS_RADIUS, NEIGHBOUR_RADIUS, CrackGraph, transitions
from gsfluent.pipeline.liquid.parts import LiquidParts
from gsfluent.pipeline.matter.carry import Carry, Motion, Points
from gsfluent.pipeline.stage import Stage
from gsfluent.results.partition import SavedPartition

METHODS = ("chunks", "gap", "mvee", "none")


class Repaired(NamedTuple):
    """Splats with transition splats at the end.

    Attributes:
        gaussians: The carried splats, then the transition splats.
        groups: Sibling group of each splat, int32 [M + T]; -1 for splats without siblings.
        added: Number T of transition splats.
        ids: Number of each splat that it keeps as long as it lives, int64 [M + T]: the row of a
            carried splat, M and more for transition splats.
        anchor: Material point each splat follows, int64 [M + T].
    """

    gaussians: Gaussians
    groups: Tensor
    added: int
    ids: Tensor
    anchor: Tensor

    @property
    def report(self) -> dict[str, Any]:
        """How many splats there are, and how many of them were added."""
        return {"splats": self.gaussians.count, "transition_splats": self.added}

    @classmethod
    def none(cls, carried: Gaussians, anchor: Tensor) -> Repaired:
        """Carried splats to which nothing was added."""
        rows = torch.arange(carried.count, device=carried.device)
        return cls(carried, torch.full_like(rows, -1, dtype=torch.int32), 0, rows, anchor)


class Repair(Stage):
    """Adds splats along cracks.

    Args:
        method: ``chunks``, ``gap``, ``mvee`` or ``none``.
        radius: Size of the ellipsoids that are intersected, in standard deviations (``mvee``).
        neighbour_radius: Largest distance of neighbours, in mean splat spacings (``mvee``).
        seed: Not used; repair is deterministic.

    Raises:
        InputError: An unknown method.
    """

    name = "repair"

    def __init__(
        self,
        method: str = "chunks",
        *,
        radius: float = CROSS_RADIUS,
        neighbour_radius: float = NEIGHBOUR_RADIUS,
        seed: int = 0,
    ) -> None:
        super().__init__(seed=seed)
        if method not in METHODS:
            raise InputError(
                f"repair: unknown method {method!r}", hint=f"known: {', '.join(METHODS)}"
            )
        self.method = method
        self.radius = radius
        self.neighbour_radius = neighbour_radius

    def begin(self, carry: Carry) -> CrackHistory:
        """Begin a run with the splats of a binding.

        Raises:
            InputError: The binding knows no scene (methods ``chunks`` and ``gap``).
        """
        return CrackHistory(self, carry)

    def forward(
        self,
        carry: Carry,
        motion: Motion,
        carried: Gaussians | None = None,
        *,
        history: CrackHistory | None = None,
        cracks: Cracks | None = None,
    ) -> Repaired:
        """Repair the splats of one moment.

        Args:
            carry: The binding of the splats.
            motion: Their motion.
            carried: The carried splats, when they are at hand (not with ``mvee``: the cut ones).
            history: The run this moment belongs to; without it the moment stands alone.
            cracks: What its :meth:`CrackHistory.step` returned for this moment; without it the step
                is made here.

        Returns:
            All splats, sibling groups, and how many were added.

        Raises:
            InputError: As :meth:`begin`.
        """
        history = self.begin(carry) if history is None else history
        if cracks is None and self.method in ("chunks", "gap"):
            cracks, carried = history.step(motion.points), None
            assert cracks is not None  # of these methods
            motion = cracks.carry.follow(cracks.points, cracks.rest)
        if cracks is not None:
            moved = cracks.carry.apply(motion, cracks.rest) if carried is None else carried
            return _with_births(moved, motion, cracks)
        moved = carry.apply(motion) if carried is None else carried
        if self.method == "none":
            return Repaired.none(moved, motion.anchor)
        made = transitions(history.graph, motion, moved)
        if made is None:
            return Repaired.none(moved, motion.anchor)
        added, parent, side = made
        groups = torch.full((moved.count,), -1, dtype=torch.int32, device=moved.device)
        groups[parent] = parent.to(torch.int32)
        groups = torch.cat([groups, parent.to(torch.int32)])
        # a pair of splats names its transition splat for good, in whatever order they are born
        ids = torch.arange(moved.count, device=moved.device)
        ids = torch.cat([ids, moved.count * (parent + 1) + side])
        anchor = torch.cat([motion.anchor, motion.anchor[side]])
        return Repaired(Gaussians.cat([moved, added]), groups, parent.numel(), ids, anchor)


class CrackHistory:
    """The cracks of one run, frame by frame (:meth:`Repair.begin`)."""

    def __init__(self, repair: Repair, carry: Carry) -> None:
        self.repair, self.carry = repair, carry
        self._gaps: Chunks | Gaps | None = None
        self._easing: Easing | None = None
        if repair.method in ("chunks", "gap"):
            self._gaps = Chunks(carry) if repair.method == "chunks" else Gaps(carry)

    @functools.cached_property
    def graph(self) -> CrackGraph:
        """Neighbours of the splats at rest (method ``mvee``)."""
        return CrackGraph(self.carry, self.repair.radius, self.repair.neighbour_radius)

    @functools.cached_property
    def liquid(self) -> LiquidParts | None:
        """What of the solids is liquid from the start; None without any."""
        return LiquidParts.of(self.carry)

    def step(self, points: Points) -> Cracks | None:
        """Go on to the next frame (``chunks``, ``gap``): call once per frame, in their order.

        What was open before decides with what is open now, so that nothing flickers.

        Args:
            points: Where the material points are.

        Returns:
            The cracks; None with the other methods.
        """
        if self._gaps is None:
            return None
        cracks = self._gaps.step(points)
        easing = None if self._easing is None else self._easing.older()
        if cracks.unsplit is not None:
            easing = begun(cracks.unsplit, cracks, easing)
        self._easing = easing
        return cracks._replace(unsplit=None, ease=None if easing is None else easing.apply)

    def state(self) -> dict[str, Any]:
        """What a resumed run needs besides the points: plain tensors."""
        if self._gaps is None:
            return {}
        state = self._gaps.state()
        return state if self._easing is None else state | {"easing": self._easing.state()}

    def partition(self) -> SavedPartition | None:
        """How the solids are split so far (``chunks``); None with the other methods."""
        return self._gaps.partition() if isinstance(self._gaps, Chunks) else None

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from :meth:`state`; from nothing for an empty one."""
        if self._gaps is not None:
            self._gaps.restore(state)
        device = self.carry.gaussians.device
        eased = state.get("easing")
        self._easing = None if eased is None else Easing.restored(eased, device)


def _with_births(moved: Gaussians, motion: Motion, cracks: Cracks) -> Repaired:
    births = cracks.births
    if births is None and cracks.ease is None:
        return Repaired.none(moved, motion.anchor)
    rows = torch.arange(moved.count, device=moved.device)
    drawn = Drawn.joined([Drawn(moved, rows, motion.anchor), births])
    assert drawn is not None  # the first is there
    if cracks.ease is not None:
        drawn = cracks.ease(drawn, cracks.carry, motion.points)
    groups = torch.full_like(drawn.ids, -1, dtype=torch.int32)
    return Repaired(drawn.gaussians, groups, len(groups) - moved.count, drawn.ids, drawn.anchor)
