"""What Segment Anything writes: a folder of numbered masks, or JSON with run-length codes.

Run lengths count pixels down the columns, background first. The compressed form is COCO's: each
length, from the fourth on as the difference to the one two before, in base 32 with the lowest
digit first, plus 48 to be printable; 32 marks that digits follow and 16 in the last one the sign.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsfluent.errors import InputError
from gsfluent.io.segmentation.files import read_binary

Mask = NDArray[np.bool_]
_LARGE = 1 << 30


def decode_rle(code: Any, where: str = "segmentation") -> Mask:
    """Decode ``{size: [H, W], counts: list or text}`` to a mask, bool [H, W].

    Raises:
        InputError: Keys are missing, or the lengths do not add up to the size.
    """
    if not isinstance(code, Mapping) or "size" not in code or "counts" not in code:
        raise InputError(
            f"{where}: run-length code must have 'size' and 'counts', got {_short(code)}",
            "write masks with output_mode 'uncompressed_rle' or 'coco_rle'",
        )
    size = code["size"]
    if (
        not isinstance(size, Sequence)
        or len(size) != 2
        or not all(isinstance(n, int) and 0 < n < _LARGE for n in size)
    ):
        raise InputError(f"{where}: size must be [height, width], got {_short(size)}", "export it")
    height, width = size
    counts = code["counts"]
    if isinstance(counts, str | bytes):
        lengths = _unpacked(counts, where)
    elif isinstance(counts, Sequence) and all(
        isinstance(n, int) and not isinstance(n, bool) for n in counts
    ):
        lengths = np.array(counts, dtype=np.int64)
    else:
        raise InputError(
            f"{where}: counts must be whole numbers or text, got {_short(counts)}", "export it"
        )
    total = int(lengths.sum()) if lengths.size else 0
    if (lengths < 0).any() or total != height * width:
        raise InputError(
            f"{where}: run lengths add up to {total} pixels, the size {height} x {width} has "
            f"{height * width}",
            "the file is cut short or the size is swapped ([height, width]); export it again",
        )
    value = np.arange(len(lengths)) % 2 == 1
    return np.repeat(value, lengths).reshape(width, height).T


def _unpacked(text: str | bytes, where: str) -> NDArray[np.int64]:
    """Lengths out of COCO's compressed text."""
    raw = text.encode("ascii", "replace") if isinstance(text, str) else bytes(text)
    digits = np.frombuffer(raw, dtype=np.uint8).astype(np.int64) - 48
    if digits.size == 0:
        return np.zeros(0, np.int64)
    if (digits < 0).any() or (digits > 63).any() or digits[-1] & 32:
        raise InputError(
            f"{where}: counts is no run-length code or is cut short", "export the masks again"
        )
    last = (digits & 32) == 0
    ends = np.flatnonzero(last)
    starts = np.concatenate([[0], ends[:-1] + 1])
    place = np.arange(digits.size) - np.repeat(starts, ends - starts + 1)
    if place.max() > 6:
        raise InputError(f"{where}: a run length has too many digits", "export the masks again")
    value = np.add.reduceat((digits & 31) << (5 * place), starts)
    value -= np.where(digits[ends] & 16, np.int64(1) << (5 * (ends - starts + 1)), 0)
    # differences to the length two before, from the fourth length on
    value[1::2] = np.cumsum(value[1::2])
    value[2::2] = np.cumsum(value[2::2])
    return value


def painted(masks: list[Mask], where: str) -> NDArray[np.int64]:
    """One label map of overlapping masks: small ones lie on large ones; numbered from 1, [H, W].

    Raises:
        InputError: Their sizes differ.
    """
    shapes = {mask.shape for mask in masks}
    if len(shapes) != 1:
        raise InputError(
            f"{where}: masks of one image must have one size, got {sorted(shapes)}", "export again"
        )
    result = np.zeros(shapes.pop(), dtype=np.int64)
    areas = np.array([int(mask.sum()) for mask in masks])
    for index in np.argsort(-areas, kind="stable"):
        result[masks[index]] = index + 1
    return result


def read_mask_folder(folder: Path, least: float = 0.0) -> NDArray[np.int64]:
    """Read the masks of one image: ``0.png``, ``1.png``, ... with ``metadata.csv`` beside them.

    Args:
        folder: Folder of one image.
        least: Masks whose ``predicted_iou`` or ``stability_score`` is below this are left out.

    Raises:
        InputError: A mask that the table names is missing, damaged, or of another size.
    """
    table = folder / "metadata.csv"
    if table.is_file():
        try:
            with table.open(newline="", encoding="utf-8") as stream:
                rows = list(csv.DictReader(stream))
        except (OSError, UnicodeDecodeError, csv.Error) as error:
            raise InputError(f"{table}: the table is damaged ({error})", "export it") from error
        if rows and "id" not in rows[0]:
            raise InputError(f"{table}: has no column 'id'", "export the masks again")
        names = [f"{row['id']}.png" for row in rows if _good(row, least, str(table))]
    else:
        files = (f for f in folder.iterdir() if f.suffix.lower() == ".png" and f.stem.isdigit())
        names = [f.name for f in sorted(files, key=lambda f: int(f.stem))]
    if not names:
        raise InputError(
            f"{folder}: no mask is left" if table.is_file() else f"{folder}: holds no mask",
            "run the mask generator on this image again, or remove the folder",
        )
    return painted([read_binary(folder / name) for name in names], str(folder))


def read_json(path: Path) -> dict[str, list[Mapping[str, Any]]]:
    """Read masks per image from JSON: image name -> annotations.

    Understood: the generator's own list (image name = file name), ``{image, annotations}`` as in
    SA-1B, ``{name: [annotations]}``, and COCO's ``{images, annotations}``, whose ``categories``
    become the annotations' ``label``.

    Raises:
        InputError: No JSON, or none of these.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise InputError(f"{path}: the JSON is damaged ({error})", "export it again") from error
    if isinstance(data, list) and all(isinstance(item, Mapping) for item in data):
        return {path.stem: data}
    if isinstance(data, Mapping):
        found = data.get("annotations")
        if isinstance(found, list) and isinstance(data.get("images"), list):
            names = {
                item.get("id"): str(item.get("file_name", item.get("id")))
                for item in data["images"]
                if isinstance(item, Mapping)
            }
            kinds = {
                item.get("id"): str(item.get("name", item.get("id")))
                for item in data.get("categories") or ()
                if isinstance(item, Mapping)
            }
            result: dict[str, list[Mapping[str, Any]]] = {name: [] for name in names.values()}
            for index, item in enumerate(found):
                if not isinstance(item, Mapping) or item.get("image_id") not in names:
                    raise InputError(
                        f"{path}: annotations[{index}] belongs to no image", "export it again"
                    )
                kind = kinds.get(item.get("category_id"))
                named = item if kind is None else {**item, "label": kind}
                result[names[item["image_id"]]].append(named)
            return result
        if isinstance(found, list):
            image = data.get("image")
            name = image.get("file_name", path.stem) if isinstance(image, Mapping) else path.stem
            return {str(name): found}
        if data and all(isinstance(item, list) for item in data.values()):
            return {str(name): item for name, item in data.items()}
    raise InputError(
        f"{path}: no list of masks with 'segmentation' in it",
        "write what SamAutomaticMaskGenerator.generate returns, with output_mode 'coco_rle'",
    )


def json_masks(
    items: list[Mapping[str, Any]], where: str, least: float = 0.0
) -> tuple[list[Mask], list[str | None]]:
    """Masks of the annotations of one image that are good enough, and their labels if any.

    Raises:
        InputError: An annotation without a mask, or whose area is not that of its mask.
    """
    masks, labels = [], []
    for index, item in enumerate(items):
        place = f"{where}[{index}]"
        if not isinstance(item, Mapping) or "segmentation" not in item:
            raise InputError(f"{place}: has no 'segmentation', got {_short(item)}", "export it")
        if not _good(item, least, place):
            continue
        code = item["segmentation"]
        if isinstance(code, list) and code and isinstance(code[0], list):
            raise InputError(
                f"{place}: is a polygon or a plain array", "export with output_mode 'coco_rle'"
            )
        masks.append(decode_rle(code, place))
        labels.append(item.get("label"))
        area = item.get("area")
        if isinstance(area, int) and area != int(masks[-1].sum()):
            raise InputError(
                f"{place}: says area {area}, its mask has {int(masks[-1].sum())} pixels",
                "the masks were exported for another size; export them again",
            )
    return masks, labels


def _good(item: Mapping[str, Any], least: float, where: str) -> bool:
    """Whether a mask's own scores reach ``least``; absent scores do."""
    for name in ("predicted_iou", "stability_score"):
        value = item.get(name)
        if value in (None, ""):
            continue
        try:
            score = float(value)
        except (TypeError, ValueError):
            raise InputError(f"{where}: {name} must be a number, got {value!r}", "export") from None
        if np.isnan(score):
            raise InputError(f"{where}: {name} is NaN", "export the masks again")
        if score < least:
            return False
    return True


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
