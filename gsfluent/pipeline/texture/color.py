"""CIE Lab on any device, scaled to about the range of RGB."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["lab_to_rgb", "rgb_to_lab100"]

# sRGB primaries over the D65 white point (IEC 61966-2-1)
_TO_XYZ = (
    (0.412453 / 0.950456, 0.357580 / 0.950456, 0.180423 / 0.950456),
    (0.212671, 0.715160, 0.072169),
    (0.019334 / 1.088754, 0.119193 / 1.088754, 0.950227 / 1.088754),
)
_EDGE = 6.0 / 29.0


def rgb_to_lab100(rgb: Tensor) -> Tensor:
    """Convert sRGB in 0..1, [..., 3], to Lab / 100."""
    rgb = rgb.clamp(0.0, 1.0)
    linear = torch.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    xyz = linear @ torch.tensor(_TO_XYZ, dtype=rgb.dtype, device=rgb.device).T
    cubic = xyz.clamp(min=_EDGE**3) ** (1.0 / 3.0)
    f = torch.where(xyz > _EDGE**3, cubic, xyz / (3 * _EDGE**2) + 4.0 / 29.0)
    x, y, z = f.unbind(-1)
    return torch.stack([1.16 * y - 0.16, 5.0 * (x - y), 2.0 * (y - z)], -1)


def lab_to_rgb(lab: Tensor) -> Tensor:
    """Convert Lab / 100 [..., 3] to sRGB in 0..1; colours outside the gamut are clipped."""
    light, a, b = lab.unbind(-1)
    y = (light + 0.16) / 1.16
    f = torch.stack([y + a / 5.0, y, y - b / 2.0], -1)
    xyz = torch.where(f > _EDGE, f**3, 3 * _EDGE**2 * (f - 4.0 / 29.0))
    inverse = torch.linalg.inv(torch.tensor(_TO_XYZ, dtype=torch.float64)).to(lab)
    linear = (xyz @ inverse.T).clamp(0.0, 1.0)
    low = linear * 12.92
    high = 1.055 * linear.clamp(min=1e-8) ** (1.0 / 2.4) - 0.055
    return torch.where(linear <= 0.0031308, low, high).clamp(0.0, 1.0)
