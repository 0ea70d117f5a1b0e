"""The studio behind the splats: an analytic floor that takes shadows, and a neutral backdrop.

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

# Linear radiance of the floor's paint and of the backdrop at and above the horizon: a light neutral
# studio grey.
_FLOOR = (0.46, 0.46, 0.47)
_HORIZON = (0.50, 0.50, 0.51)
_ZENITH = (0.27, 0.28, 0.30)
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
    """

    height: float
    center: tuple[float, float]
    radius: float
    extent: float

    def packed(self, like: Tensor) -> Tensor:
        """The row of :mod:`gsfluent.pipeline.light.shade`, [STUDIO]; cached per device."""
        return _packed(self, like.dtype, like.device)


@functools.lru_cache(maxsize=16)
def _packed(studio: Studio, dtype: torch.dtype, device: torch.device) -> Tensor:
    row = [studio.height, *studio.center, _FADE * studio.extent, *_FLOOR, *_HORIZON, *_ZENITH]
    return torch.tensor(row, dtype=torch.float64).to(device, dtype)
