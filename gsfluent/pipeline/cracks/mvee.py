"""Transition splats from overlaps: the repair of cracks as the Fracture-GS notes describe it.

After Fracture-GS (ICLR 2026): a splat whose point is broken gets, for the nearest unbroken splat on
either side of it, a copy shaped as the smallest ellipsoid around the overlap of the two
(:func:`gsfluent.ops.mvee_lens`). Unlike there, the overlap is taken at rest, where it exists by
construction, and the copy is then carried rigidly with the unbroken side, so that it stays when the
pieces part. The parent stays as well; parent and copies form one sibling group, of which a
rasterizer shows only the nearest per pixel.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gsfluent import geometry, ops
from gsfluent.data import INTERIOR, TRANSITION, Gaussians
from gsfluent.pipeline.matter.carry import Carry, Motion
from gsfluent.spatial.neighbours import nearest_rows

CROSS_RADIUS = 2.0
"""Ellipsoids are taken at this many standard deviations (k_sigma)."""
NEIGHBOUR_RADIUS = 2.5
"""Splats further than this many mean splat spacings are no neighbours (d_c)."""
CANDIDATES = 12


def transitions(
    graph: CrackGraph, motion: Motion, moved: Gaussians
) -> tuple[Gaussians, Tensor, Tensor] | None:
    """Transition splats of one moment.

    Args:
        graph: Neighbours and overlaps.
        motion: Where the splats are.
        moved: The carried splats.

    Returns:
        The splats [T], the rows of their parents and of the splats on whose side they lie, int64
        [T] each; None when there is none.
    """
    parent, side = graph.pairs(motion)
    if parent.numel() == 0:
        return None
    center, rest_quats, scales = graph.lenses(parent, side)
    rest = graph.carry.gaussians
    # Rigid with the unbroken side: its rotation about its own centre.
    turn = motion.rotation[side]
    means = motion.means[side] + (turn @ (center - rest.means[side])[..., None])[..., 0]
    quats = geometry.quaternion_multiply(geometry.matrix_to_quaternion(turn), rest_quats)
    added = Gaussians(
        means=means,
        quats=quats,
        scales=scales,
        opacities=rest.opacities[parent],
        sh=geometry.rotate_sh(rest.sh[parent], turn),
        labels=torch.full_like(parent, TRANSITION, dtype=torch.int32),
        normals=None if moved.normals is None else moved.normals[side],
    )
    return added, parent, side


class CrackGraph:
    """Neighbours of every splat at rest, nearest first, and the lenses computed so far.

    Args:
        carry: The binding, which holds the splats at rest.
        radius: Size of the ellipsoids, in standard deviations.
        neighbour_radius: Largest distance of neighbours, in mean splat spacings.
    """

    def __init__(self, carry: Carry, radius: float, neighbour_radius: float) -> None:
        means, body = carry.gaussians.means, carry.body
        near = torch.zeros(means.shape[0], CANDIDATES, dtype=torch.int64, device=means.device)
        usable = torch.zeros_like(near, dtype=torch.bool)
        for number in body.unique().tolist():
            rows = (body == number).nonzero()[:, 0]
            k = min(CANDIDATES + 1, rows.numel())
            if k < 2:
                continue
            cell = carry.matter.spacing[number]
            distance, which = nearest_rows(means[rows], means[rows], k, cell)
            spacing = float(distance[:, 1].median())
            # Dense fillings count their spacing over the nearest eight, as on a lattice.
            spacing = max(spacing, float(distance[:, min(8, k - 1)].median()) / 2)
            near[rows, : k - 1] = rows[which[:, 1:]]
            usable[rows, : k - 1] = distance[:, 1:] <= neighbour_radius * spacing
        device = carry.gaussians.device
        self._near, self._usable = near, usable
        self.carry, self.radius = carry, radius
        self._keys = torch.zeros(0, dtype=torch.int64, device=device)
        self._centers = carry.gaussians.means.new_zeros(0, 3)
        self._quats = carry.gaussians.means.new_zeros(0, 4)
        self._scales = carry.gaussians.means.new_zeros(0, 3)
        self._overlaps = torch.zeros(0, dtype=torch.bool, device=device)

    def pairs(self, motion: Motion) -> tuple[Tensor, Tensor]:
        """Pick, for each broken inner splat, an unbroken neighbour on each side.

        Returns:
            Rows of the parents and of the neighbours, int64 [T] each.
        """
        carry = self.carry
        inner = carry.gaussians.labels == INTERIOR
        parent = (motion.broken & inner).nonzero()[:, 0]
        if parent.numel() == 0:
            return parent, parent
        near = self._near[parent]
        usable = self._usable[parent] & ~motion.broken[near]
        first = usable.to(torch.int8).argmax(dim=1)
        has_first = usable.any(dim=1)
        rest = carry.gaussians.means
        offset = rest[near] - rest[parent][:, None]
        one = offset.gather(1, first[:, None, None].expand(-1, 1, 3))
        # The other side of the crack: neighbours in the half space away from the first.
        other = usable & ((offset * one).sum(dim=2) < 0)
        second = other.to(torch.int8).argmax(dim=1)
        has_second = other.any(dim=1)
        parents = torch.cat([parent[has_first], parent[has_second]])
        sides = torch.cat(
            [
                near.gather(1, first[:, None])[has_first, 0],
                near.gather(1, second[:, None])[has_second, 0],
            ]
        )
        overlap = self._known(parents, sides)
        return parents[overlap], sides[overlap]

    def _known(self, parent: Tensor, side: Tensor) -> Tensor:
        """Make sure the lens of each pair is known; return whether the pair overlaps, bool [T].

        A lens depends on the splats at rest only, so each pair is computed once per simulation.
        """
        count = self.carry.gaussians.count
        keys = parent * count + side
        new = keys[~torch.isin(keys, self._keys)].unique()
        if new.numel():
            i, j = new // count, new % count
            rest = self.carry.gaussians
            shapes = rest.covariances()
            center, shape, overlap = ops.mvee_lens(
                rest.means[i], shapes[i], rest.means[j], shapes[j], radius=self.radius, flat=0.15
            )
            if shape.ndim == 3:
                shape = geometry.pack_symmetric(shape)
            order = torch.argsort(torch.cat([self._keys, new]))
            self._keys = torch.cat([self._keys, new])[order]
            self._centers = torch.cat([self._centers, center])[order]
            quats, scales = ops.covariance_axes(shape)
            self._quats = torch.cat([self._quats, quats])[order]
            self._scales = torch.cat([self._scales, scales])[order]
            self._overlaps = torch.cat([self._overlaps, overlap])[order]
        return self._overlaps[torch.searchsorted(self._keys, keys)]

    def lenses(self, parent: Tensor, side: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return centres [T, 3], quaternions [T, 4] and sizes [T, 3] of known pairs, at rest."""
        slots = torch.searchsorted(self._keys, parent * self.carry.gaussians.count + side)
        return self._centers[slots], self._quats[slots], self._scales[slots]
