"""Gaussians carried by material points.

Each splat belongs to the point of its body that is nearest at rest. At a later time it moves with
that point and those of its neighbours that it still hangs together with
(:mod:`gsfluent.pipeline.matter.links`): ``m = sum_k w_k (x_k + A_k (m0 - X_k))`` with ``A_k`` the
point's total deformation, its stretches clamped so that no splat becomes a needle or a balloon; the
covariance becomes ``A S A^T`` (PhysGaussian, section 3.3, with total instead of elastic
deformation) and the colour turns with the rotation of A. What has parted is never strung across the
gap: debris flies on its own, with the rotation alone.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from gsfluent import geometry, ops
from gsfluent.data import SURFACE, Gaussians
from gsfluent.pipeline.matter.divide import divide_wide
from gsfluent.pipeline.matter.fields import breakable
from gsfluent.pipeline.matter.links import Hanging, Links
from gsfluent.pipeline.matter.points import Matter, body_frame
from gsfluent.scene.scene import Body, Scene
from gsfluent.spatial.neighbours import nearest_rows

STRETCH = (0.6, 1.5)
"""Bounds of the stretch that splats show."""
RIGID = 1e-3
"""Splats that are stretched by less than this keep their shape exactly."""
BLEND = 0.6
"""Width of the blend of neighbouring points, in point spacings."""
WIDEST = 1.0
"""Standard deviation of the widest splat that breaks as one, in point spacings."""


class Points(NamedTuple):
    """Where the material points are, and what each does to the splats it carries.

    Attributes:
        position: Positions [m], [N, 3].
        map: Total deformation, stretches clamped; of what is broken or loose the rotation alone,
            since it has no shape to keep, [N, 3, 3].
        rotation: Rotation of the deformation, [N, 3, 3].
        fragments: Piece of each point, int32 [N], -1 for none.
        broken: Broken points, bool [N].
        hanging: How they hang together; None to see it afresh.
        unit: What each moves with, its piece or its chip, int64 [N], -1 for nothing
            (:class:`gsfluent.pipeline.matter.pieces.Pieces`); None where only pieces are known.
    """

    position: Tensor
    map: Tensor
    rotation: Tensor
    fragments: Tensor
    broken: Tensor
    hanging: Hanging | None = None
    unit: Tensor | None = None

    @staticmethod
    def of(
        position: Tensor,
        deformation: Tensor,
        fragments: Tensor,
        broken: Tensor,
        unit: Tensor | None = None,
    ) -> Points:
        """Split total deformation gradients [N, 3, 3] into rotation and clamped stretch."""
        rotation, clamped = ops.polar_clamped(deformation, *STRETCH)
        shapeless = ((fragments < 0) | broken)[:, None, None]
        shown = torch.where(shapeless, rotation, clamped)
        return Points(position, shown, rotation, fragments, broken, unit=unit)


class Motion(NamedTuple):
    """Where each splat has gone.

    Attributes:
        means: Centres [m], [M, 3].
        map: Local deformation A, stretches clamped, [M, 3, 3].
        rotation: Rotation of A, [M, 3, 3].
        anchor: Material point of each splat, int64 [M].
        broken: Whether that point is broken, bool [M].
        carried: Whether that point belongs to a piece, bool [M].
        points: The material points.
    """

    means: Tensor
    map: Tensor
    rotation: Tensor
    anchor: Tensor
    broken: Tensor
    carried: Tensor
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
        self.links = Links(matter)
        self.width = BLEND * self.links.spacing
        self.owner = nearest_points(gaussians.means, body, matter)

    @staticmethod
    def bind(scene: Scene, matter: Matter) -> Carry:
        """Bind the splats of all bodies of a scene where they are at time 0.

        Of bodies that can break, splats much wider than a point are divided first.
        """
        parts, bodies = [], []
        device = matter.particles.device
        parting = breakable(matter).tolist()
        for number, body in enumerate(scene.bodies):
            splats = _ball_splats(body) if body.solid is None else body.solid.gaussians
            placed = splats.to(device, torch.float32).transformed(body_frame(body, scene))
            if parting[number]:
                placed = divide_wide(placed, WIDEST * matter.spacing[number])
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

    def follow(self, points: Points, rest: Gaussians | None = None) -> Motion:
        """As :meth:`motion`, of points that are split already.

        Args:
            points: The material points.
            rest: Splats at rest, if not those that were bound but cut ones.
        """
        if points.hanging is None:
            points = points._replace(
                hanging=self.links.look(points.position, points.fragments, broken=points.broken)
            )
        means, blend = self.place((rest or self.gaussians).means, self.owner, points)
        turn, blend = ops.polar_clamped(blend, *STRETCH)
        carried = points.fragments[self.owner] >= 0
        return Motion(means, blend, turn, self.owner, points.broken[self.owner], carried, points)

    def place(self, places: Tensor, owner: Tensor, points: Points) -> tuple[Tensor, Tensor]:
        """Where places at rest have gone.

        Args:
            places: [P, 3], scene metres.
            owner: Point of each, int64 [P].
            points: The material points, with ``hanging``.

        Returns:
            Places now [P, 3] and the map of small vectors there [P, 3, 3].
        """
        assert points.hanging is not None  # follow sees to it
        links = self.links
        count = links.near.shape[0]  # points that joined the run later carry nothing
        return ops.carry_place(
            places,
            owner,
            links.near,
            points.hanging.parted,
            links.rest,
            points.position[:count],
            points.map[:count],
            self.width,
        )

    def cells(self, owners: Tensor, points: Points) -> tuple[Tensor, Tensor, Tensor]:
        """How the matter around some points moves, to first order.

        Args:
            owners: The points, int64 [P].
            points: All material points, with ``hanging``.

        Returns:
            Where the places of the points themselves have gone [P, 3], the gradient of
            :meth:`place` there [P, 3, 3], and its rotation [P, 3, 3].
        """
        assert points.hanging is not None  # follow sees to it
        index = self.links.near[owners]
        arm = self.matter.rest[owners][:, None] - self.matter.rest[index]
        square = (BLEND * self.links.spacing[owners, None]).square()
        weight = torch.exp(-0.5 * arm.square().sum(dim=2) / square)
        weight = weight * ~points.hanging.parted[owners]
        weight = weight / weight.sum(dim=1, keepdim=True)
        local = points.map[index]
        moved = points.position[index] + (local * arm[:, :, None]).sum(dim=3)
        means = (weight[..., None] * moved).sum(dim=1)
        blend = (weight[..., None, None] * local).sum(dim=1)
        # d weight / d place: towards what weighs more
        pull = (weight[..., None] * arm).sum(dim=1, keepdim=True) - arm
        pull = (weight / square)[..., None] * pull
        bend = ((moved - means[:, None])[..., None] * pull[:, :, None]).sum(dim=1)
        return means, blend + bend, ops.polar_clamped(blend, *STRETCH)[0]

    def apply(self, motion: Motion, rest: Gaussians | None = None) -> Gaussians:
        """Return the splats at their new places, with their new shapes and turned colours.

        Args:
            motion: From :meth:`follow`.
            rest: Splats at rest, if not those that were bound but cut ones.
        """
        rest = rest or self.gaussians
        quats, scales = ops.carry_axes(
            rest.quats, rest.scales, motion.map, motion.rotation, rigid=RIGID
        )
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


def nearest_points(places: Tensor, body: Tensor, matter: Matter) -> Tensor:
    """Nearest points of the own body of places at rest.

    Args:
        places: [M, 3], scene metres.
        body: Body of each place, int64 [M].
        matter: The material points.

    Returns:
        Rows int64 [M].
    """
    owner = torch.zeros(places.shape[0], dtype=torch.int64, device=places.device)
    for number, (a, b) in enumerate(matter.ranges):
        rows = (body == number).nonzero()[:, 0]
        if rows.numel():
            found = nearest_rows(matter.rest[a:b], places[rows], 1, matter.spacing[number])[1]
            owner[rows] = found[:, 0] + a
    return owner


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
