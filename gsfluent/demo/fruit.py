"""The demo fruit: a watermelon and an orange."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from gsfluent.demo.noise import mix, rgb, smoothstep
from gsfluent.demo.objects import DemoObject

Draw = Callable[[np.random.Generator], np.ndarray]


def _scatter(rng: np.random.Generator, draw: Draw, spacing: float, wanted: int) -> np.ndarray:
    """Dart throwing: up to ``wanted`` points no closer than ``spacing``, [S, 3]."""
    kept: list[np.ndarray] = []
    for _ in range(wanted * 30):
        point = draw(rng)
        if all(float(((point - other) ** 2).sum()) > spacing**2 for other in kept):
            kept.append(point)
            if len(kept) == wanted:
                break
    return np.array(kept).reshape(-1, 3)


def _frames(rng: np.random.Generator, long_axis: np.ndarray, jitter: float) -> Tensor:
    """Frames [S, 3, 3] whose first column is ``long_axis`` [S, 3], shaken by ``jitter``."""
    first = long_axis + jitter * rng.normal(size=long_axis.shape)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = rng.normal(size=first.shape)
    second -= (second * first).sum(1, keepdims=True) * first
    second /= np.linalg.norm(second, axis=1, keepdims=True)
    return torch.from_numpy(np.stack([first, second, np.cross(first, second)], -1))


class Watermelon(DemoObject):
    """A watermelon on its side, 0.26 m long.

    Striped rind, white pith, red flesh with pale veins, black seeds. The long axis is x.
    """

    name = "watermelon"
    axes = (0.130, 0.108, 0.105)
    bump_amplitude = 0.022
    rind_depth = 0.004
    pith_depth = 0.013

    def _place_seeds(self, rng: np.random.Generator) -> tuple[Tensor, Tensor, Tensor]:
        axes = np.array(self.axes)
        lobe = rng.uniform(0.0, 2.0 * math.pi)

        def draw(r: np.random.Generator) -> np.ndarray:
            # Seeds sit in a shell of the flesh, in arcs on both sides of the three placental lines.
            third, side = r.integers(3), r.choice([-1.0, 1.0])
            angle = lobe + third * 2.0 * math.pi / 3.0 + side * r.normal(0.5, 0.2)
            x = r.uniform(-0.68, 0.68)
            radius = r.uniform(0.46, 0.70) * math.sqrt(1.0 - x * x)
            return np.array([x, radius * math.cos(angle), radius * math.sin(angle)]) * axes

        center = _scatter(rng, draw, 0.0125, 190)
        inward = center * np.array([0.25, 1.0, 1.0])
        inward /= np.linalg.norm(inward, axis=1, keepdims=True)
        self._lobe = lobe
        return (
            torch.from_numpy(center),
            _frames(rng, inward, 0.25),
            torch.tensor([0.0055, 0.0035, 0.0019]),
        )

    def surface_color(self, points: Tensor) -> Tensor:
        """See :meth:`DemoObject.surface_color`."""
        p = self._local(points).to(torch.float32)
        scaled = p / self._axes(p)
        s = scaled / scaled.norm(dim=1, keepdim=True).clamp_min(1e-9)
        broad = self.noise.fractal(s, 2.6, 2)
        fine = self.noise.fractal(s, 11.0, 3)
        angle = torch.atan2(s[:, 2], s[:, 1]) + 0.13 * broad[:, 0] + 0.06 * fine[:, 0]
        wave = torch.cos(11.0 * angle) + 0.35 * broad[:, 1] + 0.38 * fine[:, 1]
        dark = smoothstep(0.05, 0.35, wave)
        light = mix(rgb(0.55, 0.66, 0.34), rgb(0.42, 0.55, 0.25), smoothstep(-0.3, 0.5, fine[:, 2]))
        # The net of thin green veins between the stripes.
        net = smoothstep(0.16, 0.02, (self.noise(s, 21.0)[:, 0] + 0.4 * fine[:, 2]).abs())
        light = mix(light, rgb(0.27, 0.42, 0.17), 0.55 * net)
        deep = mix(rgb(0.07, 0.21, 0.09), rgb(0.14, 0.31, 0.12), smoothstep(-0.5, 0.6, fine[:, 0]))
        color = mix(light, deep, dark)
        off_axis = s[:, 1:].norm(dim=1) + 0.02 * fine[:, 1]
        scar = smoothstep(0.105, 0.075, off_axis) * (s[:, 0] > 0) + smoothstep(
            0.06, 0.035, off_axis
        ) * (s[:, 0] <= 0)
        color = mix(color, rgb(0.45, 0.36, 0.22), 0.9 * scar)
        return color.clamp(0.0, 1.0)

    def interior(self, points: Tensor) -> Tensor:
        """See :meth:`DemoObject.interior`."""
        p = self._local(points).to(torch.float32)
        depth = self.depth(points).to(torch.float32)
        broad = self.noise.fractal(p, 38.0, 2)
        fine = self.noise.fractal(p, 190.0, 2)
        wavy = depth + 0.0012 * broad[:, 0]
        skin = self.surface_color(points)
        pale_green = mix(
            rgb(0.62, 0.76, 0.46), rgb(0.93, 0.95, 0.82), smoothstep(0.0025, 0.0070, wavy)
        )
        color = mix(skin, pale_green, smoothstep(0.0012, 0.0030, depth))
        red = mix(rgb(0.90, 0.24, 0.23), rgb(0.78, 0.10, 0.13), smoothstep(0.02, 0.09, depth))
        flesh = red + 0.055 * fine[:, :1] + 0.045 * broad[:, 1:2] * rgb(0.6, 1.0, 0.9)
        flesh = mix(flesh, rgb(0.96, 0.62, 0.56), self._veins(p, depth, broad))
        color = mix(
            color,
            mix(rgb(0.96, 0.70, 0.60), flesh, smoothstep(0.013, 0.020, wavy)),
            smoothstep(0.0095, 0.0145, wavy),
        )
        _, to_seed = self.seed_distance(points)
        to_seed = to_seed.to(torch.float32)
        in_flesh = (depth > self.pith_depth).float()
        color = mix(color, rgb(0.95, 0.50, 0.45), 0.6 * smoothstep(1.45, 1.1, to_seed) * in_flesh)
        coat = mix(rgb(0.13, 0.08, 0.05), rgb(0.05, 0.035, 0.03), smoothstep(-0.4, 0.4, fine[:, 1]))
        color = mix(color, coat, smoothstep(1.08, 0.96, to_seed) * in_flesh)
        return color.clamp(0.0, 1.0)

    def _veins(self, p: Tensor, depth: Tensor, broad: Tensor) -> Tensor:
        """Weight of the pale lines: three placental sheets from the heart, and thin threads."""
        radius = p[:, 1:].norm(dim=1)
        angle = torch.atan2(p[:, 2], p[:, 1]) - self._lobe + 7.0 * (radius - 0.05) * broad[:, 2]
        third = 2.0 * math.pi / 3.0
        off = (torch.remainder(angle + 0.5 * third, third) - 0.5 * third) * radius
        sheet = (
            smoothstep(0.0028, 0.0006, off.abs())
            * smoothstep(0.004, 0.02, radius)
            * smoothstep(0.012, 0.028, depth)
        )
        stretched = p * torch.tensor([0.6, 1.0, 1.0])
        ridge = self.noise.fractal(stretched, 55.0, 2)
        thread = smoothstep(0.05, 0.0, ridge[:, 0].abs()) * smoothstep(0.1, 0.5, ridge[:, 1])
        return (0.55 * sheet + 0.35 * thread).clamp(0.0, 0.75)


class Orange(DemoObject):
    """An orange of 80 mm: pored skin, white pith, ten segments, a few seeds; its axis is z."""

    name = "orange"
    axes = (0.041, 0.041, 0.038)
    bump_amplitude = 0.02
    rind_depth = 0.0015
    pith_depth = 0.0045
    segments = 10
    cut_axis = 2

    def _place_seeds(self, rng: np.random.Generator) -> tuple[Tensor, Tensor, Tensor]:
        self._turn = rng.uniform(0.0, 2.0 * math.pi)

        def draw(r: np.random.Generator) -> np.ndarray:
            angle = self._turn + (r.integers(self.segments) + 0.5) * 2.0 * math.pi / self.segments
            radius = r.uniform(0.009, 0.013)
            return np.array(
                [radius * math.cos(angle), radius * math.sin(angle), r.uniform(-0.008, 0.008)]
            )

        center = _scatter(rng, draw, 0.007, 8)
        axis = np.tile([0.0, 0.0, 1.0], (len(center), 1))
        return (
            torch.from_numpy(center),
            _frames(rng, axis, 0.2),
            torch.tensor([0.0045, 0.0022, 0.0020]),
        )

    def surface_color(self, points: Tensor) -> Tensor:
        """See :meth:`DemoObject.surface_color`."""
        p = self._local(points).to(torch.float32)
        scaled = p / self._axes(p)
        s = scaled / scaled.norm(dim=1, keepdim=True).clamp_min(1e-9)
        broad = self.noise.fractal(s, 2.0, 3)
        pores = smoothstep(0.25, 0.75, self.noise(s, 34.0)[:, 0])
        color = mix(
            rgb(0.93, 0.52, 0.08), rgb(0.96, 0.65, 0.14), smoothstep(-0.6, 0.6, broad[:, 0])
        )
        color = mix(color, rgb(0.78, 0.42, 0.05), 0.45 * pores)
        stem = smoothstep(0.13, 0.09, s[:, :2].norm(dim=1)) * (s[:, 2] > 0)
        color = mix(color, rgb(0.36, 0.42, 0.16), stem)
        return color.clamp(0.0, 1.0)

    def interior(self, points: Tensor) -> Tensor:
        """See :meth:`DemoObject.interior`."""
        p = self._local(points).to(torch.float32)
        depth = self.depth(points).to(torch.float32)
        radius = p[:, :2].norm(dim=1)
        pitch = 2.0 * math.pi / self.segments
        broad = self.noise.fractal(p, 90.0, 2)
        angle = torch.atan2(p[:, 1], p[:, 0]) - self._turn + 0.10 * broad[:, 0]
        wall = (torch.remainder(angle + 0.5 * pitch, pitch) - 0.5 * pitch).abs() * radius
        # Vesicles are drawn out towards the axis: the noise is stretched along the radius.
        outward = p / radius.clamp_min(1e-4)[:, None]
        drawn = torch.stack([outward[:, 0] * 9.0, outward[:, 1] * 9.0, p[:, 2] * 420.0], 1)
        vesicle = self.noise(drawn + radius[:, None] * 130.0, 1.0)[:, 1] + 0.3 * broad[:, 2]
        pulp = mix(rgb(0.93, 0.52, 0.07), rgb(0.98, 0.72, 0.22), smoothstep(-0.5, 0.5, vesicle))
        white = rgb(0.97, 0.92, 0.78) + 0.03 * broad[:, 1:2]
        color = mix(
            pulp,
            white,
            torch.maximum(smoothstep(0.0011, 0.0004, wall), smoothstep(0.0042, 0.0030, radius)),
        )
        color = mix(white, color, smoothstep(0.0040, 0.0052, depth + 0.0006 * broad[:, 2]))
        color = mix(self.surface_color(points), color, smoothstep(0.0008, 0.0020, depth))
        _, to_seed = self.seed_distance(points)
        seed = smoothstep(1.08, 0.96, to_seed.to(torch.float32)) * (depth > self.pith_depth).float()
        return mix(color, rgb(0.90, 0.84, 0.62), seed).clamp(0.0, 1.0)
