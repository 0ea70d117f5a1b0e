"""The studio behind the splats: an analytic floor that takes shadows, and a neutral backdrop.

A ground plane needs no Gaussians: each pixel's ray meets ``z = height`` in closed form, so the
floor is sharp at any size, never punches through the object, and costs one pass over the pixels.
Far away it dissolves into the backdrop, whose grey rises with the ray, so that no horizon line cuts
the picture.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gsfluent.data import Gaussians
from gsfluent.pipeline.light import Light, ShadowMap, gaussian_blur

# Linear radiance of the floor's paint and of the backdrop at and above the horizon: a light neutral
# studio grey.
_FLOOR = (0.46, 0.46, 0.47)
_HORIZON = (0.50, 0.50, 0.51)
_ZENITH = (0.27, 0.28, 0.30)
_FOOTPRINT_TEXELS = 192
# How dark the floor gets right under an object that rests on it.
_CONTACT_STRENGTH = 0.65


@dataclass(frozen=True)
class Studio:
    """Floor and backdrop, fixed for a whole video so that nothing flickers.

    Attributes:
        height: z of the floor [m].
        center: Horizontal centre of the lit pool [m].
        radius: Size of the object [m], over which its contact shadow reaches.
        extent: Size of the whole action [m]; the floor fades over a few of these.
    """

    height: float
    center: tuple[float, float]
    radius: float
    extent: float

    def backdrop(self, rays: Tensor) -> Tensor:
        """Linear radiance [..., 3] of the backdrop along unit rays [..., 3]."""
        rise = (rays[..., 2:3].clamp(min=0.0) * 2.0).clamp(max=1.0)
        horizon, zenith = rays.new_tensor(_HORIZON), rays.new_tensor(_ZENITH)
        return horizon + (zenith - horizon) * rise

    def shade(
        self,
        eye: Tensor,
        rays: Tensor,
        light: Light,
        shadow: ShadowMap | None,
        gaussians: Gaussians,
    ) -> Tensor:
        """Linear radiance of floor and backdrop.

        Args:
            eye: Camera centre [m], shape [3].
            rays: Unit rays of the pixels, shape [H, W, 3].
            light: The light.
            shadow: The light's map of the splats, or None for no cast shadow.
            gaussians: What stands on the floor (its contact shadow).

        Returns:
            Shape [H, W, 3].
        """
        image = self.backdrop(rays)
        down = -rays[..., 2]
        above = float(eye[2]) - self.height
        hits = down > 1e-4
        if above <= 0.0 or not bool(hits.any()):
            return image  # seen from below, a floor would only hide the object
        reach = above / down[hits]
        points = eye + reach[:, None] * rays[hits]
        toward = light.toward(points)
        arrives = torch.ones_like(reach)
        if shadow is not None:
            arrives = shadow.cast(points, softness=0.035 * self.radius)
        ambient = 1.0 - _CONTACT_STRENGTH * self.contact(gaussians, points)
        irradiance = light.ambient * ambient + light.intensity * arrives * toward[2].clamp(min=0.0)
        # relative to an open floor, so that the paint keeps its grey under any light
        irradiance = irradiance / (
            light.ambient + light.intensity * float(toward[2].clamp(min=0.0))
        )
        paint = points.new_tensor(_FLOOR) * irradiance[:, None]
        away = (points[:, :2] - points.new_tensor(self.center)).norm(dim=-1) / (6.0 * self.extent)
        keep = torch.exp(-(away**2))[:, None]
        image[hits] = keep * paint + (1.0 - keep) * image[hits]
        return image

    def contact(self, gaussians: Gaussians, points: Tensor) -> Tensor:
        """Share of the sky hidden from floor points [P, 3] by matter close above them, in [0, 1].

        The footprint of the splats, each counted less the higher it hangs, blurred by about that
        height.
        """
        means = gaussians.means
        reach = 0.25 * self.radius
        lift = (means[:, 2] - self.height).clamp(min=0.0)
        weight = gaussians.opacities * torch.exp(-lift / reach)
        half = float((means[:, :2] - means.new_tensor(self.center)).abs().amax()) + 3.0 * reach
        # texels no finer than the splats, or the floor would see between them
        texels = int(half / max(1.5 * float(gaussians.scales.mean()), half / _FOOTPRINT_TEXELS))
        texels = max(texels, 8)
        cell = 2.0 * half / texels
        index = ((means[:, :2] - means.new_tensor(self.center) + half) / cell).long()
        index = index.clamp(0, texels - 1)
        footprint = torch.zeros(texels**2, dtype=means.dtype, device=means.device)
        # the nearest splat above a texel hides it; more of them hide it no further
        footprint.scatter_reduce_(0, index[:, 1] * texels + index[:, 0], weight, "amax")
        blurred = gaussian_blur(footprint.reshape(texels, texels), 0.35 * reach / cell)
        grid = ((points[:, :2] - points.new_tensor(self.center)) / half)[None, None]
        sampled = torch.nn.functional.grid_sample(
            blurred[None, None], grid, mode="bilinear", padding_mode="zeros", align_corners=False
        )
        return sampled.flatten().clamp(0.0, 1.0)
