"""A label image of a solid: projected along an axis, or read as a cut whose parts follow depth."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsfluent.data import Frame, Solid
from gsfluent.errors import InputError
from gsfluent.io.segmentation.files import RawLabels, numbered, read_raw
from gsfluent.spatial.voxels import distance_transform

_AXES = {"x": (1, 2), "y": (0, 2), "z": (0, 1)}
"""Scene axes that run right and up in a picture taken along each axis, as in ``interior.png``."""
_BINS = 64


def image_labels(
    solid: Solid, images: Mapping[str, Path], frame: Frame | None = None
) -> tuple[NDArray[np.int32], dict[int, str], list[str]]:
    """Label the matter by pictures.

    Args:
        solid: The solid.
        images: Picture per axis ``x``, ``y``, ``z`` of the scene: its edges (of what is opaque, if
            anything is transparent) are those of the object's box, and every pixel labels all the
            matter behind it; with several axes, what they agree on by name. Or one picture under
            ``""``: a cut through such an object, whose labels follow the depth below the surface.
        frame: World to scene; default that of the solid, or none.

    Returns:
        Label per voxel, int32 [X, Y, Z], the names of the labels, and notes.

    Raises:
        InputError: A picture cannot be read or holds no label.
    """
    read = {axis: read_raw(Path(path)) for axis, path in images.items()}
    found: list[tuple[NDArray[np.int64], dict[int, str]]] = []
    notes: list[str] = []
    for axis, raw in read.items():
        (flat,), names, more = numbered([raw])
        if not (flat > 0).any():
            raise InputError(f"{raw.path}: nothing is labelled", "paint the parts; black is none")
        notes += more
        if axis == "":
            volume, missed = _by_depth(solid, flat, raw)
            lost = [names[n] for n in missed if n in names]
            if lost:
                notes.append(f"{raw.path.name}: no depth is mostly {', '.join(lost)}: left out")
        else:
            volume = _along(solid, axis, flat, raw, frame or solid.frame or Frame.identity())
        found.append((volume, names))
    all_names = sorted({name for _, names in found for name in names.values()}, key=_order)
    number = {name: index for index, name in enumerate(all_names, 1)}
    maps = [_renumbered(volume, names, number) for volume, names in found]
    agreed = maps[0]
    for other in maps[1:]:
        agreed = np.where(agreed == other, agreed, 0)
    return agreed.astype(np.int32), {index: name for name, index in number.items()}, notes


def _order(name: str) -> tuple[int, str]:
    return (int(name), "") if name.isdigit() else (1 << 40, name)


def _renumbered(
    volume: NDArray[np.int64], names: dict[int, str], number: dict[str, int]
) -> NDArray[np.int64]:
    table = np.zeros(max([0, *names, int(volume.max(initial=0))]) + 1, dtype=np.int64)
    for old, name in names.items():
        table[old] = number[name]
    return table[volume]


def _along(
    solid: Solid, axis: str, flat: NDArray[np.int64], raw: RawLabels, frame: Frame
) -> NDArray[np.int64]:
    """Every voxel's label is that of the pixel it stands behind."""
    across, up = _AXES[axis]
    index = solid.occupancy.nonzero()
    place = frame.apply(solid.voxel_centers(index).double().cpu()).numpy()
    half = 0.5 * solid.voxel * frame.scale
    low, high = place.min(axis=0) - half, place.max(axis=0) + half
    top, left, rows, columns = 0, 0, *flat.shape
    if raw.opaque is not None and raw.opaque.any():
        filled_rows = np.flatnonzero(raw.opaque.any(axis=1))
        filled_columns = np.flatnonzero(raw.opaque.any(axis=0))
        top, left = int(filled_rows[0]), int(filled_columns[0])
        rows = int(filled_rows[-1]) + 1 - top
        columns = int(filled_columns[-1]) + 1 - left
    right = (place[:, across] - low[across]) / (high[across] - low[across])
    down = (high[up] - place[:, up]) / (high[up] - low[up])
    row = top + np.floor(down * rows).astype(int).clip(0, rows - 1)
    column = left + np.floor(right * columns).astype(int).clip(0, columns - 1)
    volume = np.zeros(tuple(solid.occupancy.shape), dtype=np.int64)
    volume[tuple(index.cpu().numpy().T)] = flat[row, column]
    return volume


def _by_depth(
    solid: Solid, flat: NDArray[np.int64], raw: RawLabels
) -> tuple[NDArray[np.int64], list[int]]:
    """Each depth, relative to the deepest point, has the label that is most frequent there."""
    outline = raw.opaque if raw.opaque is not None else flat > 0
    distance = distance_transform(np.pad(outline, 1))[1:-1, 1:-1]
    share = (distance[outline] - 0.5) / max(float(distance.max()) - 0.5, 0.5)
    bins = np.floor(share * _BINS).astype(int).clip(0, _BINS - 1)
    labels, column = np.unique(flat[outline], return_inverse=True)
    counts = np.zeros((_BINS, len(labels)))
    np.add.at(counts, (bins, column.reshape(-1)), 1.0)
    # a small picture leaves depths empty: they look like the nearest one that is not
    filled = np.flatnonzero(counts.sum(axis=1) > 0)
    nearest = filled[np.abs(np.arange(_BINS)[:, None] - filled).argmin(axis=1)]
    profile = labels[counts[nearest].argmax(axis=1)]
    occupied = solid.occupancy.cpu().numpy()
    depth = solid.depth.cpu().numpy()
    deepest = float(depth.max()) if occupied.any() else 0.0
    place = np.floor(depth / max(deepest, 1e-12) * _BINS).astype(int).clip(0, _BINS - 1)
    missed = sorted(set(labels.tolist()) - set(profile.tolist()) - {0})
    return np.where(occupied, profile[place], 0), missed
