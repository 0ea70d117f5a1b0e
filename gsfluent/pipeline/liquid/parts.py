"""Liquids inside solids, an egg's white: drawn as liquids once nothing holds them.

Splats that were bound to matter at rest are strung out by what flows. So where a part of a solid is
a liquid, its splats give their colours to its points and are gone; the points are drawn by the
sheet (:mod:`gsfluent.pipeline.liquid.sheet`), as a poured liquid is.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gsfluent.data import INTERIOR, Gaussians, Particles
from gsfluent.pipeline.liquid.sheet import ellipsoids
from gsfluent.pipeline.matter.carry import Carry
from gsfluent.spatial.neighbours import nearest_rows

_OPAQUE = 0.95


@dataclass(frozen=True, eq=False)
class LiquidParts:
    """The points of solids that are liquid from the start.

    Args:
        rows: Which points, int64 [M], ascending.
        colors: Of each, [M, 3].
        bodies: Numbers of their bodies.
    """

    rows: Tensor
    colors: Tensor
    bodies: tuple[int, ...]

    @staticmethod
    def of(carry: Carry) -> LiquidParts | None:
        """The liquid parts of what splats are bound to; None without any.

        A point has the mean colour of its splats; one without splats that of the nearest with some.
        """
        matter, scene = carry.matter, carry.scene
        body = matter.particles.body.long()
        solid = [] if scene is None else [b.solid is not None for b in scene.bodies]
        if not any(solid):
            return None
        flows = matter.of_law("fluid") & torch.tensor(solid, device=body.device)[body]
        rows = flows.nonzero()[:, 0]
        if rows.numel() == 0:
            return None
        owner = carry.owner
        mine = flows[owner].nonzero()[:, 0]
        paint = carry.gaussians.select(mine).colors().double()
        total = paint.new_zeros(len(flows), 4)
        told = torch.cat([paint, torch.ones_like(paint[:, :1])], dim=1)
        total = total.cpu().index_add(0, owner[mine].cpu(), told.cpu()).to(paint)
        known = (total[rows, 3] > 0).nonzero()[:, 0]
        colors = paint.new_full((len(rows), 3), 0.5)
        if known.numel():
            places = matter.rest[rows]
            cell = 2.0 * float(max(matter.spacing))
            _, near = nearest_rows(places[known], places, 1, cell)
            from_ = rows[known[near[:, 0]]]
            colors = total[from_, :3] / total[from_, 3:]
        numbers = tuple(torch.unique(body[rows]).tolist())
        return LiquidParts(rows, colors.float().clamp(0.0, 1.0), numbers)

    def holds(self, anchor: Tensor) -> Tensor:
        """Splats that follow these points, bool as ``anchor`` (-1 for none)."""
        return torch.isin(anchor.long(), self.rows)

    def splats(self, particles: Particles) -> Gaussians:
        """One splat for each of :attr:`rows`, as the points are now: bodies follow each other."""
        made = []
        body = particles.body[self.rows]
        for number in self.bodies:
            here = (body == number).nonzero()[:, 0]
            points = self.rows[here]
            drawn = ellipsoids(particles.position[points], particles.volume[points])
            splats = Gaussians.from_colors(
                drawn.means, drawn.scales, self.colors[here].to(drawn.means), opacities=_OPAQUE,
                label=INTERIOR,
            )  # fmt: skip
            made.append(splats.replace(quats=drawn.quats))
        return Gaussians.cat(made)
