"""Regions: labels of photographs and pictures become parts of a solid, each with its material."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gsfluent.data import Capture, Frame, Solid
from gsfluent.data.regions import FIRST_LABEL, source_key, source_paths, source_volume
from gsfluent.errors import InputError
from gsfluent.io.segmentation.masks import Segmentation, load_masks, load_segmentation
from gsfluent.pipeline.regions.associate import associate
from gsfluent.pipeline.regions.image import image_labels
from gsfluent.pipeline.regions.spread import (
    UNSEEN,
    carry_inwards,
    decide,
    label_field,
    nearest_skin,
)
from gsfluent.pipeline.regions.vote import Skin, cast_votes, find_skin
from gsfluent.progress import Progress

_log = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True)
class SkinLabels:
    """What the photographs say about a solid's skin."""

    skin: Skin  # the voxels
    # label per voxel, int64 [S]: 0 for none, -1 where no photograph shows it.
    label: NDArray[np.int64]
    # share of the votes that the label got, float32 [S]; 0 where it got none.
    share: NDArray[np.float32]
    # what the inside is labelled from (:func:`label_field`), float32 [S, L + 2].
    field: NDArray[np.float32]
    segmentation: Segmentation  # the labels, linked between views

    @property
    def numbers(self) -> NDArray[np.int64]:
        """Label of each column of votes: 0, then the segmentation's in order."""
        return np.array([0, *sorted(self.segmentation.names)], dtype=np.int64)

    def inside(
        self,
        solid: Solid,
        nearest: tuple[NDArray[np.int64], NDArray[np.float32]] | None = None,
    ) -> NDArray[np.int64]:
        """Label per voxel of the solid, int64 [X, Y, Z], each that of the skin nearest to it.

        Args:
            solid: The solid whose skin this is.
            nearest: What :func:`nearest_skin` found, when known.
        """
        found = nearest_skin(solid, self.skin) if nearest is None else nearest
        return self.numbers[carry_inwards(solid, self.field, found)]

    def report(self) -> dict[str, Any]:
        """Figures for ``region_sources``: views, what was seen, agreement per label."""
        names = {0: "none", **self.segmentation.names}
        agreement = {}
        for number in names:
            chosen = (self.label == number) & (self.share > 0)
            if chosen.any():
                agreement[str(number)] = float(self.share[chosen].mean())
        return {
            "views": len(self.segmentation.views),
            "unseen": float((self.label == UNSEEN).mean()),
            "agreement": agreement,
            "notes": list(self.segmentation.notes),
        }


def project_labels(
    solid: Solid,
    segmentation: Segmentation,
    *,
    skin: Skin | None = None,
    margin: float = 0.1,
    reach: int = 3,
    progress: Progress | None = None,
) -> SkinLabels:
    """Vote the labels of photographs onto a solid's skin.

    Args:
        solid: The solid, in the world of the photographs' cameras.
        segmentation: Label maps; instances are linked between views first.
        skin: What :func:`find_skin` found, when known.
        margin: Lead that a label needs, as a share of a voxel's votes; below it, the neighbours
            decide.
        reach: How far labels spread over skin that no photograph shows [voxels].
        progress: Optional callback.

    Returns:
        The labels.

    Raises:
        InputError: No labelled photograph shows the solid.
    """
    skin = find_skin(solid) if skin is None else skin
    linked = associate(skin, segmentation, progress)
    votes = cast_votes(skin, linked, progress)
    column, share = decide(skin, votes, margin=margin, reach=reach)
    numbers = np.array([0, *sorted(linked.names)], dtype=np.int64)
    label = np.where(column == UNSEEN, UNSEEN, numbers[column.clip(min=0)])
    return SkinLabels(skin, label, share, label_field(skin, votes, column), linked)


def label_regions(
    solid: Solid,
    sources: Iterable[Mapping[str, Any]],
    capture: Capture | None = None,
    *,
    frame: Frame | None = None,
    progress: Progress | None = None,
) -> Solid:
    """Write the labels of photographs and pictures into ``Solid.regions``.

    Inside, matter has the label of the skin nearest to it (through and through); a part that is
    only skin-deep says so itself with ``depth_below``. Inclusions of the texture keep their numbers
    and belong to no label.

    Args:
        solid: The filled solid, in the world of the capture.
        sources: Each ``{"mask": folder}``, ``{"labels": path}`` or ``{"label_image": file}`` /
            ``{"label_image": {axis: file}}``, as among a part's conditions; other keys are
            ignored, sources named twice are read once.
        capture: The photographs that masks and labels belong to.
        frame: World to scene, for the axes of label images; default that of the solid.
        progress: Optional callback.

    Returns:
        The solid with ``regions``, their table in ``report["regions"]``
        (:mod:`gsfluent.data.regions`) and figures per source in
        ``report["region_sources"]``.

    Raises:
        InputError: A source cannot be read, fits no photograph, or needs a capture.
    """
    wanted = {key: where for where in sources if (key := source_key(where)) is not None}
    if not wanted:
        return solid
    if capture is None and any("label_image" not in where for where in wanted.values()):
        raise InputError(
            "regions: masks and labels need the photographs they belong to, got no capture",
            "give capture=load_capture(folder); in a shot, start from a capture",
        )
    reports = {
        key: value
        for key, value in (solid.report.get("region_sources") or {}).items()
        if key not in wanted
    }
    volumes = {key: source_volume(solid, key) for key in reports}
    skin: Skin | None = None
    nearest: tuple[NDArray[np.int64], NDArray[np.float32]] | None = None
    for key, where in wanted.items():
        paths = source_paths(where)
        if "label_image" in where:
            volume, names, notes = image_labels(solid, paths, frame)
            volumes[key] = volume.astype(np.int64)
            reports[key] = {"labels": {str(n): name for n, name in names.items()}, "notes": notes}
            continue
        assert capture is not None
        read = load_masks if "mask" in where else load_segmentation
        segmentation = read(paths[""], capture)
        if skin is None:
            skin = find_skin(solid)
            nearest = nearest_skin(solid, skin)
        found = project_labels(solid, segmentation, skin=skin, progress=progress)
        volumes[key] = found.inside(solid, nearest)
        names = found.segmentation.names
        reports[key] = {"labels": {str(n): name for n, name in names.items()}, **found.report()}
        for note in found.segmentation.notes:
            _log.info("regions: %s: %s", segmentation.source, note)
    return _written(solid, volumes, reports)


def _written(
    solid: Solid, volumes: dict[str, NDArray[np.int64]], reports: dict[str, dict[str, Any]]
) -> Solid:
    """Number every combination of labels that occurs and keep the inclusions' numbers."""
    keys = sorted(volumes)
    before = None if solid.regions is None else solid.regions.cpu().numpy()
    occupied = solid.occupancy.cpu().numpy()
    if before is not None:
        occupied = occupied & ~((before > 0) & (before < FIRST_LABEL))
    stacked = np.stack([volumes[key][occupied] for key in keys], axis=1)
    combos, back = np.unique(stacked, axis=0, return_inverse=True)
    rank = np.cumsum(combos.any(axis=1))  # 0 for the combination without any label
    numbers = np.where(combos.any(axis=1), FIRST_LABEL - 1 + rank, 0)
    regions = np.zeros(occupied.shape, np.int32)
    regions[occupied] = numbers[back.reshape(-1)]
    table = {
        number: entry
        for number, entry in (solid.report.get("regions") or {}).items()
        if int(number) < FIRST_LABEL
    }
    if before is not None:
        inclusion = (before > 0) & (before < FIRST_LABEL)
        regions[inclusion] = before[inclusion]
    for combo, number in zip(combos.tolist(), numbers.tolist(), strict=True):
        of = {
            key: {"number": own, "name": reports[key]["labels"].get(str(own), str(own))}
            for key, own in zip(keys, combo, strict=True)
            if own
        }
        if of:
            name = " + ".join(item["name"] for item in of.values())
            table[str(number)] = {"name": name, "kind": "label", "of": of}
    return solid.replace(
        regions=torch.from_numpy(regions).to(solid.occupancy.device),
        report={**solid.report, "regions": table, "region_sources": reports},
    )
