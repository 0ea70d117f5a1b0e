"""Segmentations: which part every pixel of the photographs shows, from any segmenter's files.

What is read (docs/guide/regions.md): a label image per photograph; a folder of masks per label;
Segment
Anything's folders and JSON; NumPy maps. Everything becomes a label map in the pinhole view that the
photograph itself is resampled to (:func:`gsfluent.io.images.load_view`), nearest neighbour.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsfluent.data.camera import Camera
from gsfluent.data.capture import Capture
from gsfluent.errors import InputError, short
from gsfluent.io.checked.arrays import read_npy, read_npz
from gsfluent.io.checked.files import read_json
from gsfluent.io.checked.limits import within
from gsfluent.io.images import IMAGE_SUFFIXES, pinhole_map
from gsfluent.io.segmentation import sam
from gsfluent.io.segmentation.files import (
    ARRAY_SUFFIXES,
    LABEL_SUFFIXES,
    RawLabels,
    numbered,
    read_binary,
    read_raw,
    whole_labels,
)
from gsfluent.io.segmentation.match import ViewNames

_NAMES_FILE = "labels.json"
_ASPECT = 0.01
_MASK_SUFFIXES = (*IMAGE_SUFFIXES, *ARRAY_SUFFIXES)


@dataclasses.dataclass(frozen=True)
class LabelView:
    """The labels of one photograph."""

    camera: Camera  # pinhole camera of the map
    # label per pixel, int32 [H, W]: 0 for none, -1 where the photograph says nothing.
    labels: NDArray[np.int32]


@dataclasses.dataclass(frozen=True)
class Segmentation:
    """Label maps of some of a capture's photographs."""

    source: str  # where they are from, for messages
    views: tuple[LabelView, ...]  # maps, in the order of the capture's cameras
    names: dict[int, str]  # name of every label number above 0
    # A number means the same part in all views. When False the numbers are instances of one view
    # (Segment Anything), and 0 means unknown, not "no part".
    linked: bool = True
    notes: tuple[str, ...] = ()  # what was noticed while reading

    def number(self, label: str | int) -> int:
        """Return the number of a label given by name or number.

        Raises:
            InputError: There is no such label.
        """
        found = [n for n, name in self.names.items() if label in (name, n) or str(label) == str(n)]
        if not found:
            known = ", ".join(f"{name}" for name in list(self.names.values())[:20])
            raise InputError(f"{self.source}: no label {label!r}", f"labels here: {known}")
        by_name = [n for n in found if self.names[n] == str(label)]
        return (by_name or found)[0]


@dataclasses.dataclass(frozen=True)
class _Wanted:
    """What is read, and for whom; see :func:`load_segmentation`."""

    path: Path
    capture: Capture
    names: ViewNames
    max_size: int | None
    least: float = 0.0
    pixels: list[int] = dataclasses.field(default_factory=list)  # of the maps read so far

    def counted(self, shape: tuple[int, ...]) -> None:
        """Count a map; all are held at once.

        Raises:
            InputError: Together they are above the limit ``label_pixels``.
        """
        self.pixels.append(math.prod(shape))
        within("label_pixels", sum(self.pixels), self.path)

    def raw(self, file: Path) -> RawLabels:
        """One label image, counted."""
        labels = read_raw(file)
        codes = labels.values if labels.values is not None else labels.colors
        self.counted(() if codes is None else codes.shape)
        return labels

    def binary(self, file: Path) -> NDArray[np.bool_]:
        """One mask, counted."""
        mask = read_binary(file)
        self.counted(mask.shape)
        return mask

    def matched(self, files: list[Path]) -> dict[int, Path]:
        """Files by view; two files for one view are refused."""
        found: dict[int, Path] = {}
        for file in files:
            index = self.names.find(file.relative_to(self.path).as_posix())
            if index is None:
                continue
            if index in found:
                raise InputError(
                    f"{file} and {found[index]} both mean the photograph {self.names.names[index]}",
                    "keep one label file per photograph",
                )
            found[index] = file
        if not found:
            raise self.names.no_match(str(self.path), [file.name for file in files])
        return found

    def leftover(self, files: list[Path], found: dict[int, Path]) -> list[str]:
        """A note on files that belong to no photograph."""
        spare = len(files) - len(found)
        return [f"{spare} files of {self.path.name} belong to no photograph"] if spare else []

    def finished(
        self,
        maps: Mapping[int, NDArray[np.signedinteger[Any]]],
        labels: dict[int, str],
        notes: list[str],
        *,
        linked: bool = True,
    ) -> Segmentation:
        """Bring the maps to the photographs' pinhole views."""
        if linked and not any((value > 0).any() for value in maps.values()):
            raise InputError(
                f"{self.path}: nothing is labelled in any of {len(maps)} files",
                "0 and black mean nothing; give the parts other values",
            )
        views, resized = [], 0
        for index in sorted(maps):
            camera, value = self.capture.cameras[index], maps[index].astype(np.int32)
            height, width = value.shape
            if (width, height) != (camera.width, camera.height):
                if abs(width * camera.height / (height * camera.width) - 1) > _ASPECT:
                    raise InputError(
                        f"{self.path}: the labels of {camera.name} are {width} x {height}, the "
                        f"photograph is {camera.width} x {camera.height}",
                        "segment the photographs that were posed, uncropped and not turned",
                    )
                resized += 1
            pinhole, moved = pinhole_map(camera, value, self.max_size)
            views.append(LabelView(pinhole, moved))
        if resized:
            notes = [*notes, f"{resized} maps have another size than their photograph: resized"]
        without = len(self.capture) - len(views)
        if without:
            notes = [*notes, f"{without} of {len(self.capture)} photographs have no labels"]
        return Segmentation(str(self.path), tuple(views), labels, linked, tuple(notes))


def load_segmentation(
    path: str | Path, capture: Capture, *, max_size: int | None = 640, least: float = 0.0
) -> Segmentation:
    """Read the segmentation of a capture's photographs.

    Args:
        path: A folder of label images; of folders of masks, one per label; of Segment Anything's
            folders or JSON files, one per photograph; or one ``.json``, ``.npz`` (a map per
            photograph's name) or ``.npy`` ([views, H, W]).
        capture: The photographs that the files are named after; some may have none.
        max_size: Longest side of the maps [pixels]; None keeps the files' size.
        least: Lowest ``predicted_iou`` and ``stability_score`` of Segment Anything's masks.

    Returns:
        The maps. A folder may hold ``labels.json``, names for numbers or colours:
        ``{"1": "rind", "#ff0000": "leaf"}``.

    Raises:
        InputError: Nothing fits the photographs' names, or a file is damaged, of another shape than
            its photograph, or no segmentation.
    """
    path = Path(path)
    wanted = _Wanted(path, capture, ViewNames(capture), max_size, least)
    names = wanted.names
    if not path.exists():
        raise InputError(f"{path}: no such segmentation", "check the path")
    if path.is_file():
        return _of_file(wanted)
    entries = sorted(path.iterdir())
    if not entries:
        raise InputError(f"{path}: the folder is empty", "put one label image per photograph there")
    folders = [entry for entry in entries if entry.is_dir()]
    tables = [e for e in entries if e.suffix.lower() == ".json" and e.name != _NAMES_FILE]
    if folders and any((f / "metadata.csv").is_file() for f in folders):
        return _sam_folders(wanted, folders)
    if folders and not any(e.suffix.lower() in LABEL_SUFFIXES for e in entries if e.is_file()):
        per_image = [f for f in folders if names.find(f.name) is not None]
        if per_image and not any(
            names.find(x.name) is not None for f in per_image for x in f.iterdir()
        ):
            return _sam_folders(wanted, folders)
        if not _mirrors(path, folders, names):
            return _label_folders(wanted, folders)
    if tables:
        items: dict[str, Any] = {}
        for table in tables:
            items |= sam.read_json(table)
        return _sam_items(wanted, items)
    return _label_images(wanted)


def load_masks(path: str | Path, capture: Capture, *, max_size: int | None = 640) -> Segmentation:
    """Read one part's masks, one per photograph: white is the part, black is not.

    Args:
        path: Folder of masks named like the photographs.
        capture: The photographs.
        max_size: Longest side of the maps [pixels].

    Returns:
        A segmentation with the one label 1, named after the folder.

    Raises:
        InputError: As :func:`load_segmentation`.
    """
    path = Path(path)
    wanted = _Wanted(path, capture, ViewNames(capture), max_size)
    if not path.is_dir():
        raise InputError(f"{path}: no such folder of masks", "name a folder, one mask per photo")
    files = [f for f in sorted(path.rglob("*")) if f.suffix.lower() in _MASK_SUFFIXES]
    found = wanted.matched(files)
    maps = {index: wanted.binary(file).astype(np.int32) for index, file in found.items()}
    return wanted.finished(maps, {1: path.name}, wanted.leftover(files, found))


def _label_images(wanted: _Wanted) -> Segmentation:
    path = wanted.path
    files = [
        f
        for f in sorted(path.rglob("*"))
        if f.suffix.lower() in (*LABEL_SUFFIXES, ".jpg", ".jpeg") and f.is_file()
    ]
    found = wanted.matched(files)
    maps, labels, notes = numbered([wanted.raw(file) for file in found.values()])
    notes = [*notes, *wanted.leftover(files, found)]
    labels = _renamed(path / _NAMES_FILE, labels)
    return wanted.finished(dict(zip(found, maps, strict=True)), labels, notes)


def _label_folders(wanted: _Wanted, folders: list[Path]) -> Segmentation:
    """A folder per label, named after it; a pixel that several masks claim shows none of them."""
    maps: dict[int, NDArray[np.int64]] = {}
    claims: dict[int, NDArray[np.int64]] = {}
    labels, notes, files = {}, [], []
    for number, folder in enumerate(folders, 1):
        labels[number] = folder.name
        inside = [f for f in sorted(folder.rglob("*")) if f.suffix.lower() in _MASK_SUFFIXES]
        files += [f"{folder.name}/{f.name}" for f in inside]
        for file in inside:
            index = wanted.names.find(file.relative_to(folder).as_posix())
            if index is None:
                continue
            mask = wanted.binary(file)
            if index in maps and maps[index].shape != mask.shape:
                raise InputError(
                    f"{file}: the mask is {mask.shape[1]} x {mask.shape[0]}, another label's is "
                    f"{maps[index].shape[1]} x {maps[index].shape[0]}",
                    "export all masks of a photograph at one size",
                )
            maps.setdefault(index, np.zeros(mask.shape, np.int64))[mask] = number
            claims.setdefault(index, np.zeros(mask.shape, np.int64))[mask] += 1
    if not maps:
        raise wanted.names.no_match(str(wanted.path), files)
    twice = sum(int((count > 1).sum()) for count in claims.values())
    if twice:
        share = twice / max(sum(int((count > 0).sum()) for count in claims.values()), 1)
        notes.append(f"{100 * share:.1f} % of the masked pixels belong to several labels: no vote")
        for index, count in claims.items():
            maps[index][count > 1] = -1
    return wanted.finished(maps, labels, notes)


def _sam_folders(wanted: _Wanted, folders: list[Path]) -> Segmentation:
    found = {wanted.names.find(folder.name): folder for folder in folders}
    found.pop(None, None)
    if not found:
        raise wanted.names.no_match(str(wanted.path), [folder.name for folder in folders])
    maps = {i: sam.read_mask_folder(f, wanted.least) for i, f in found.items() if i is not None}
    return wanted.finished(maps, {}, [], linked=False)


def _sam_items(wanted: _Wanted, items: dict[str, Any]) -> Segmentation:
    source, names = str(wanted.path), wanted.names
    maps, kinds = {}, {}
    for name, found in items.items():
        index = names.find(name)
        if index is None:
            continue
        masks, labels = sam.json_masks(found, f"{source}: {name}", wanted.least)
        if masks:
            wanted.counted(masks[0].shape)
            maps[index] = sam.painted(masks, f"{source}: {name}")
            kinds[index] = labels
    if not maps:
        raise names.no_match(source, items)
    known = sorted({label for labels in kinds.values() for label in labels if label is not None})
    if known and all(None not in labels for labels in kinds.values()):
        # every mask says what it shows (COCO's categories): the same number in all photographs
        number = {label: k for k, label in enumerate(known, 1)}
        for index, labels in kinds.items():
            maps[index] = np.array([0, *(number[str(label)] for label in labels)])[maps[index]]
        names_of = {k: label for label, k in number.items()}
        return wanted.finished(maps, names_of, [])
    return wanted.finished(maps, {}, [], linked=False)


def _of_file(wanted: _Wanted) -> Segmentation:
    path, capture, names = wanted.path, wanted.capture, wanted.names
    suffix = path.suffix.lower()
    if suffix == ".json":
        return _sam_items(wanted, sam.read_json(path))
    if suffix not in (".npy", ".npz"):
        raise InputError(
            f"{path}: a segmentation must be a folder, .json, .npy or .npz",
            "see docs/guide/regions.md",
        )
    arrays = read_npz(path) if suffix == ".npz" else {"": read_npy(path)}
    maps: dict[int, NDArray[np.int64]] = {}
    if suffix == ".npy":
        stack = arrays[""]
        if stack.ndim != 3 or stack.shape[0] != len(capture):
            raise InputError(
                f"{path}: label maps must be [{len(capture)} views, H, W], got {list(stack.shape)}",
                "use an .npz with one map per photograph's name for some of the views",
            )
        maps = {index: whole_labels(stack[index], path) for index in range(len(capture))}
    else:
        for name, value in arrays.items():
            index = names.find(name)
            if index is None:
                continue
            if value.ndim != 2 or value.size == 0:
                raise InputError(
                    f"{path}: {name} must be [H, W], got {list(value.shape)}", "save label maps"
                )
            maps[index] = whole_labels(value, f"{path}: {name}")
        if not maps:
            raise names.no_match(str(path), arrays)
    present = sorted({int(n) for value in maps.values() for n in np.unique(value)} - {0})
    labels = _renamed(path.with_suffix(".labels.json"), {n: str(n) for n in present})
    return wanted.finished(maps, labels, [])


def _label(value: Any, table: Path) -> str:
    """A label's name out of ``labels.json``."""
    if not isinstance(value, str | int | float):
        raise InputError(f"{table}: a name must be text, got {short(value)}", "mend the file")
    return str(value)


def _mirrors(path: Path, folders: list[Path], names: ViewNames) -> bool:
    """Whether sub-folders repeat those of the photographs (camera folders), not labels."""
    files = [f for folder in folders for f in folder.rglob("*") if f.suffix in LABEL_SUFFIXES]
    relative = [f.relative_to(path).as_posix() for f in files]
    ours = {name.rsplit(".", 1)[0] for name in names.names}
    return any(r.rsplit(".", 1)[0] in ours for r in relative)


def _renamed(table: Path, labels: dict[int, str]) -> dict[int, str]:
    """Names out of ``labels.json``: number, colour or present name -> name."""
    if not table.is_file():
        return labels
    given = read_json(table, "mend the file")
    if not isinstance(given, dict):
        raise InputError(
            f'{table}: names must be a mapping like {{"1": "rind"}}, got {short(given)}',
            "mend the file",
        )
    new = {str(key).lower(): _label(value, table) for key, value in given.items()}
    return {n: new.get(name.lower(), new.get(str(n), name)) for n, name in labels.items()}
