"""Procedural solid objects: a shape, and a colour, a depth and a part for every point inside it.

They serve as inputs whose inside is known. The frame is the scene's: metres, +z up, the object
rests on z = 0. The shape is a star-shaped bumpy ellipsoid: with ``q = p - center`` and ``s`` the
direction of ``q / axes``, a point is inside when ``g(q) = |q / axes| <= 1 + bump(s)``.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from gsfluent.demo.noise import SolidNoise

RIND, PITH, FLESH, SEED = 1, 2, 3, 4


class DemoObject:
    """Base of the demo objects: geometry here, colours in the subclasses.

    Attributes:
        name: Name the object is made under.
        seed: Seed every random choice follows from.
        axes: Semi-axes [m].
        center: Centre [m]; its height rests the object on z = 0.
        rind_depth, pith_depth: Depths [m] at which the rind and the pith end.
        cut_axis: Axis across which the photograph of its inside is cut.
        level_faces: Whether its top or bottom is flat.
    """

    name = ""
    axes = (0.1, 0.1, 0.1)
    bump_amplitude = 0.01
    rind_depth = 0.004
    pith_depth = 0.012
    cut_axis = 0
    level_faces = False

    def __init__(self, seed: int = 0) -> None:
        self.seed = seed
        rng = np.random.default_rng([seed, 17])
        self._wave = torch.from_numpy(rng.normal(size=(7, 3)) * rng.uniform(1.2, 4.0, (7, 1)))
        self._phase = torch.from_numpy(rng.uniform(0.0, 2.0 * math.pi, 7))
        strength = torch.from_numpy(rng.uniform(0.5, 1.0, 7)) / self._wave.norm(dim=1)
        self._strength = strength * (self.bump_amplitude / strength.sum())
        self.noise = SolidNoise(seed * 7919 + 1, channels=3)
        self.seed_center, self.seed_frame, self.seed_axes = self._place_seeds(rng)
        self.center = torch.zeros(3, dtype=torch.float64)
        self.center[2] = -self._lowest_point()

    def one(self) -> DemoObject:
        """The object itself, or the first of several: what is cut for the exemplar."""
        return self

    def _axes(self, like: Tensor) -> Tensor:
        return torch.tensor(self.axes, dtype=like.dtype)

    def _bump(self, direction: Tensor) -> Tensor:
        angle = direction @ self._wave.to(direction.dtype).T + self._phase.to(direction.dtype)
        return torch.sin(angle) @ self._strength.to(direction.dtype)

    def _lowest_point(self) -> float:
        grid = torch.linspace(-0.5, 0.5, 201, dtype=torch.float64)
        x, y = torch.meshgrid(grid, grid, indexing="ij")
        direction = torch.stack([x, y, -torch.ones_like(x)], -1).reshape(-1, 3)
        direction = direction / direction.norm(dim=1, keepdim=True)
        return float(((1.0 + self._bump(direction)) * direction[:, 2]).min()) * self.axes[2]

    def _local(self, points: Tensor) -> Tensor:
        return points - self.center.to(points.dtype)

    def level(self, points: Tensor) -> Tensor:
        """``g(q) - 1 - bump``, shape [N]: negative inside, zero on the surface; no length."""
        scaled = self._local(points) / self._axes(points)
        g = scaled.norm(dim=1)
        return g - 1.0 - self._bump(scaled / g.clamp_min(1e-9)[:, None])

    def depth(self, points: Tensor) -> Tensor:
        """Depth below the surface [m], first order near it, shape [N]; negative outside."""
        scaled = self._local(points) / self._axes(points)
        g = scaled.norm(dim=1).clamp_min(1e-9)
        slope = (scaled / self._axes(points)).norm(dim=1) / g
        return -(g - 1.0 - self._bump(scaled / g[:, None])) / slope

    def inside(self, points: Tensor) -> Tensor:
        """Whether each point [N, 3] lies in the object, bool [N]."""
        return self.level(points) <= 0.0

    def normal(self, points: Tensor) -> Tensor:
        """Outward unit normal of the level set through each point, shape [N, 3]."""
        axes = self._axes(points)
        scaled = self._local(points) / axes
        g = scaled.norm(dim=1, keepdim=True).clamp_min(1e-9)
        s = scaled / g
        angle = s @ self._wave.to(s.dtype).T + self._phase.to(s.dtype)
        slope = (torch.cos(angle) * self._strength.to(s.dtype)) @ self._wave.to(s.dtype)
        tangent = slope - (slope * s).sum(1, keepdim=True) * s
        gradient = (s - tangent / g) / axes
        return gradient / gradient.norm(dim=1, keepdim=True)

    def bounds(self) -> tuple[Tensor, Tensor]:
        """Lower and upper corner [m] of a box that contains the object, float64 [3] each."""
        reach = torch.tensor(self.axes, dtype=torch.float64) * (1.0 + self.bump_amplitude)
        return self.center - reach, self.center + reach

    def intersect(self, origin: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
        """First hits of rays with the surface.

        The bump varies slowly, so the hit is a fixed point: intersect the ellipsoid scaled by the
        bump at the last hit.

        Args:
            origin: Ray origin [m], shape [3].
            direction: Ray directions, shape [N, 3].

        Returns:
            Indices of the rays that hit, int64 [M], and their hit points [m], shape [M, 3].
        """
        axes = self._axes(direction)
        o = ((origin - self.center).to(direction.dtype) / axes)[None]
        d = direction / axes
        a, b, oo = (d * d).sum(1), (d * o).sum(1), (o * o).sum()
        outer = (1.0 + self.bump_amplitude) ** 2
        index = torch.nonzero((b * b - a * (oo - outer) >= 0) & (b < 0))[:, 0]
        a, b, d = a[index], b[index], d[index]
        radius = torch.ones_like(a)
        for _ in range(5):
            root = torch.sqrt((b * b - a * (oo - radius * radius)).clamp_min(0.0))
            t = (-b - root) / a
            s = o + t[:, None] * d
            radius = 1.0 + self._bump(s / s.norm(dim=1, keepdim=True))
        hit = b * b - a * (oo - radius * radius) >= 0
        return index[hit], origin.to(direction.dtype) + t[hit, None] * direction[index[hit]]

    def _place_seeds(self, rng: np.random.Generator) -> tuple[Tensor, Tensor, Tensor]:
        """Draw the seeds: centres relative to the object's [S, 3], frames [S, 3, 3], semi-axes [3].

        The columns of a frame are the long, wide and thin direction of the seed.
        """
        raise NotImplementedError

    def seed_distance(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Nearest seed, int64 [N], and the scaled distance to it (1 on its surface), [N]."""
        from scipy.spatial import cKDTree

        local = self._local(points)
        if len(self.seed_center) == 0:
            return torch.zeros(len(points), dtype=torch.long), torch.full_like(
                points[:, 0], math.inf
            )
        reach = 1.6 * float(self.seed_axes.max())
        _, found = cKDTree(self.seed_center.cpu().numpy()).query(
            local.double().cpu().numpy(), distance_upper_bound=reach, workers=-1
        )
        nearest = torch.from_numpy(found).to(local.device)
        near = nearest < len(self.seed_center)
        nearest = torch.where(near, nearest, torch.zeros_like(nearest))
        distance = torch.full_like(points[:, 0], math.inf)
        rows = torch.nonzero(near)[:, 0]
        offset = local[rows] - self.seed_center[nearest[rows]].to(points.dtype)
        turned = torch.einsum("nij,ni->nj", self.seed_frame[nearest[rows]].to(points.dtype), offset)
        distance[rows] = (turned / self.seed_axes.to(points.dtype)).norm(dim=1)
        return nearest, distance

    def labels(self, points: Tensor) -> Tensor:
        """Class of each point, int64 [N]: 0 outside, 1 rind, 2 pith, 3 flesh, 4 seed."""
        depth = self.depth(points)
        label = torch.full_like(depth, FLESH, dtype=torch.long)
        label[depth < self.pith_depth] = PITH
        label[depth < self.rind_depth] = RIND
        label[(self.seed_distance(points)[1] <= 1.0) & (label == FLESH)] = SEED
        label[depth < 0] = 0
        return label

    def parts(self, points: Tensor) -> Tensor:
        """As :meth:`labels`, but seed ``k`` has its own id ``4 + k``, int64 [N]."""
        label = self.labels(points)
        rows = torch.nonzero(label == SEED)[:, 0]
        label[rows] = SEED + self.seed_distance(points[rows])[0]
        return label

    def surface_color(self, points: Tensor) -> Tensor:
        """Colour of the skin at points on (or near) the surface, sRGB in [0, 1], float32 [N, 3]."""
        raise NotImplementedError

    def interior(self, points: Tensor) -> Tensor:
        """Colour of the matter at points inside, sRGB in [0, 1], float32 [N, 3]."""
        raise NotImplementedError
