"""Truth for light: balls and boxes over a floor, lit by ray tracing in float64, and as splats.

Nothing here shares code with the renderer: intersections in closed form, lamps as discs of many
rays, environments summed over the whole sphere of directions.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from gsfluent.data import Camera, Gaussians
from gsfluent.geometry import matrix_to_quaternion

_GOLDEN = math.pi * (3.0 - math.sqrt(5.0))


@dataclass(frozen=True)
class Ball:
    """A ball: centre and radius [m]."""

    center: tuple[float, float, float]
    radius: float

    def hit(self, origins: Tensor, rays: Tensor) -> Tensor:
        """Distance [...] of the first hit of unit rays from outside, infinite for none."""
        away = origins - torch.tensor(self.center, dtype=torch.float64)
        along = (away * rays).sum(-1)
        under = along.square() - away.square().sum(-1) + self.radius**2
        near = -along - under.clamp(min=0.0).sqrt()
        return torch.where((under > 0.0) & (near > 1e-9), near, math.inf)

    def inside(self, points: Tensor) -> Tensor:
        """Whether points [..., 3] lie in it."""
        return (points - torch.tensor(self.center)).norm(dim=-1) <= self.radius

    def normal(self, points: Tensor) -> Tensor:
        """Outward unit normals at points [..., 3] of its surface."""
        return (points - torch.tensor(self.center, dtype=torch.float64)) / self.radius


@dataclass(frozen=True)
class Box:
    """A box along the axes: lowest and highest corner [m]."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    def hit(self, origins: Tensor, rays: Tensor) -> Tensor:
        """Distance [...] of the first hit of unit rays from outside, infinite for none."""
        safe = torch.where(rays.abs() < 1e-15, 1e-15, rays)
        a = (torch.tensor(self.low, dtype=torch.float64) - origins) / safe
        b = (torch.tensor(self.high, dtype=torch.float64) - origins) / safe
        near = torch.minimum(a, b).amax(-1)
        far = torch.maximum(a, b).amin(-1)
        return torch.where((near < far) & (near > 1e-9), near, math.inf)

    def inside(self, points: Tensor) -> Tensor:
        """Whether points [..., 3] lie in it."""
        return ((points >= torch.tensor(self.low)) & (points <= torch.tensor(self.high))).all(-1)


@dataclass(frozen=True)
class TrueLamp:
    """A disc that shines evenly and faces the scene."""

    direction: tuple[float, float, float] | None = None  # toward a lamp at infinity, or None
    position: tuple[float, float, float] | None = None  # where a lamp is [m], or None
    # colour times intensity (of a near lamp, at distance)
    color: tuple[float, float, float] = (1.0, 1.0, 1.0)
    distance: float = 1.0  # distance of that intensity [m]
    spread: float = 0.0  # tangent of half the angle of a lamp at infinity, radius [m] of a near one

    def toward(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Unit vectors [..., 3] from points to its middle, and its strength [...] there."""
        if self.direction is not None:
            way = torch.tensor(self.direction, dtype=torch.float64)
            return (way / way.norm()).expand_as(points), torch.ones_like(points[..., 0])
        away = torch.tensor(self.position, dtype=torch.float64) - points
        reach = away.norm(dim=-1)
        return away / reach[..., None], (self.distance / reach) ** 2

    def rays(self, points: Tensor, target: Tensor, count: int) -> tuple[Tensor, Tensor]:
        """Unit rays [count, ..., 3] to points of its disc, and distances to them [count, ...]."""
        turn = torch.arange(count, dtype=torch.float64)
        r = ((turn + 0.5) / count).sqrt() * self.spread
        a, b = r * (turn * _GOLDEN).cos(), r * (turn * _GOLDEN).sin()
        middle, _ = self.toward(target)
        helper = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
        if abs(float(middle[0])) > 0.6:
            helper = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
        u = torch.nn.functional.normalize(torch.linalg.cross(middle, helper), dim=0)
        v = torch.linalg.cross(middle, u)
        offset = a[:, None] * u + b[:, None] * v
        shape = (count, *[1] * (points.dim() - 1), 3)
        if self.direction is not None:
            ways = (middle + offset).reshape(shape).expand(count, *points.shape)
            return torch.nn.functional.normalize(ways, dim=-1), torch.full(
                (count, *points.shape[:-1]), math.inf
            )
        places = torch.tensor(self.position, dtype=torch.float64) + offset
        away = places.reshape(shape) - points
        reach = away.norm(dim=-1)
        return away / reach[..., None], reach


def unblocked(
    points: Tensor, lamp: TrueLamp, things: list[Ball | Box], target: Tensor, count: int
) -> Tensor:
    """Share of a lamp's disc that points [..., 3] see past ``things``, [...].

    Args:
        points: Where [m], float64.
        lamp: The lamp; its disc faces ``target``.
        things: What may be in the way.
        target: Middle of the scene [m], [3].
        count: Rays per point.
    """
    rays, reach = lamp.rays(points, target, count if lamp.spread > 0.0 else 1)
    seen = torch.ones_like(rays[..., 0], dtype=torch.bool)
    for thing in things:
        seen &= ~(thing.hit(points.expand_as(rays), rays) < reach)
    return seen.double().mean(0)


def radiance(
    normal: Tensor,
    view: Tensor,
    points: Tensor,
    albedo: float,
    lamps: list[tuple[TrueLamp, Tensor]],
    around: Tensor,
    specular: float,
    shininess: float,
) -> Tensor:
    """Radiance [..., 3] by Blinn-Phong, written out.

    Args:
        normal: Unit normals [..., 3].
        view: Unit vectors to the eye [..., 3].
        points: Where [m], [..., 3].
        albedo: Linear grey.
        lamps: Each lamp with the share of it that arrives, [...].
        around: Irradiance of the environment over pi, [..., 3].
        specular: k_s.
        shininess: n_s.
    """
    total = albedo * around
    for lamp, share in lamps:
        way, strength = lamp.toward(points)
        cosine = (normal * way).sum(-1)
        half = torch.nn.functional.normalize(way + view, dim=-1)
        shine = specular * (normal * half).sum(-1).clamp(min=0.0) ** shininess
        factor = share * strength * torch.where(cosine > 0, albedo * cosine + shine, 0.0)
        total = total + factor[..., None] * torch.tensor(lamp.color, dtype=torch.float64)
    return total


def environment_irradiance(image: Tensor, normals: Tensor) -> Tensor:
    """Irradiance over pi [N, 3] at unit normals [N, 3] under an equirectangular picture [H, W, 3].

    Summed over all its pixels; up is +z, its middle +y, right of it +x.
    """
    height, width = image.shape[:2]
    polar = (torch.arange(height, dtype=torch.float64) + 0.5) * math.pi / height
    turn = ((torch.arange(width, dtype=torch.float64) + 0.5) / width * 2.0 - 1.0) * math.pi
    sine = polar.sin()[:, None]
    ways = torch.stack(
        [sine * turn.sin(), sine * turn.cos(), polar.cos()[:, None].expand(height, width)], -1
    ).reshape(-1, 3)
    solid = (sine * (math.pi / height) * (2.0 * math.pi / width)).expand(height, width).reshape(-1)
    cosine = (normals @ ways.T).clamp(min=0.0)
    return (cosine * solid) @ image.double().reshape(-1, 3) / math.pi


def sky_share(points: Tensor, normals: Tensor, things: list[Ball | Box], count: int) -> Tensor:
    """Share [N] of an even sky, weighted by the cosine, that points [N, 3] see past ``things``."""
    turn = torch.arange(count, dtype=torch.float64)
    r = ((turn + 0.5) / count).sqrt()
    x, y = r * (turn * _GOLDEN).cos(), r * (turn * _GOLDEN).sin()
    local = torch.stack([x, y, (1.0 - r * r).clamp(min=0.0).sqrt()], -1)
    helper = torch.where(
        normals[:, :1].abs() > 0.6,
        torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64),
        torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64),
    )
    u = torch.nn.functional.normalize(torch.linalg.cross(normals, helper), dim=-1)
    frame = torch.stack([u, torch.linalg.cross(normals, u), normals], -1)
    rays = torch.einsum("nij,kj->kni", frame, local)
    open_ = torch.ones(rays.shape[:2], dtype=torch.bool)
    for thing in things:
        open_ &= ~torch.isfinite(thing.hit(points.expand_as(rays), rays))
    return open_.double().mean(0)


def rays_of(camera: Camera) -> tuple[Tensor, Tensor]:
    """Eye [3] and unit rays [H, W, 3] of a pinhole camera, float64."""
    y, x = torch.meshgrid(
        torch.arange(camera.height, dtype=torch.float64) + 0.5,
        torch.arange(camera.width, dtype=torch.float64) + 0.5,
        indexing="ij",
    )
    local = torch.stack([x, y, torch.ones_like(x)], -1) @ torch.linalg.inv(camera.K).T
    turn = camera.viewmat[:3, :3]
    rays = torch.nn.functional.normalize(local @ turn, dim=-1)
    return -turn.T @ camera.viewmat[:3, 3], rays


def surface_splats(ball: Ball, count: int, grey: float) -> Gaussians:
    """A ball as a reconstruction has it: flat splats on its surface (Fibonacci's lattice)."""
    index = torch.arange(count, dtype=torch.float64) + 0.5
    z, turn = 1.0 - 2.0 * index / count, index * _GOLDEN
    flat = (1.0 - z * z).sqrt()
    out = torch.stack([flat * turn.cos(), flat * turn.sin(), z], -1)
    helper = torch.where(
        z[:, None].abs() > 0.9,
        torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64),
        torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64),
    )
    u = torch.nn.functional.normalize(torch.linalg.cross(helper, out), dim=-1)
    quats = matrix_to_quaternion(torch.stack([u, torch.linalg.cross(out, u), out], -1))
    spacing = ball.radius * math.sqrt(4.0 * math.pi / count)
    scales = torch.tensor([0.8, 0.8, 0.1]).expand(count, 3) * spacing
    means = out * ball.radius + torch.tensor(ball.center)
    return Gaussians.from_colors(
        means.float(),
        scales.contiguous().float(),
        torch.full((count, 3), grey),
        opacities=0.95,
        quats=quats.float(),
    )


def solid_splats(thing: Ball | Box, spacing: float, grey: float) -> Gaussians:
    """A solid as filling leaves it: round splats throughout, each moved a little off a lattice."""
    if isinstance(thing, Ball):
        low = torch.tensor(thing.center) - thing.radius
        high = torch.tensor(thing.center) + thing.radius
    else:
        low, high = torch.tensor(thing.low), torch.tensor(thing.high)
    sides = [
        torch.arange(float(a) + 0.5 * spacing, float(b), spacing)
        for a, b in zip(low, high, strict=True)
    ]
    points = torch.cartesian_prod(*sides)
    generator = torch.Generator().manual_seed(0)
    points += 0.4 * spacing * (torch.rand(points.shape, generator=generator) - 0.5)
    points = points[thing.inside(points)]
    count = points.shape[0]
    return Gaussians.from_colors(
        points, torch.full((count,), 0.6 * spacing), torch.full((count, 3), grey), opacities=0.95
    )
