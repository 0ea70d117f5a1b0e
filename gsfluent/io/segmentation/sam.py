"""What Segment Anything writes: a folder of numbered masks, or JSON with run-length codes.

Run lengths count pixels down the columns, background first. The compressed form is COCO's: each
length, from the fourth on as the difference to the one two before, in base 32 with the lowest
digit first, plus 48 to be printable; 32 marks that digits follow and 16 in the last one the sign.
"""

from __future__ import annotations

import csv
import dataclasses
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsfluent.errors import InputError, short
from gsfluent.io.checked.files import read_json as load_json
from gsfluent.io.checked.files import read_text
from gsfluent.io.checked.inside import inside
from gsfluent.io.checked.limits import within
from gsfluent.io.checked.pictures import check_pixels
from gsfluent.io.segmentation.files import read_binary

Mask = NDArray[np.bool_]


@dataclasses.dataclass(frozen=True)
class Runs:
    """A mask as its run lengths: as small as its file, whatever it covers."""

    lengths: NDArray[np.int64]  # down the columns, background first
    height: int
    width: int

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width."""
        return self.height, self.width

    @property
    def area(self) -> int:
        """Pixels of the mask."""
        return int(self.lengths[1::2].sum())

    def extent(self) -> tuple[int, int]:
        """First pixel of the mask and the one after its last, counted down the columns."""
        ends = np.cumsum(self.lengths)
        last = len(ends) - 1 - (len(ends) % 2)
        return (int(ends[0]), int(ends[last])) if last > 0 else (0, 0)

    def paint(self, flat: NDArray[Any], value: int) -> None:
        """Set the mask's pixels of a picture that is flat down the columns, [width height]."""
        low, high = self.extent()
        inner = self.lengths[1 : len(self.lengths) - len(self.lengths) % 2]
        chosen = np.repeat(np.arange(len(inner)) % 2 == 0, inner)
        flat[low:high][chosen] = value

    def mask(self) -> Mask:
        """Bool [H, W]."""
        flat = np.zeros(self.height * self.width, bool)
        self.paint(flat, True)
        return flat.reshape(self.width, self.height).T


def decode_rle(code: Any, where: str = "segmentation") -> Mask:
    """Decode ``{size: [H, W], counts: list or text}`` to a mask, bool [H, W].

    Raises:
        InputError: As :func:`read_rle`.
    """
    return read_rle(code, where).mask()


def read_rle(code: Any, where: str = "segmentation") -> Runs:
    """Check ``{size: [H, W], counts: list or text}``; nothing of the mask's size is allocated.

    Raises:
        InputError: Keys are missing, the lengths do not add up to the size, or it is above the
            limit ``pixels``.
    """
    if not isinstance(code, Mapping) or "size" not in code or "counts" not in code:
        raise InputError(
            f"{where}: run-length code must have 'size' and 'counts', got {short(code)}",
            "write masks with output_mode 'uncompressed_rle' or 'coco_rle'",
        )
    size = code["size"]
    if (
        not isinstance(size, Sequence)
        or len(size) != 2
        or not all(isinstance(n, int) and n > 0 for n in size)
    ):
        raise InputError(f"{where}: size must be [height, width], got {short(size)}", "export it")
    height, width = size
    check_pixels(width, height, where)
    counts, area = code["counts"], height * width
    if isinstance(counts, str | bytes):
        lengths = _unpacked(counts, where)
    elif isinstance(counts, Sequence) and all(
        isinstance(n, int) and not isinstance(n, bool) for n in counts
    ):
        # in Python's integers: in 64 bits a sum can wrap to the size
        total = sum(counts)
        if total != area or not all(0 <= n <= area for n in counts):
            raise _uneven(where, total, height, width)
        lengths = np.array(counts, dtype=np.int64)
    else:
        raise InputError(
            f"{where}: counts must be whole numbers or text, got {short(counts)}", "export it"
        )
    total = int(lengths.sum())  # at most 2^35 each, see _unpacked: does not wrap
    if (lengths < 0).any() or total != area:
        raise _uneven(where, total, height, width)
    return Runs(lengths, height, width)


def _uneven(where: str, total: int, height: int, width: int) -> InputError:
    return InputError(
        f"{where}: run lengths add up to {short(total)} pixels, the size {height} x {width} has "
        f"{height * width}",
        "the file is cut short or the size is swapped ([height, width]); export it again",
    )


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


def painted(masks: list[Runs], where: str) -> NDArray[np.int32]:
    """One label map of overlapping masks: small ones lie on large ones; numbered from 1, [H, W].

    Raises:
        InputError: Their sizes differ, or together they are above the limit ``painted_pixels``.
    """
    height, width = _one_shape([mask.shape for mask in masks], where)
    within("painted_pixels", sum(b - a for a, b in (m.extent() for m in masks)), where)
    flat = np.zeros(height * width, dtype=np.int32)
    for index in _large_first([mask.area for mask in masks]):
        masks[index].paint(flat, index + 1)
    return flat.reshape(width, height).T


def _one_shape(shapes: list[tuple[int, int]], where: str) -> tuple[int, int]:
    if len(set(shapes)) != 1:
        raise InputError(
            f"{where}: masks of one image must have one size, got {short(sorted(set(shapes)))}",
            "export again",
        )
    return shapes[0]


def _large_first(areas: list[int]) -> list[int]:
    order: list[int] = np.argsort(-np.array(areas), kind="stable").tolist()
    return order


def read_mask_folder(folder: Path, least: float = 0.0) -> NDArray[np.int32]:
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
            rows = list(csv.DictReader(io.StringIO(read_text(table, noun="table"), newline="")))
        except csv.Error as error:
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
    masks, pixels = list[Mask](), 0
    for name in names:
        masks.append(read_binary(inside(folder, name, table)))
        pixels += masks[-1].size
        within("painted_pixels", pixels, folder)
    result = np.zeros(_one_shape([(m.shape[0], m.shape[1]) for m in masks], str(folder)), np.int32)
    for index in _large_first([int(mask.sum()) for mask in masks]):
        result[masks[index]] = index + 1
    return result


def read_json(path: Path) -> dict[str, list[Mapping[str, Any]]]:
    """Read masks per image from JSON: image name -> annotations.

    Understood: the generator's own list (image name = file name), ``{image, annotations}`` as in
    SA-1B, ``{name: [annotations]}``, and COCO's ``{images, annotations}``, whose ``categories``
    become the annotations' ``label``.

    Raises:
        InputError: No JSON, or none of these.
    """
    data = load_json(path)
    if isinstance(data, list) and all(isinstance(item, Mapping) for item in data):
        return {path.stem: data}
    if isinstance(data, Mapping):
        found = data.get("annotations")
        if isinstance(found, list) and isinstance(data.get("images"), list):
            names = {
                _id(item, "id", path): str(item.get("file_name", item.get("id")))
                for item in data["images"]
                if isinstance(item, Mapping)
            }
            kinds_given = data.get("categories") or []
            if not isinstance(kinds_given, list):
                raise InputError(
                    f"{path}: categories must be a list, got {short(kinds_given)}", "export it"
                )
            kinds = {
                _id(item, "id", path): str(item.get("name", item.get("id")))
                for item in kinds_given
                if isinstance(item, Mapping)
            }
            result: dict[str, list[Mapping[str, Any]]] = {name: [] for name in names.values()}
            for index, item in enumerate(found):
                if not isinstance(item, Mapping) or _id(item, "image_id", path) not in names:
                    raise InputError(
                        f"{path}: annotations[{index}] belongs to no image", "export it again"
                    )
                kind = kinds.get(_id(item, "category_id", path))
                named = item if kind is None else {**item, "label": kind}
                result[names[item["image_id"]]].append(named)
            return result
        if isinstance(found, list):
            image = data.get("image")
            name = image.get("file_name", path.stem) if isinstance(image, Mapping) else path.stem
            return {short(name, bare=True) if isinstance(name, str) else short(name): found}
        if data and all(isinstance(item, list) for item in data.values()):
            return {str(name): item for name, item in data.items()}
    raise InputError(
        f"{path}: no list of masks with 'segmentation' in it",
        "write what SamAutomaticMaskGenerator.generate returns, with output_mode 'coco_rle'",
    )


def _id(item: Mapping[str, Any], key: str, path: Path) -> str | int | float | None:
    """A number or a name that things are told apart by."""
    value = item.get(key)
    if value is not None and not isinstance(value, str | int | float):
        raise InputError(f"{path}: {key} must be a number or text, got {short(value)}", "export it")
    return value


def json_masks(
    items: list[Mapping[str, Any]], where: str, least: float = 0.0
) -> tuple[list[Runs], list[str | None]]:
    """Masks of the annotations of one image that are good enough, and their labels if any.

    Raises:
        InputError: An annotation without a mask, or whose area is not that of its mask.
    """
    masks, labels = list[Runs](), list[str | None]()
    for index, item in enumerate(items):
        place = f"{where}[{index}]"
        if not isinstance(item, Mapping) or "segmentation" not in item:
            raise InputError(f"{place}: has no 'segmentation', got {short(item)}", "export it")
        if not _good(item, least, place):
            continue
        code = item["segmentation"]
        if isinstance(code, list) and code and isinstance(code[0], list):
            raise InputError(
                f"{place}: is a polygon or a plain array", "export with output_mode 'coco_rle'"
            )
        masks.append(read_rle(code, place))
        label = item.get("label")
        if label is not None and not isinstance(label, str | int | float):
            raise InputError(f"{place}: label must be text, got {short(label)}", "export it")
        labels.append(None if label is None else str(label))
        area = item.get("area")
        if isinstance(area, int) and area != masks[-1].area:
            raise InputError(
                f"{place}: says area {short(area)}, its mask has {masks[-1].area} pixels",
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
        except (TypeError, ValueError, OverflowError):
            raise InputError(
                f"{where}: {name} must be a number, got {short(value)}", "export"
            ) from None
        if np.isnan(score):
            raise InputError(f"{where}: {name} is NaN", "export the masks again")
        if score < least:
            return False
    return True
