"""Colour spaces of the texture modules: sRGB values in 0..1 and CIE Lab (D65)."""

from __future__ import annotations

import numpy as np

__all__ = ["lab_to_rgb", "linear", "rgb_to_lab", "srgb"]


def rgb_to_lab(rgb: np.ndarray) -> np.ndarray:
    """CIE Lab (D65) of sRGB values in 0..1, any leading shape [..., 3]."""
    import cv2

    flat = np.ascontiguousarray(rgb, dtype=np.float32).reshape(1, -1, 3)
    lab: np.ndarray = cv2.cvtColor(flat.clip(0.0, 1.0), cv2.COLOR_RGB2LAB).reshape(rgb.shape)
    return lab


def lab_to_rgb(lab: np.ndarray) -> np.ndarray:
    """SRGB values in 0..1 of CIE Lab (D65), any leading shape [..., 3]."""
    import cv2

    flat = np.ascontiguousarray(lab, dtype=np.float32).reshape(1, -1, 3)
    rgb: np.ndarray = cv2.cvtColor(flat, cv2.COLOR_LAB2RGB).reshape(lab.shape)
    return rgb.clip(0.0, 1.0)


def linear(value: np.ndarray) -> np.ndarray:
    """Linear light of sRGB values in 0..1 (IEC 61966-2-1)."""
    value = np.asarray(value, np.float32).clip(0.0, 1.0)
    result: np.ndarray = np.where(
        value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4
    ).astype(np.float32)
    return result


def srgb(light: np.ndarray) -> np.ndarray:
    """SRGB values in 0..1 of linear light; more than white is clipped."""
    light = np.asarray(light, np.float32).clip(0.0, 1.0)
    result: np.ndarray = np.where(
        light <= 0.0031308, light * 12.92, 1.055 * light ** (1 / 2.4) - 0.055
    ).astype(np.float32)
    return result
