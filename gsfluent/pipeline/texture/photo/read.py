"""Pixels of an exemplar from files and arrays of every common kind."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gsfluent._lazy import cv2
from gsfluent.errors import InputError
from gsfluent.io.checked.pictures import opened_image

_LARGEST = 1024  # pixels; exemplars are reduced to voxel pitch anyway
_SMALLEST = 16


def read_pixels(source: str | Path | np.ndarray, name: str) -> np.ndarray:
    """Values of an image, turned upright, at most 1024 pixels wide.

    Grey, palette, CMYK and 16-bit files are converted; an alpha channel is kept.

    Args:
        source: Image file, or array [H, W, 3 or 4], uint8, uint16 or float in 0..1.
        name: For messages.

    Returns:
        float32 [H, W, 3 or 4] in 0..1.

    Raises:
        InputError: Missing, unreadable, truncated, too small, not finite, or not a picture.
    """
    pixels = source if isinstance(source, np.ndarray) else _read(Path(source))
    if pixels.ndim != 3 or pixels.shape[2] not in (3, 4):
        raise InputError(
            f"{name}: exemplar must be an RGB or RGBA image, got shape {list(pixels.shape)}",
            hint="convert it to RGB",
        )
    if pixels.dtype.kind not in "uif":
        raise InputError(
            f"{name}: exemplar holds {pixels.dtype} values", hint="give uint8, or float in 0..1"
        )
    top = float(np.iinfo(pixels.dtype).max) if pixels.dtype.kind in "ui" else 1.0
    values: np.ndarray = pixels.astype(np.float32) / top
    if not np.isfinite(values).all():
        raise InputError(f"{name}: exemplar holds NaN or infinite values", hint="replace it")
    if pixels.dtype.kind == "f" and values.size and values[..., :3].max() > 4.0:
        raise InputError(
            f"{name}: exemplar holds values up to {values.max():.0f}, float means 0..1",
            hint="divide by 255, or give uint8",
        )
    if min(values.shape[:2]) < _SMALLEST:
        raise InputError(
            f"{name}: exemplar is {values.shape[1]} x {values.shape[0]} pixels",
            hint=f"use a photograph of at least {_SMALLEST} x {_SMALLEST} pixels, better 300 x 300",
        )
    longest = max(values.shape[:2])
    if longest > _LARGEST:
        factor = _LARGEST / longest
        size = (max(1, round(values.shape[1] * factor)), max(1, round(values.shape[0] * factor)))
        values = cv2.resize(values, size, interpolation=cv2.INTER_AREA)
    return values


def _read(path: Path) -> np.ndarray:
    """Pixels of an image file as uint8 [H, W, 3 or 4], turned upright."""
    from PIL import Image, ImageOps

    with opened_image(path, "use a PNG or JPEG file", noun="exemplar") as opened:
        picture: Image.Image = ImageOps.exif_transpose(opened)
        if picture.mode.startswith("I") or picture.mode == "F":
            # Pillow clips these to 255 instead of scaling them
            deep = np.asarray(picture, dtype=np.float64)
            if not np.isfinite(deep).all():
                raise InputError(f"{path}: holds NaN or infinity", "write the picture again")
            top = 1.0 if deep.max() <= 1.0 else 255.0 if deep.max() <= 255.0 else 65535.0
            picture = Image.fromarray((deep / top * 255.0).clip(0, 255).astype(np.uint8))
        has_alpha = "A" in picture.getbands() or "transparency" in picture.info
        picture = picture.convert("RGBA" if has_alpha else "RGB")
        return np.asarray(picture)
