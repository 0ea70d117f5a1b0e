"""One label image from one file: indexed, grey and colour pictures, NumPy arrays.

A file is read into *codes*, whole numbers per pixel. What a code means (an index, a grey value, a
colour) is decided for all files of a segmentation together, because one file may use three of
twenty labels and another may have its palette in another order.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gsfluent.errors import InputError
from gsfluent.io.checked.arrays import read_npy
from gsfluent.io.checked.pictures import check_pixels, opened_image
from gsfluent.io.images import IMAGE_SUFFIXES

if TYPE_CHECKING:
    from PIL import Image

Codes = NDArray[np.int64]

ARRAY_SUFFIXES = (".npy",)
LABEL_SUFFIXES = tuple(s for s in IMAGE_SUFFIXES if s not in (".jpg", ".jpeg")) + ARRAY_SUFFIXES
_LOSSY = (".jpg", ".jpeg")
_MANY_COLORS = 1024
_MANY_BLENDS = 8


@dataclasses.dataclass(frozen=True)
class RawLabels:
    """What one file holds."""

    path: Path  # the file
    # index or grey value per pixel, 0 where transparent, [H, W]; None for a picture whose channels
    # differ.
    values: Codes | None
    # ``r << 16 | g << 8 | b`` per pixel, 0 where transparent, [H, W]; None when the file holds
    # numbers only (arrays, 16 bit).
    colors: Codes | None
    indexed: bool = False  # the values are indices of a palette
    palette: tuple[int, ...] = ()  # colour of each index, when indexed
    # pixels that are not transparent, bool [H, W]; None when nothing is.
    opaque: NDArray[np.bool_] | None = None


def read_raw(path: Path) -> RawLabels:
    """Read one label image.

    Raises:
        InputError: Missing, empty, damaged, lossy, or holds what is no label.
    """
    if path.suffix.lower() in _LOSSY:
        raise InputError(f"{path}: JPEG smears labels into one another", "save label images as PNG")
    if path.suffix.lower() in ARRAY_SUFFIXES:
        return RawLabels(path, whole_labels(read_array_file(path), path), None)
    image = open_picture(path)
    if image.mode == "P":
        index = np.asarray(image).astype(np.int64)
        table = _palette(image)
        seen = np.asarray(image.convert("RGBA"))
        colors = np.where(seen[..., 3] > 0, _packed(seen), 0)
        shown = seen[..., 3] > 0
        chosen = np.where(shown, index, 0)
        return RawLabels(path, chosen, colors, True, table, None if shown.all() else shown)
    if image.mode.startswith("I") or image.mode == "F":
        return RawLabels(path, whole_labels(np.asarray(image), path), None)
    if image.mode in ("1", "L"):
        grey = np.asarray(image).astype(np.int64)
        return RawLabels(path, grey, grey * 0x10101)
    modes = {"LA": "RGBA", "PA": "RGBA", "RGBA": "RGBA"}
    pixels = np.asarray(image.convert(modes.get(image.mode, "RGB")))
    opaque = pixels[..., 3] >= 128 if pixels.shape[2] == 4 else np.ones(pixels.shape[:2], bool)
    colors = np.where(opaque, _packed(pixels), 0)
    grey_only = bool((pixels[..., 0] == pixels[..., 1])[opaque].all()) and bool(
        (pixels[..., 1] == pixels[..., 2])[opaque].all()
    )
    values = np.where(opaque, pixels[..., 0].astype(np.int64), 0) if grey_only else None
    return RawLabels(path, values, colors, opaque=None if opaque.all() else opaque)


def read_binary(path: Path) -> NDArray[np.bool_]:
    """Read a mask: what is at least half white (or opaque, where white all over) is inside, [H, W].

    A mask of 0 and 1 in 8 bits, as some tools write, counts as 0 and white.

    Raises:
        InputError: Missing, empty, damaged, or not finite.
    """
    if path.suffix.lower() in ARRAY_SUFFIXES:
        values = read_array_file(path).astype(np.float64)
        if not np.isfinite(values).all():
            raise InputError(f"{path}: holds NaN or infinity", "save a mask of 0 and 1")
        top = float(values.max(initial=0))
        return np.asarray(values >= 0.5 * top) if top > 0 else np.zeros(values.shape, bool)
    image = open_picture(path)
    if image.mode in ("RGBA", "LA", "PA") or "transparency" in image.info:
        pixels = np.asarray(image.convert("RGBA"))
        if pixels[..., 3].min() < 255:
            shown = pixels[..., :3].max(axis=2) > 0
            solid = np.asarray(pixels[..., 3] >= 128)
            # an opaque white shape on transparent ground, or a black-and-white one with alpha
            return solid & shown if bool(shown[solid].any()) else solid
    if image.mode.startswith("I") or image.mode == "F":
        grey = np.asarray(image, dtype=np.float64)
        if not np.isfinite(grey).all():
            raise InputError(f"{path}: holds NaN or infinity", "save a mask of 0 and 255")
    elif image.mode == "1":
        return np.asarray(image).astype(bool)
    else:
        grey = np.asarray(image.convert("RGB")).max(axis=2).astype(np.float64)
    top = float(grey.max(initial=0.0))
    white = 255.0 if 1.0 < top <= 255.0 else top
    return np.asarray(grey >= 0.5 * white) if top > 0 else np.zeros(grey.shape, bool)


def read_array_file(path: Path) -> NDArray[np.generic]:
    """Read a ``.npy`` file of two axes.

    Raises:
        InputError: Missing, empty, damaged, or of another shape.
    """
    values = read_npy(path)
    if values.ndim != 2 or values.size == 0:
        raise InputError(
            f"{path}: labels must be [H, W], got {list(values.shape)}", "save one map per view"
        )
    check_pixels(values.shape[1], values.shape[0], path)
    return values


def whole_labels(values: NDArray[np.generic], path: Path | str) -> Codes:
    """Check that numbers are labels: finite, whole, not negative.

    Raises:
        InputError: They are not.
    """
    if values.dtype.kind not in "iubf":
        raise InputError(f"{path}: labels must be numbers, got {values.dtype}", "save integers")
    if values.dtype.kind == "f":
        if not np.isfinite(values).all():
            raise InputError(
                f"{path}: labels hold NaN or infinity", "write 0 where there is no label"
            )
        if (values != np.round(values.astype(np.float64))).any():
            raise InputError(
                f"{path}: labels must be whole numbers", "save label numbers, not probabilities"
            )
    if values.size and float(values.min()) < 0:
        raise InputError(
            f"{path}: labels must not be negative, got {float(values.min()):g}",
            "write 0 where there is no label",
        )
    if values.size and float(values.max()) > 2**31 - 1:
        raise InputError(f"{path}: label {float(values.max()):g} is too large", "renumber from 1")
    return values.astype(np.int64)


def numbered(raws: list[RawLabels]) -> tuple[list[Codes], dict[int, str], list[str]]:
    """Give the codes of all files one meaning.

    Indices count where the files' palettes agree and index 0 is black; grey values where no file
    has colours; else colours, numbered from 1 in the order of their hexadecimal names.

    Returns:
        Label numbers of each file [H, W] with 0 for nothing, the names of the numbers, and notes.

    Raises:
        InputError: Colour pictures mixed with arrays, or too many colours to be labels.
    """
    if _indices_count(raws) or all(raw.values is not None and not raw.indexed for raw in raws):
        maps = [raw.values for raw in raws if raw.values is not None]
        numbers = sorted({int(n) for m in maps for n in np.unique(m)} - {0})
        return maps, {n: str(n) for n in numbers}, []
    plain = next((raw for raw in raws if raw.colors is None), None)
    if plain is not None:
        other = next(raw for raw in raws if raw.colors is not None)
        raise InputError(
            f"{plain.path} holds numbers and {other.path} colours",
            "save all views in the same form",
        )
    colors = [raw.colors for raw in raws if raw.colors is not None]
    present, filling = _present(colors)
    notes = []
    # smoothed outlines are blends of two labels: many colours that fill no 3 x 3 pixels anywhere
    blends = np.setdiff1d(present, filling)
    pixels = sum(int((value > 0).sum()) for value in colors)
    blended = sum(int(np.isin(value, blends).sum()) for value in colors)
    if len(blends) > _MANY_BLENDS and blended < 0.2 * pixels and len(filling) <= _MANY_COLORS:
        notes.append(f"{len(blends)} colours of smoothed outlines count as nothing")
        present = filling
    elif len(present) > _MANY_COLORS:
        raise InputError(
            f"{raws[0].path.parent}: {len(present)} colours are no labels",
            "give label images (one flat colour per part), not photographs",
        )
    maps = []
    for value in colors:
        place = np.searchsorted(present, value).clip(max=max(len(present) - 1, 0))
        known = present[place] == value if len(present) else np.zeros(value.shape, bool)
        maps.append(np.where(known, place + 1, 0).astype(np.int64))
    return maps, {k + 1: f"#{int(code):06x}" for k, code in enumerate(present)}, notes


def _present(colors: list[Codes]) -> tuple[Codes, Codes]:
    """Colours other than black over all files, sorted, and those that fill 3 x 3 pixels."""
    present: set[int] = set()
    filling: set[int] = set()
    for value in colors:
        present |= set(np.unique(value).tolist())
        if min(value.shape) < 3:
            continue
        middle = value[1:-1, 1:-1]
        flat = np.ones(middle.shape, bool)
        for down, across in np.ndindex(3, 3):
            rows, columns = value.shape[0] - 2 + down, value.shape[1] - 2 + across
            flat &= value[down:rows, across:columns] == middle
        filling |= set(np.unique(middle[flat]).tolist())
    return tuple(np.array(sorted(s - {0}), dtype=np.int64) for s in (present, filling))  # type: ignore[return-value]


def _indices_count(raws: list[RawLabels]) -> bool:
    """Whether all files are indexed, black first, and the indices they share look the same."""
    if not raws or not all(raw.indexed for raw in raws):
        return False
    shown: dict[int, int] = {}
    for raw in raws:
        if not raw.palette or raw.palette[0] != 0:
            return False
        assert raw.values is not None
        for index in np.unique(raw.values).tolist():
            code = raw.palette[index] if index < len(raw.palette) else -1
            if shown.setdefault(index, code) != code:
                return False
    return True


def _palette(image: object) -> tuple[int, ...]:
    flat = np.array(image.getpalette("RGB") or [], dtype=np.int64).reshape(-1, 3)  # type: ignore[attr-defined]
    return tuple((flat[:, 0] << 16 | flat[:, 1] << 8 | flat[:, 2]).tolist())


def _packed(pixels: NDArray[np.uint8]) -> Codes:
    wide = pixels.astype(np.int64)
    return wide[..., 0] << 16 | wide[..., 1] << 8 | wide[..., 2]


def open_picture(path: Path) -> Image.Image:
    """Decode a picture file.

    Raises:
        InputError: Missing, empty, truncated, too large, or not an image.
    """
    with opened_image(path, "save label images as PNG") as opened:
        opened.load()
        return opened.copy()
