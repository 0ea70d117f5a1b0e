"""Brittle things of a kitchen: a pane of glass, a bowl of it, an egg, a bar of chocolate."""

from __future__ import annotations

import torch
from torch import Tensor

from gsfluent.demo.baked import rounded_box
from gsfluent.demo.noise import mix, rgb, smoothstep
from gsfluent.demo.shapes import DistanceObject

WALL = 1
SHELL, WHITE, YOLK = 1, 3, 5


class _OneMatter(DistanceObject):
    """The same all through, but for its colours."""

    def labels(self, points: Tensor) -> Tensor:
        """Class of each point, int64 [N]: 0 outside, 1 inside."""
        return (self.level(points) <= 0.0).long() * WALL


class Pane(_OneMatter):
    """A shelf of frosted float glass, 160 x 110 x 10 mm, lying flat.

    Frosted, because splats are drawn opaque: clear glass would need refraction.
    """

    name = "pane"
    axes = (0.080, 0.055, 0.005)
    rind_depth = 0.0005
    pith_depth = 0.0005

    def distance(self, local: Tensor) -> Tensor:
        """See :meth:`DistanceObject.distance`."""
        return rounded_box(local, local.new_tensor(self.axes), 0.001)

    def surface_color(self, points: Tensor) -> Tensor:
        """See :meth:`DemoObject.surface_color`."""
        p = self._local(points).to(torch.float32)
        grain = self.noise.fractal(p, 300.0, 2)
        frost = rgb(0.66, 0.83, 0.79) + 0.02 * grain[:, :1]
        # iron makes float glass green where one looks along it
        edge = smoothstep(0.0035, 0.0042, p[:, 2].abs())
        green = mix(rgb(0.16, 0.46, 0.38), frost, edge)
        return green.clamp(0.0, 1.0)

    def interior(self, points: Tensor) -> Tensor:
        """See :meth:`DemoObject.interior`."""
        p = self._local(points).to(torch.float32)
        depth = self.depth(points).to(torch.float32)
        cloud = self.noise.fractal(p, 80.0, 2)
        fresh = mix(
            rgb(0.20, 0.52, 0.43), rgb(0.30, 0.62, 0.53), smoothstep(-0.5, 0.5, cloud[:, 0])
        )
        return mix(self.surface_color(points), fresh, smoothstep(0.0003, 0.0010, depth))


class Bowl(_OneMatter):
    """A bowl of pressed opal glass, 0.12 m wide and 0.05 m high, its wall 9 mm.

    Opal, because splats are drawn opaque: clear glass would need refraction.
    """

    name = "bowl"
    axes = (0.060, 0.060, 0.025)
    rind_depth = 0.0005
    pith_depth = 0.0005
    wall = 0.009
    radius = 0.061
    """Of the outer sphere [m]: (0.06^2 + 0.05^2) / (2 x 0.05)."""

    def distance(self, local: Tensor) -> Tensor:
        """See :meth:`DistanceObject.distance`."""
        # Seen from the axis: the middle line of the wall is an arc that ends half a wall below the
        # rim, so that the rim is round. A foot as wide as half the bowl lets it stand.
        middle = self.radius - 0.5 * self.wall
        height = local[:, 2] + self.axes[2] - self.radius
        around = local[:, :2].norm(dim=1)
        end = self.radius - 2.0 * self.axes[2] + 0.5 * self.wall  # of the arc, below its centre
        ring = (middle**2 - end**2) ** 0.5
        below = -height * ring >= around * end  # the nearest point of the arc lies on it
        arc = ((around**2 + height**2).sqrt() - middle).abs()
        rim = ((around - ring) ** 2 + (height + end) ** 2).sqrt()
        wall = torch.where(below, arc, rim) - 0.5 * self.wall
        foot = torch.stack([around - 0.026, (height + self.radius - 0.006).abs() - 0.006], dim=1)
        disc = foot.clamp_min(0.0).norm(dim=1) + foot.amax(dim=1).clamp_max(0.0)
        return torch.minimum(wall, disc)

    def surface_color(self, points: Tensor) -> Tensor:
        """See :meth:`DemoObject.surface_color`."""
        p = self._local(points).to(torch.float32)
        cloud = self.noise.fractal(p, 28.0, 3)
        jade = mix(rgb(0.44, 0.72, 0.60), rgb(0.58, 0.82, 0.70), smoothstep(-0.5, 0.5, cloud[:, 0]))
        band = smoothstep(0.0015, 0.0005, (p[:, 2] - 0.016).abs())
        return mix(jade, rgb(0.93, 0.90, 0.80), 0.8 * band).clamp(0.0, 1.0)

    def interior(self, points: Tensor) -> Tensor:
        """See :meth:`DemoObject.interior`."""
        p = self._local(points).to(torch.float32)
        cloud = self.noise.fractal(p, 60.0, 2)
        fresh = mix(
            rgb(0.66, 0.88, 0.78), rgb(0.76, 0.94, 0.86), smoothstep(-0.5, 0.5, cloud[:, 0])
        )
        depth = self.depth(points).to(torch.float32)
        skin = smoothstep(0.0012, 0.0004, depth)
        return mix(fresh, self.surface_color(points), skin).clamp(0.0, 1.0)


class Egg(DistanceObject):
    """A brown hen's egg on its side, 57 mm long and 44 mm thick, its blunt end towards -x.

    Its shell is 2.5 mm thick in colours and labels, not 0.36: voxels have to see it.
    """

    name = "egg"
    axes = (0.0285, 0.022, 0.022)
    level_faces = False
    rind_depth = 0.0025
    pith_depth = 0.0025
    yolk = 0.0155

    def distance(self, local: Tensor) -> Tensor:
        """See :meth:`DistanceObject.distance`."""
        # Thickest towards the blunt end; the level over its slope is a distance near the surface.
        long, thick = self.axes[0], self.axes[1]
        t = (local[:, 0] / long).clamp(-1.0, 1.0)
        reach = thick * (1.0 - 0.16 * t - 0.03 * t * t) / 1.0074
        q = torch.stack([local[:, 0] / long, local[:, 1] / reach, local[:, 2] / reach], dim=1)
        level = q.norm(dim=1)
        scale = torch.stack([torch.full_like(reach, long), reach, reach], dim=1)
        slope = (q / scale).norm(dim=1)
        away = level * (level - 1.0) / slope.clamp_min(1e-9)
        return torch.where(level < 1e-6, torch.full_like(away, -thick), away)  # no slope there

    def _lowest_point(self) -> float:
        return -self.axes[2]

    def surface_color(self, points: Tensor) -> Tensor:
        """See :meth:`DemoObject.surface_color`."""
        p = self._local(points).to(torch.float32)
        broad = self.noise.fractal(p, 60.0, 3)
        color = mix(
            rgb(0.80, 0.58, 0.42), rgb(0.72, 0.48, 0.33), smoothstep(-0.5, 0.5, broad[:, 0])
        )
        speck = smoothstep(0.42, 0.60, self.noise.fractal(p + 1.0, 420.0, 2)[:, 0])
        return mix(color, rgb(0.50, 0.30, 0.20), 0.6 * speck).clamp(0.0, 1.0)

    def labels(self, points: Tensor) -> Tensor:
        """Class of each point, int64 [N]: 0 outside, 1 shell, 3 white, 5 yolk."""
        depth = self.depth(points)
        label = torch.full_like(depth, WHITE, dtype=torch.long)
        label[self._local(points).norm(dim=1) < self.yolk] = YOLK
        label[depth < self.rind_depth] = SHELL
        label[depth < 0] = 0
        return label

    def interior(self, points: Tensor) -> Tensor:
        """See :meth:`DemoObject.interior`."""
        p = self._local(points).to(torch.float32)
        depth = self.depth(points).to(torch.float32)
        broad = self.noise.fractal(p, 90.0, 2)
        albumen = rgb(0.93, 0.88, 0.70) + 0.02 * broad[:, :1]
        yolk = mix(rgb(0.98, 0.68, 0.10), rgb(0.93, 0.55, 0.06),
                   smoothstep(-0.5, 0.5, broad[:, 1]))  # fmt: skip
        inside = smoothstep(self.yolk + 0.0004, self.yolk - 0.0004, p.norm(dim=1))
        color = mix(albumen, yolk, inside)
        shell = mix(self.surface_color(points), rgb(0.95, 0.92, 0.88),
                    smoothstep(0.0003, 0.0010, depth))  # fmt: skip
        return mix(shell, color, smoothstep(0.0022, 0.0028, depth)).clamp(0.0, 1.0)


class Chocolate(_OneMatter):
    """A bar of milk chocolate, 120 x 58 x 12 mm: six times three blocks, grooves 5 mm deep."""

    name = "chocolate"
    axes = (0.060, 0.029, 0.006)
    rind_depth = 0.0003
    pith_depth = 0.0003
    blocks = (6, 3)
    groove = 0.005

    def distance(self, local: Tensor) -> Tensor:
        """See :meth:`DistanceObject.distance`."""
        half = local.new_tensor(self.axes)
        slab = rounded_box(local, half, 0.0015)
        # From the nearest groove between blocks, across it: a wedge that opens upwards.
        away = torch.full_like(slab, torch.inf)
        for axis, count in enumerate(self.blocks):
            pitch = 2.0 * self.axes[axis] / count
            place = local[:, axis] / pitch + 0.5 * count
            near = place.round().clamp(1, count - 1)
            away = torch.minimum(away, (place - near).abs() * pitch)
        floor = self.axes[2] - self.groove
        wedge = 0.8 * (away - 0.0005) - 0.6 * (local[:, 2] - floor)
        return torch.maximum(slab, -torch.maximum(wedge, floor - local[:, 2]))

    def surface_color(self, points: Tensor) -> Tensor:
        """See :meth:`DemoObject.surface_color`."""
        p = self._local(points).to(torch.float32)
        broad = self.noise.fractal(p, 45.0, 3)
        return mix(rgb(0.36, 0.20, 0.12), rgb(0.30, 0.16, 0.09), smoothstep(-0.5, 0.5, broad[:, 0]))

    def interior(self, points: Tensor) -> Tensor:
        """See :meth:`DemoObject.interior`."""
        p = self._local(points).to(torch.float32)
        depth = self.depth(points).to(torch.float32)
        fine = self.noise.fractal(p, 500.0, 3)
        # A fresh break is paler and duller than the skin of the mould.
        broken = mix(
            rgb(0.46, 0.29, 0.19), rgb(0.35, 0.20, 0.12), smoothstep(-0.5, 0.5, fine[:, 0])
        )
        return mix(self.surface_color(points), broken, smoothstep(0.0002, 0.0010, depth))
