"""Gaussians ride on material points.

Each splat is bound at rest to the nearest points of its body. At a later time it moves with those
of them that are in one piece: ``m = sum_k w_k (x_k + A_k (m0 - X_k))`` with ``A_k`` the point's
total deformation, its stretches clamped so that no splat becomes a needle or a balloon; the
covariance becomes ``A S A^T`` (PhysGaussian, section 3.3, with total instead of elastic
deformation) and the colour turns with the rotation of A. A splat on a broken point follows the
nearest unbroken neighbour, so that it lies on the edge of a piece and is never strung across a gap.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from gsfluent import geometry, ops
from gsfluent.data import SURFACE, Gaussians
from gsfluent.pipeline.neighbours import nearest_rows
from gsfluent.pipeline.particles import Matter, body_frame
from gsfluent.scene import Body, Scene

NEIGHBOURS = 12
STRETCH = (0.6, 1.5)
"""Bounds of the stretch that splats show."""
RIGID = 1e-3
"""Splats that are stretched by less than this keep their shape exactly."""
CHUNK = 100_000
"""Splats that are moved at once; bounds the memory of a frame."""
REACH = 1.6
"""A splat on a broken point looks for an unbroken one within this many point spacings."""


class Points(NamedTuple):
    """Where the material points are, and what each does to the splats that ride on it.

    Attributes:
        position: Positions [m], [N, 3].
        map: Total deformation, stretches clamped; of broken points the rotation alone, since they
            deform without limit, [N, 3, 3].
        rotation: Rotation of the deformation, [N, 3, 3].
        fragments: Piece of each point, int32 [N], -1 for none.
        broken: Broken points, bool [N].
    """

    position: Tensor
    map: Tensor
    rotation: Tensor
    fragments: Tensor
    broken: Tensor

    @staticmethod
    def of(position: Tensor, deformation: Tensor, fragments: Tensor, broken: Tensor) -> Points:
        """Split total deformation gradients [N, 3, 3] into rotation and clamped stretch."""
        rotation, clamped = ops.polar_clamped(deformation, *STRETCH)
        shown = torch.where(broken[:, None, None], rotation, clamped)
        return Points(position, shown, rotation, fragments, broken)


class Motion(NamedTuple):
    """Where each splat has gone.

    Attributes:
        means: Centres [m], [M, 3].
        map: Local deformation A, stretches clamped, [M, 3, 3].
        rotation: Rotation of A, [M, 3, 3].
        anchor: Material point each splat follows, int64 [M].
        broken: Whether the splat's own (nearest) point is broken, bool [M].
        riding: Whether the splat follows an unbroken point, bool [M].
        points: The material points.
    """

    means: Tensor
    map: Tensor
    rotation: Tensor
    anchor: Tensor
    broken: Tensor
    riding: Tensor
    points: Points


class Carry:
    """The binding of splats to material points.

    Args:
        gaussians: Splats at rest in scene coordinates.
        body: Body of each splat, int64 [M].
        matter: The material points.

    Raises:
        ValueError: A splat belongs to a body that has no points.
    """

    def __init__(self, gaussians: Gaussians, body: Tensor, matter: Matter) -> None:
        self.gaussians, self.body, self.matter = gaussians, body, matter
        self.scene: Scene | None = None
        distance, self.index = near_points(gaussians.means, body, matter)
        self.distance = distance
        spacing = torch.tensor(matter.spacing, dtype=torch.float64, device=distance.device)[body]
        self.spacing = spacing
        self.weight = torch.exp(-0.5 * (distance / spacing[:, None]) ** 2).to(gaussians.means)
        # Far from all points (a stray splat) the nearest one still carries it.
        self.weight[:, 0] = self.weight[:, 0].clamp(min=1e-6)

    @staticmethod
    def bind(scene: Scene, matter: Matter) -> Carry:
        """Bind the splats of all bodies of a scene where they are at time 0."""
        parts, bodies = [], []
        device = matter.particles.device
        for number, body in enumerate(scene.bodies):
            splats = _ball_splats(body) if body.solid is None else body.solid.gaussians
            placed = splats.to(device, torch.float32).transformed(body_frame(body, scene))
            parts.append(placed)
            bodies.append(torch.full((placed.count,), number, dtype=torch.int64, device=device))
        carry = Carry(Gaussians.cat(parts), torch.cat(bodies), matter)
        carry.scene = scene
        return carry

    def motion(
        self, position: Tensor, deformation: Tensor, fragments: Tensor, broken: Tensor
    ) -> Motion:
        """Find where the splats are.

        Args:
            position: Positions of the points [m], [N, 3].
            deformation: Total deformation gradients, [N, 3, 3].
            fragments: Piece of each point, int32 [N], -1 for none.
            broken: Broken points, bool [N].

        Returns:
            The motion of each splat since time 0.
        """
        return self.follow(Points.of(position, deformation, fragments, broken))

    def follow(self, points: Points) -> Motion:
        """As :meth:`motion`, of points that are split already."""
        everything = torch.arange(self.gaussians.count, device=points.position.device)
        parts = [self._follow(rows, points) for rows in everything.split(CHUNK)]
        means, blend, turn, anchor, broken, riding = (
            torch.cat(columns) for columns in zip(*parts, strict=True)
        )
        return Motion(means, blend, turn, anchor, broken, riding, points)

    def _follow(self, rows: Tensor, points: Points) -> tuple[Tensor, ...]:
        """Columns of the motion of some splats."""
        position, stretch, _, fragments, broken = points
        index, distance = self.index[rows], self.distance[rows]
        whole = ~broken[index] & (distance <= REACH * self.spacing[rows, None])
        riding = whole.any(dim=1)
        # First unbroken neighbour, or the nearest point when all are broken.
        slot = torch.where(riding, whole.to(torch.int8).argmax(dim=1), 0)
        anchor = index.gather(1, slot[:, None])[:, 0]
        piece = fragments[anchor]
        together = whole & (fragments[index] == piece[:, None]) & (piece >= 0)[:, None]
        together.scatter_(1, slot[:, None], True)
        weight = self.weight[rows].clamp(min=1e-12) * together
        weight = weight / weight.sum(dim=1, keepdim=True)
        local = stretch[index]
        arm = self.gaussians.means[rows][:, None] - self.matter.rest[index]
        moved = position[index] + (local @ arm[..., None])[..., 0]
        means = (weight[..., None] * moved).sum(dim=1)
        blend = (weight[..., None, None] * local).sum(dim=1)
        turn, blend = ops.polar_clamped(blend.contiguous(), *STRETCH)
        return means, blend, turn, anchor, broken[index[:, 0]], riding

    def apply(self, motion: Motion) -> Gaussians:
        """Return the splats at their new places, with their new shapes and turned colours."""
        rest = self.gaussians
        turn = geometry.matrix_to_quaternion(motion.rotation)
        quats = geometry.quaternion_multiply(turn, geometry.normalize_quaternions(rest.quats))
        scales = rest.scales
        change = (motion.map - motion.rotation).abs().amax(dim=(1, 2))
        bent = (change > RIGID).nonzero()[:, 0]
        if bent.numel():
            root = motion.map[bent] @ geometry.quaternion_to_matrix(rest.quats[bent])
            root = root * rest.scales[bent, None, :]
            new_quats, new_scales = geometry.covariance_to_quats_scales(
                geometry.pack_symmetric(root @ root.mT)
            )
            quats = quats.index_copy(0, bent, new_quats)
            scales = scales.index_copy(0, bent, new_scales)
        normals = rest.normals
        if normals is not None:
            normals = (motion.rotation @ normals[..., None])[..., 0]
        return rest.replace(
            means=motion.means,
            quats=quats,
            scales=scales,
            sh=geometry.rotate_sh(rest.sh, motion.rotation),
            normals=normals,
        )

    def sample(self, values: Tensor) -> Tensor:
        """Return per-point values [N] at each splat's nearest point, [M]."""
        return values[self.index[:, 0]]


def near_points(places: Tensor, body: Tensor, matter: Matter) -> tuple[Tensor, Tensor]:
    """Nearest points of the own body of places at rest.

    Args:
        places: [M, 3], scene metres.
        body: Body of each place, int64 [M].
        matter: The material points.

    Returns:
        Distances [m], float64 [M, 12], ascending, and rows int64 [M, 12]. A body of fewer points
        repeats the nearest one at an infinite distance.
    """
    count, device = places.shape[0], places.device
    index = torch.zeros(count, NEIGHBOURS, dtype=torch.int64, device=device)
    distance = torch.zeros(count, NEIGHBOURS, dtype=torch.float64, device=device)
    for number, (a, b) in enumerate(matter.ranges):
        rows = (body == number).nonzero()[:, 0]
        if rows.numel() == 0:
            continue
        near = min(NEIGHBOURS, b - a)
        found, which = nearest_rows(
            matter.rest[a:b], places[rows], near, 1.5 * matter.spacing[number]
        )
        index[rows, :near], distance[rows, :near] = which + a, found
        index[rows, near:], distance[rows, near:] = which[:, :1] + a, math.inf
    return distance, index


def _ball_splats(body: Body) -> Gaussians:
    """Grey splats on the surface of a ball around the origin of its own coordinates.

    A jet of liquid has none: nothing on it stays where it is.
    """
    count = 0 if body.length > 0.0 else 200
    row = torch.arange(count, dtype=torch.float32) + 0.5
    height = 1.0 - 2.0 * row / count
    angle = row * (math.pi * (3.0 - math.sqrt(5.0)))
    ring = torch.sqrt(1.0 - height**2)
    direction = torch.stack([ring * angle.cos(), ring * angle.sin(), height], dim=1)
    size = torch.full((count,), 0.12 * body.radius)
    grey = torch.full((count, 3), 0.25)
    return Gaussians.from_colors(
        0.9 * body.radius * direction, size, grey, opacities=0.95, label=SURFACE
    ).replace(normals=direction)
