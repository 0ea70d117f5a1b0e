"""The table of a solid's regions: what each number in ``Solid.regions`` means.

``solid.report["regions"]`` maps a number (as text, JSON has no other keys) to ``name``, ``kind``
and, for labels, ``of``: for each source of labels (:func:`source_key`) its own ``number`` and
``name`` there. Numbers below :data:`FIRST_LABEL` are the texture's inclusions (seeds, stones), one
each; they need no entry. Two sources may overlap: every combination that occurs has its own number.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from gsfluent.data import Solid
from gsfluent.errors import InputError

FIRST_LABEL = 100_001
"""Numbers from here on are labels; inclusions are below."""
INCLUSION = "inclusion"
SOURCES = ("mask", "labels", "label_image")
"""Conditions of a part that need labels to be projected."""


def source_key(where: Mapping[str, Any]) -> str | None:
    """Name of the source of labels that a part's conditions speak of, None when of none."""
    paths = source_paths(where)
    if not paths:
        return None
    kind = next(name for name in SOURCES if name in where)
    return ";".join([kind, *(f"{axis}={path}" for axis, path in sorted(paths.items()))])


def source_paths(where: Mapping[str, Any]) -> dict[str, Path]:
    """Files of the source, by axis (``""`` where there is none), absolute."""
    for kind in SOURCES:
        if kind in where:
            value = where[kind]
            given = value if isinstance(value, Mapping) else {"": value}
            return {str(axis): Path(path).resolve() for axis, path in given.items()}
    return {}


def with_inclusions(
    solid: Solid, inclusions: NDArray[np.int32]
) -> tuple[Tensor | None, dict[str, Any]]:
    """Regions of a solid after inclusions were placed in it; labels elsewhere stay.

    Args:
        solid: The solid before.
        inclusions: Number per voxel from 1, int32 [X, Y, Z]; 0 for none.

    Returns:
        The regions, and the parts of the report that say what they mean.
    """
    import torch

    kept = ("regions", "region_sources")
    table: dict[str, Any] = {key: solid.report[key] for key in kept if key in solid.report}
    if not inclusions.any():
        return solid.regions, table
    placed = torch.from_numpy(inclusions).to(solid.occupancy.device)
    if solid.regions is None:
        return placed, table
    labels = torch.where(solid.regions >= FIRST_LABEL, solid.regions, 0)
    return torch.where(placed > 0, placed, labels).to(torch.int32), table


def region_entry(solid: Solid, number: int) -> dict[str, Any]:
    """What the table says about a number."""
    table = solid.report.get("regions") or {}
    entry = table.get(str(number))
    if isinstance(entry, dict):
        return entry
    if 0 < number < FIRST_LABEL:
        return {"name": INCLUSION, "kind": INCLUSION}
    return {"name": f"region {number}", "kind": "region"}


def require_labels(solid: Solid, where: Mapping[str, Any], part: str) -> None:
    """Refuse a part whose conditions ask for labels that were not projected onto the solid.

    Raises:
        InputError: It asks for such labels.
    """
    key = source_key(where)
    if key is not None and key not in (solid.report.get("region_sources") or {}):
        files = ", ".join(map(str, source_paths(where).values()))
        raise InputError(
            f"part {part!r}: the labels of {files} were not projected onto this solid",
            "solid = gf.pipeline.Regions(parts)(solid, capture)",
        )


def region_mask(solid: Solid, where: Mapping[str, Any], part: str) -> NDArray[np.bool_]:
    """Voxels that fulfil ``mask``, ``labels``, ``label_image`` and ``label``, bool [X, Y, Z].

    Args:
        solid: The solid.
        where: The conditions of a part.
        part: Its name, for messages.

    Raises:
        InputError: The labels were not projected onto this solid, or have no such label.
    """
    key, label = source_key(where), where.get("label")
    regions = None if solid.regions is None else solid.regions.cpu().numpy()
    present = [] if regions is None else [int(n) for n in np.unique(regions) if n > 0]
    entries = {number: region_entry(solid, number) for number in present}
    if key is not None:
        require_labels(solid, where, part)
        names = solid.report["region_sources"][key]["labels"]
        if label is not None and not _known(label, names):
            raise InputError(
                f"part {part!r}: there is no label {label!r}",
                f"labels here: {', '.join(names.values())}",
            )
        chosen = [
            number
            for number, entry in entries.items()
            if key in entry.get("of", {}) and _fits(label, entry["of"][key])
        ]
    else:
        chosen = [
            number
            for number, entry in entries.items()
            if label in (entry["name"], entry["kind"])
            or any(_fits(label, of) for of in entry.get("of", {}).values())
        ]
        if not chosen:
            known = sorted(
                {entry["name"] for entry in entries.values()}
                | {of["name"] for entry in entries.values() for of in entry.get("of", {}).values()}
            )
            raise InputError(
                f"part {part!r}: the solid has no region called {label!r}",
                f"regions here: {', '.join(known)}"
                if known
                else "name the files, too: mask, labels or label_image",
            )
    if regions is None:
        return np.zeros(tuple(solid.occupancy.shape), bool)
    return np.isin(regions, chosen)


def _known(label: Any, names: Mapping[str, str]) -> bool:
    return any(str(label) in (number, name) for number, name in names.items())


def _fits(label: Any, of: Mapping[str, Any]) -> bool:
    """Whether a label means this entry; a name counts before a number."""
    return label is None or str(label) == of["name"] or str(label) == str(of["number"])


def source_volume(solid: Solid, key: str) -> NDArray[np.int64]:
    """A source's own label per voxel, int64 [X, Y, Z], as the table tells it; 0 for none."""
    if solid.regions is None:
        return np.zeros(tuple(solid.occupancy.shape), np.int64)
    numbers, back = np.unique(solid.regions.cpu().numpy(), return_inverse=True)
    own = [
        int(region_entry(solid, int(n)).get("of", {}).get(key, {"number": 0})["number"])
        for n in numbers
    ]
    return np.array(own, dtype=np.int64)[back].reshape(tuple(solid.occupancy.shape))
