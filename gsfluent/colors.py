"""sRGB, linear light and CIE Lab (D65): of arrays, and of tensors in hundredths.

Both are IEC 61966-2-1, and do not share code: arrays go through OpenCV and NumPy, tensors through
torch on any device, and the last bits of their powers differ. Lighting has a third pair, a pure
power of 2.2 (:mod:`gsfluent.pipeline.light.shade`).
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from gsfluent._lazy import cv2

# sRGB primaries over the D65 white point (IEC 61966-2-1)
_TO_XYZ = (
    (0.412453 / 0.950456, 0.357580 / 0.950456, 0.180423 / 0.950456),
    (0.212671, 0.715160, 0.072169),
    (0.019334 / 1.088754, 0.119193 / 1.088754, 0.950227 / 1.088754),
)
_EDGE = 6.0 / 29.0


def srgb_to_linear(value: np.ndarray) -> np.ndarray:
    """Linear light, float32, of sRGB values in 0..1; what is outside is clipped."""
    value = np.asarray(value).clip(0.0, 1.0)
    high = ((value + 0.055) / 1.055) ** 2.4
    return np.where(value <= 0.04045, value / 12.92, high).astype(np.float32)


def linear_to_srgb(light: np.ndarray) -> np.ndarray:
    """Values in 0..1, float32, of linear light in sRGB; more than white is clipped."""
    light = np.asarray(light, np.float32).clip(0.0, 1.0)
    high = 1.055 * light ** (1 / 2.4) - 0.055
    return np.where(light <= 0.0031308, light * 12.92, high).astype(np.float32)


def rgb_to_lab(rgb: np.ndarray) -> np.ndarray:
    """CIE Lab (D65) of sRGB values in 0..1, any leading shape [..., 3]."""
    flat = np.ascontiguousarray(rgb, dtype=np.float32).reshape(1, -1, 3)
    return np.asarray(cv2.cvtColor(flat.clip(0.0, 1.0), cv2.COLOR_RGB2LAB).reshape(rgb.shape))


def lab_to_rgb(lab: np.ndarray) -> np.ndarray:
    """Values in 0..1 of CIE Lab (D65) in sRGB, any leading shape [..., 3]."""
    flat = np.ascontiguousarray(lab, dtype=np.float32).reshape(1, -1, 3)
    return np.asarray(cv2.cvtColor(flat, cv2.COLOR_LAB2RGB).reshape(lab.shape).clip(0.0, 1.0))


def rgb_to_lab100(rgb: Tensor) -> Tensor:
    """Convert sRGB in 0..1, [..., 3], to Lab / 100."""
    rgb = rgb.clamp(0.0, 1.0)
    linear = torch.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    xyz = linear @ torch.tensor(_TO_XYZ, dtype=rgb.dtype, device=rgb.device).T
    cubic = xyz.clamp(min=_EDGE**3) ** (1.0 / 3.0)
    f = torch.where(xyz > _EDGE**3, cubic, xyz / (3 * _EDGE**2) + 4.0 / 29.0)
    x, y, z = f.unbind(-1)
    return torch.stack([1.16 * y - 0.16, 5.0 * (x - y), 2.0 * (y - z)], -1)


def lab100_to_rgb(lab: Tensor) -> Tensor:
    """Convert Lab / 100 [..., 3] to sRGB in 0..1; colours outside the gamut are clipped."""
    light, a, b = lab.unbind(-1)
    y = (light + 0.16) / 1.16
    f = torch.stack([y + a / 5.0, y, y - b / 2.0], -1)
    xyz = torch.where(f > _EDGE, f**3, 3 * _EDGE**2 * (f - 4.0 / 29.0))
    inverse = torch.linalg.inv(torch.tensor(_TO_XYZ, dtype=torch.float64)).to(lab)
    linear = (xyz @ inverse.T).clamp(0.0, 1.0)
    high = 1.055 * linear.clamp(min=1e-8) ** (1.0 / 2.4) - 0.055
    return torch.where(linear <= 0.0031308, linear * 12.92, high).clamp(0.0, 1.0)
