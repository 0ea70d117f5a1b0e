"""The studio behind the splats: an analytic floor that takes shadows, and a neutral backdrop.

There is a light one and a dark one: an object in front of its own lightness has no outline.

A ground plane needs no Gaussians: each pixel's ray meets ``z = height`` in closed form
(in :func:`gsfluent.ops.shade`), so the floor is sharp at any size, never punches
through the object, and costs one pass over the pixels. Far away it dissolves into the backdrop,
whose grey rises with the ray, so that no horizon line cuts the picture.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import torch
from torch import Tensor

from gsfluent.data import SURFACE, Gaussians
from gsfluent.pipeline.light.shade import to_linear

# Linear radiance of the floor's paint and of the backdrop at and above the horizon: neutral greys.
_LIGHT = (0.46, 0.46, 0.47, 0.50, 0.50, 0.51, 0.27, 0.28, 0.30)
_DARK = (0.070, 0.071, 0.075, 0.075, 0.076, 0.081, 0.022, 0.023, 0.027)
# CIE lightness half way between the two floors: what is lighter stands before the dark one.
_MIDDLE = 56.0
_LUMINANCE = (0.2126, 0.7152, 0.0722)
# Sizes of the action over which the floor dissolves into the backdrop.
_FADE = 6.0


@dataclass(frozen=True)
class Studio:
    """Floor and backdrop, fixed for a whole video so that nothing flickers.

    Attributes:
        height: z of the floor [m].
        center: Horizontal centre of the lit pool [m].
        radius: Size of the object [m].
        extent: Size of the whole action [m]; the floor fades over a few of these.
        dark: Whether floor and backdrop are dark.
    """

    height: float
    center: tuple[float, float]
    radius: float
    extent: float
    dark: bool = False

    def packed(self, like: Tensor) -> Tensor:
        """The row of :mod:`gsfluent.pipeline.light.shade`, [STUDIO]; cached per device."""
        return _packed(self, like.dtype, like.device)


def wants_dark(gaussians: Gaussians) -> bool:
    """Whether splats stand out better before the dark studio: where their skin is light.

    Lightness is CIE L* of the mean linear luminance, every splat by its area and opacity.
    """
    if gaussians.labels is not None and bool((gaussians.labels == SURFACE).any()):
        gaussians = gaussians.select(gaussians.labels == SURFACE)
    if gaussians.count == 0:
        return False
    two = gaussians.scales.topk(2, dim=1).values.double()
    weight = two[:, 0] * two[:, 1] * gaussians.opacities.double()
    linear = to_linear(gaussians.colors().double().clamp(0.0, 1.0))
    luminance = linear @ linear.new_tensor(_LUMINANCE)
    mean = float((luminance * weight).sum() / weight.sum().clamp(min=1e-30))
    return 116.0 * mean ** (1.0 / 3.0) - 16.0 > _MIDDLE


@functools.lru_cache(maxsize=16)
def _packed(studio: Studio, dtype: torch.dtype, device: torch.device) -> Tensor:
    row = [studio.height, *studio.center, _FADE * studio.extent]
    row += _DARK if studio.dark else _LIGHT
    return torch.tensor(row, dtype=torch.float64).to(device, dtype)
