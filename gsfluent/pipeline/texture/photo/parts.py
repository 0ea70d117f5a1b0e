"""Inclusions of a photograph as the user shows them: a label image, a mask, or a colour."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gsfluent.colors import rgb_to_lab
from gsfluent.errors import InputError
from gsfluent.io.checked.pictures import opened_image
from gsfluent.pipeline.texture.photo.exemplar import Exemplar

_LIKE = 25.0  # Lab distance up to which a pixel has the named colour


def read_parts(source: object, photo: Exemplar) -> np.ndarray:
    """Inclusions of a photograph.

    Args:
        source: Image file or array [H, W] or [H, W, C] beside the photograph: two values are a
            mask, more are instance numbers (0 is matter), of RGBA the alpha channel counts; or a
            colour as three values in 0..1.
        photo: The photograph.

    Returns:
        bool or int [H, W] at the photograph's size.

    Raises:
        InputError: The image is missing, unreadable, of another shape, or shows nothing.
    """
    if isinstance(source, str | Path):
        pixels = _read(Path(source))
    elif isinstance(source, np.ndarray) and source.ndim in (2, 3):
        pixels = source
    elif isinstance(source, Sequence) and len(source) == 3:
        wanted = rgb_to_lab(np.asarray(source, np.float32).reshape(1, 3))
        like = np.linalg.norm(rgb_to_lab(photo.image) - wanted, axis=-1) < _LIKE
        return _checked(like & photo.mask)
    else:
        raise InputError(
            f"texture: parts must be an image or a colour, got {type(source).__name__}",
            hint="give a label image of the exemplar's size, or three values in 0..1",
        )
    where = f"texture: parts {source}" if isinstance(source, str | Path) else "texture: parts"
    if pixels.ndim == 3:
        pixels = pixels[..., 3] if pixels.shape[2] == 4 else pixels.max(2)
    height, width = photo.mask.shape
    if abs(pixels.shape[1] / pixels.shape[0] / (width / height) - 1.0) > 0.02:
        raise InputError(
            f"{where} are {pixels.shape[1]} x {pixels.shape[0]} pixels, the exemplar "
            f"{width} x {height}",
            hint="label the exemplar itself, uncropped",
        )
    values = np.unique(pixels)
    labels = pixels > values[0] if len(values) <= 2 else pixels.astype(int)
    return _checked(resized_parts(labels, photo.mask.shape), where)


def resized_parts(labels: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """A label image with another number of pixels; numbers stay what they are."""
    rows = ((np.arange(shape[0]) + 0.5) * labels.shape[0] / shape[0]).astype(int)
    columns = ((np.arange(shape[1]) + 0.5) * labels.shape[1] / shape[1]).astype(int)
    return labels[rows[:, None], columns[None]]


def _checked(labels: np.ndarray, where: str = "texture: parts") -> np.ndarray:
    if not labels.any():
        raise InputError(f"{where} show nothing", hint="mark the inclusions, or leave parts away")
    return labels


def _read(path: Path) -> np.ndarray:
    with opened_image(path, "use a PNG", noun="label image") as opened:
        pixels = np.asarray(opened)
        if not np.isfinite(pixels).all():
            raise InputError(f"{path}: holds NaN or infinity", hint="write whole numbers")
        return pixels
