"""The baked demo objects: a loaf of bread and a layered cake; and two melons side by side."""

from __future__ import annotations

import torch
from torch import Tensor

from gsfluent.demo.fruit import Watermelon
from gsfluent.demo.noise import mix, rgb, smoothstep
from gsfluent.demo.shapes import DistanceObject, Several

CRUST, UNDER, CRUMB = 1, 2, 3
ICING, SPONGE, CREAM, JAM = 1, 3, 4, 5


def rounded_box(local: Tensor, half: Tensor, radius: float) -> Tensor:
    """Signed distance of a box with rounded edges, [N]."""
    q = local.abs() - (half - radius)
    return q.clamp_min(0.0).norm(dim=1) + q.amax(dim=1).clamp_max(0.0) - radius


class Bread(DistanceObject):
    """A white loaf 0.22 m long, its long axis x: brown crust, domed top, open crumb."""

    name = "bread"
    axes = (0.112, 0.058, 0.056)
    rind_depth = 0.003
    pith_depth = 0.006

    def distance(self, local: Tensor) -> Tensor:
        """See :meth:`DistanceObject.distance`."""
        x, y, z = local.unbind(1)
        # the top rises in the middle and sinks at the ends; the sides bulge above the tin's rim
        dome = 0.010 * (1.0 - (y / 0.055) ** 2).clamp(-1.0, 1.0)
        dome = dome + 0.004 * (1.0 - (x / 0.11) ** 2).clamp(-1.0, 1.0)
        lift = smoothstep(-0.01, 0.04, z).to(local.dtype)
        bulge = 1.0 - 0.06 * smoothstep(0.0, 0.03, z).to(local.dtype)
        wave = torch.sin(61.0 * x + 40.0 * y) + torch.sin(97.0 * y - 45.0 * x + self.seed)
        shaped = torch.stack([x, y * bulge, z - dome * lift + 0.010], dim=1)
        half = local.new_tensor([0.108, 0.051, 0.046])
        return rounded_box(shaped, half, 0.017) - 0.0007 * wave * lift

    def surface_color(self, points: Tensor) -> Tensor:
        """See :meth:`DemoObject.surface_color`."""
        p = self._local(points).to(torch.float32)
        broad = self.noise.fractal(p, 25.0, 2)
        fine = self.noise.fractal(p, 160.0, 3)
        side = mix(rgb(0.80, 0.58, 0.30), rgb(0.72, 0.46, 0.20), smoothstep(-0.5, 0.5, broad[:, 0]))
        top = mix(rgb(0.64, 0.34, 0.12), rgb(0.45, 0.21, 0.07), smoothstep(-0.4, 0.6, broad[:, 1]))
        color = mix(side, top, smoothstep(0.0, 0.03, p[:, 2] + 0.006 * broad[:, 2]))
        color = color + 0.05 * fine[:, :1]
        flour = smoothstep(0.35, 0.7, fine[:, 1]) * smoothstep(0.02, 0.045, p[:, 2])
        return mix(color, rgb(0.90, 0.82, 0.68), 0.35 * flour).clamp(0.0, 1.0)

    def interior(self, points: Tensor) -> Tensor:
        """See :meth:`DemoObject.interior`."""
        p = self._local(points).to(torch.float32)
        depth = self.depth(points).to(torch.float32)
        # cells of the crumb are drawn out along the loaf and smaller near the crust
        drawn = p * torch.tensor([0.7, 1.0, 1.15])
        large = self.noise(drawn, 150.0)[:, 0]
        small = self.noise.fractal(drawn + 3.0, 330.0, 2)
        wall = rgb(0.96, 0.90, 0.78) + 0.03 * small[:, 1:2]
        hollow = torch.maximum(
            smoothstep(0.22, 0.48, large) * smoothstep(0.006, 0.014, depth),
            0.7 * smoothstep(0.30, 0.62, small[:, 0]),
        )
        crumb = mix(wall, rgb(0.70, 0.57, 0.38), 0.85 * hollow)
        under = mix(rgb(0.80, 0.58, 0.32), crumb, smoothstep(0.0020, 0.0055, depth))
        return mix(self.surface_color(points), under, smoothstep(0.0008, 0.0026, depth)).clamp(0, 1)


class Cake(DistanceObject):
    """A round cake of 0.18 m: icing, three layers of sponge, cream and jam between them."""

    name = "cake"
    axes = (0.0905, 0.0905, 0.0405)
    rind_depth = 0.005
    pith_depth = 0.005
    sheets = ((-0.0165, 0.0035), (0.0105, 0.0035))
    """Height of the middle and half thickness of each filling [m]."""

    def distance(self, local: Tensor) -> Tensor:
        """See :meth:`DistanceObject.distance`."""
        radius, round_ = 0.090, 0.008
        flat = torch.stack([local[:, :2].norm(dim=1) - (radius - round_),
                            local[:, 2].abs() - (0.040 - round_)], dim=1)  # fmt: skip
        return flat.clamp_min(0.0).norm(dim=1) + flat.amax(dim=1).clamp_max(0.0) - round_

    def surface_color(self, points: Tensor) -> Tensor:
        """See :meth:`DemoObject.surface_color`."""
        p = self._local(points).to(torch.float32)
        broad = self.noise.fractal(p, 30.0, 2)
        angle = torch.atan2(p[:, 1], p[:, 0])
        radius = p[:, :2].norm(dim=1)
        color = mix(
            rgb(0.95, 0.90, 0.84), rgb(0.90, 0.82, 0.76), smoothstep(-0.5, 0.5, broad[:, 0])
        )
        # strawberry glaze on top with drips over the side, and a ring of chocolate curls
        drip = 0.030 - 0.020 * (0.5 + 0.5 * torch.sin(9.0 * angle + 2.0 * broad[:, 1])) ** 2
        glaze = smoothstep(-0.001, 0.001, p[:, 2] - drip)
        color = mix(color, rgb(0.80, 0.20, 0.26) + 0.04 * broad[:, 2:3], glaze)
        ring = smoothstep(0.006, 0.004, (radius - 0.070).abs()) * smoothstep(0.036, 0.0385, p[:, 2])
        curl = smoothstep(-0.1, 0.2, self.noise.fractal(p, 190.0, 2)[:, 0])
        return mix(color, rgb(0.28, 0.15, 0.08), ring * curl).clamp(0.0, 1.0)

    def _sheet(self, p: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance into the cream and the jam sheet [m], [N] each; positive inside."""
        wave = 0.0010 * self.noise.fractal(p * torch.tensor([1.0, 1.0, 0.2]), 60.0, 2)[:, 0]
        found = [half - (p[:, 2] + wave - middle).abs() for middle, half in self.sheets]
        return found[0], found[1]

    def labels(self, points: Tensor) -> Tensor:
        """Class of each point, int64 [N]: 0 outside, 1 icing, 3 sponge, 4 cream, 5 jam."""
        depth = self.depth(points)
        jam, cream = self._sheet(self._local(points).to(torch.float32))
        label = torch.full_like(depth, SPONGE, dtype=torch.long)
        label[cream > 0] = CREAM
        label[jam > 0] = JAM
        label[depth < self.rind_depth] = ICING
        label[depth < 0] = 0
        return label

    def interior(self, points: Tensor) -> Tensor:
        """See :meth:`DemoObject.interior`."""
        p = self._local(points).to(torch.float32)
        depth = self.depth(points).to(torch.float32)
        pore = self.noise.fractal(p, 260.0, 2)
        sponge = mix(
            rgb(0.92, 0.76, 0.42), rgb(0.72, 0.50, 0.22), smoothstep(0.15, 0.55, pore[:, 0])
        )
        sponge = sponge + 0.03 * pore[:, 1:2]
        jam, cream = self._sheet(p)
        color = mix(sponge, rgb(0.97, 0.94, 0.87), smoothstep(-0.0005, 0.0005, cream))
        red = mix(rgb(0.70, 0.08, 0.12), rgb(0.52, 0.04, 0.08), smoothstep(-0.3, 0.4, pore[:, 2]))
        color = mix(color, red, smoothstep(-0.0005, 0.0005, jam))
        white = mix(self.surface_color(points), rgb(0.95, 0.91, 0.86),
                    smoothstep(0.0006, 0.0018, depth))  # fmt: skip
        return mix(white, color, smoothstep(0.0044, 0.0054, depth)).clamp(0.0, 1.0)


class Melons(Several):
    """Two watermelons side by side along x, 0.06 m apart."""

    name = "melons"

    def __init__(self, seed: int = 0) -> None:
        super().__init__([Watermelon(seed), Watermelon(seed + 77)], 0.06, seed)
