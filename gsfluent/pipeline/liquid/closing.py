"""Gaps between the points of a liquid, closed in its picture.

A film is drawn by points that lie millimetres apart; its surface tension would leave no pinhole of
that size open, and no notch in its rim. So where most of what is around is liquid of one sheet,
there is liquid: a step of motion by mean curvature as threshold dynamics make it, a blur and a
level (Merriman, Bence and Osher 1992). Near the inside of a sheet its rim is that level; drops and
strands are nowhere near one, and stay. So does a straight edge.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, max_pool2d, pad

from gsfluent.data import Camera
from gsfluent.pipeline.liquid.clear import Surface, covered, span

WIDTH = 1.4
"""Standard deviation of the blur, in spacings of the points."""
SHEET = 8.0
"""Standard deviation of depth, in spacings, from which on what is around is no one sheet."""
SOFT = 0.75
"""Half of the width of a closed edge [px]."""
UNSURE = (0.25, 0.75)
"""Opacity of the splats up to which a pixel is what is around, and from which on it is its own."""
FACING = (0.2, 0.5)
"""Length of a blended normal up to which it says nothing, and from which on it is believed."""
INSIDE = (0.7, 0.9)
"""Share of liquid around a pixel from which on it is a sheet's inside, and where it surely is."""
RIM = 2.5
"""How far from there the rim of a sheet is, in standard deviations of the blur."""
APART = (1.0, 3.0)
"""What lies so many spacings before or behind what is around is a drop before or behind a sheet."""
HELD = (0.1, 0.25)
"""Share of liquid around a drop from which on it hangs on a sheet, and where it is its rim."""
_COARSE = 2.0  # pixels per standard deviation that a blur needs
_LEAST = 1e-3


def closed(
    surface: Surface, paint: Tensor, spacing: float, camera: Camera
) -> tuple[Surface, Tensor]:
    """Close the gaps of a surface, and smooth its rims.

    Args:
        surface: As its splats have it.
        paint: What else they have, times their opacity, [H, W, C].
        spacing: Of the points [m].
        camera: Where from.

    Returns:
        The surface, its opacity that of a liquid with sharp edges, depth and normals in gaps those
        of what is around; and the paint for full opacity, [H, W, C].
    """
    there = surface.alpha > 0.05
    unit = paint / surface.alpha.clamp(min=_LEAST)[..., None]
    if not bool(there.any()):
        return surface, unit
    middle = float(surface.depth[there].median())
    sigma = WIDTH * spacing * float(camera.K[0, 0]) / middle
    window = tuple(span(there.any(dim=dim), math.ceil(2.0 * sigma)) for dim in (1, 0))
    alpha = surface.alpha[window]
    # spacings from the median: their squares are small numbers
    depth = ((surface.depth[window] - middle) / spacing)[..., None]
    own = torch.cat([depth, depth * depth, surface.normal[window], unit[window]], dim=2)
    planes = torch.cat([alpha[..., None], alpha[..., None] * own], dim=2)
    around = _blurred(planes.permute(2, 0, 1), sigma).permute(1, 2, 0)
    much, mean = around[..., 0], around[..., 1:] / around[..., :1].clamp(min=_LEAST)
    # in a gap there is what is around it
    sure = _ramp(alpha, UNSURE)
    mixed = torch.lerp(mean, own, sure[..., None])
    # and where near and far side of an outline have cancelled each other, what faces as those do
    facing = torch.minimum(sure, _ramp(surface.normal[window].norm(dim=2), FACING))
    normal = torch.lerp(mean[..., 2:5], own[..., 2:5], facing[..., None])
    # a straight edge, blurred, is as steep as 1 / (sigma sqrt(2 pi))
    soft = min(SOFT / (math.sqrt(2.0 * math.pi) * sigma), 0.45)
    full = _ramp(much, (0.5 - soft, 0.5 + soft))
    spread = (mean[..., 1] - mean[..., 0] ** 2).clamp(min=0.0)
    flat = torch.exp(-spread / SHEET**2)
    apart = (mixed[..., 0] - mean[..., 0]).abs()
    rim = _ramp(_widened(much, sigma), INSIDE) * _ramp(much, HELD)
    rim = rim * flat * (1.0 - _ramp(apart, APART))
    splats = covered(surface, spacing, camera)[window]
    cover = torch.lerp(torch.maximum(splats, full * flat), full, rim)
    made = Surface(
        _put(surface.alpha, cover, window),
        _put(surface.depth, mixed[..., 0] * spacing + middle, window),
        _put(surface.normal, normal, window),
    )
    return made, _put(unit, mixed[..., 5:], window)


def _ramp(values: Tensor, ends: tuple[float, float]) -> Tensor:
    """From 0 at one end to 1 at the other."""
    return ((values - ends[0]) / (ends[1] - ends[0])).clamp(0.0, 1.0)


def _widened(plane: Tensor, sigma: float) -> Tensor:
    """Largest of a blurred plane [H, W] within :data:`RIM` of each pixel."""
    step = _step(sigma)
    reach = round(RIM * sigma / step)
    coarse = avg_pool2d(plane[None], step, ceil_mode=True)
    coarse = max_pool2d(coarse, 2 * reach + 1, 1, reach)
    return interpolate(coarse[None], plane.shape, mode="bilinear", align_corners=False)[0, 0]


def _step(sigma: float) -> int:
    return max(1, int(sigma / _COARSE))


def _put(whole: Tensor, part: Tensor, window: tuple[slice, ...]) -> Tensor:
    made = whole.clone()
    made[window] = part
    return made


def _blurred(planes: Tensor, sigma: float) -> Tensor:
    """Planes [C, H, W] blurred by ``sigma`` [px], on pixels as coarse as that allows."""
    step = _step(sigma)
    height, width = planes.shape[1:]
    fill = (0, -width % step, 0, -height % step)
    coarse = avg_pool2d(pad(planes[None], fill, mode="replicate"), step)
    reach = math.ceil(2.5 * sigma / step)
    # pixels and the way back between them blur already: a box and a tent of one step
    rest = max((sigma / step) ** 2 - 0.25 * (step > 1), 1e-4)
    bell = [math.exp(-0.5 * k * k / rest) for k in range(-reach, reach + 1)]
    coarse = pad(coarse, (reach,) * 4, mode="replicate")
    for dim in (2, 3):  # no convolution: on a GPU its products may have ten bits
        length = coarse.shape[dim] - 2 * reach
        total = torch.zeros_like(coarse.narrow(dim, 0, length))
        for k, weight in enumerate(bell):
            total.add_(coarse.narrow(dim, k, length), alpha=weight / sum(bell))
        coarse = total
    if step > 1:
        coarse = interpolate(coarse, scale_factor=step, mode="bilinear", align_corners=False)
    return coarse[0, :, :height, :width]
