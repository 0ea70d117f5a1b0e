"""What a solid is made of: a table of its parts or regions, and a picture of them."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gsfluent.data import Frame, Solid
from gsfluent.data.regions import FIRST_LABEL, INCLUSION, region_entry, source_key
from gsfluent.pipeline.matter.points import POINTS_PER_CELL, sample_points, select
from gsfluent.scene.scene import Body, Part


@dataclasses.dataclass(frozen=True)
class PartMap:
    """The parts of one solid."""

    solid: Solid  # the solid
    frame: Frame  # world to scene
    # row of the table per voxel, int32 [X, Y, Z]; row 0 is the rest, -1 outside.
    label: NDArray[np.int32]
    # one per part: ``part``, ``number``, ``material``, ``volume`` [m^3], ``share``, ``particles``,
    # ``mean_depth`` [m] and ``agreement`` (share of the votes of the photographs); None for what
    # does not apply.
    rows: list[dict[str, Any]]
    warnings: list[str]  # what a user should look at


def body_parts(body: Body, dx: float | None = None) -> PartMap:
    """Find the parts of a body of a scene.

    Args:
        body: A body with a solid; labels that its parts need are projected already
            (``Scene.add`` does).
        dx: Grid spacing [m], to count material points; None leaves them out.

    Raises:
        InputError: A part's condition cannot be met by this solid.
    """
    solid = body.solid
    assert solid is not None
    index = solid.occupancy.nonzero()
    centers = solid.voxel_centers(index).to("cpu", torch.float64)
    which = _rows_of(body, centers)
    label = np.full(tuple(solid.occupancy.shape), -1, np.int32)
    label[tuple(index.cpu().numpy().T)] = which
    points = None
    if dx is not None:
        step = dx / POINTS_PER_CELL ** (1 / 3) / body.frame.scale
        found = _rows_of(body, sample_points(solid, step))
        points = np.bincount(found, minlength=len(body.parts) + 1)
    names: list[tuple[str, str, float | None]] = [(body.name, body.material.name, None)]
    for part in body.parts:
        names.append((part.name, _material(part, body), _agreement(solid, part)))
    rows = _rows(solid, body.frame, label, names)
    for number, row in enumerate(rows):
        row["particles"] = None if points is None else int(points[number])
    empty = [row["part"] for row in rows[1:] if row["volume"] == 0.0]
    warnings = [f"part {name!r} holds no matter: loosen its conditions" for name in empty]
    return PartMap(solid, body.frame, label, rows, warnings)


def solid_regions(solid: Solid) -> PartMap:
    """Find the numbered regions of a solid; its inclusions share one row."""
    occupied = solid.occupancy.cpu().numpy()
    label = np.where(occupied, 0, -1).astype(np.int32)
    names: list[tuple[str, str, float | None]] = [("rest", "-", None)]
    numbers = [0]
    if solid.regions is not None:
        regions = solid.regions.cpu().numpy()
        present = [int(n) for n in np.unique(regions[occupied]) if n > 0]
        inside = [n for n in present if n < FIRST_LABEL]
        if inside:
            label[occupied & (regions > 0) & (regions < FIRST_LABEL)] = 1
            names.append((f"{INCLUSION} ({len(inside)})", "-", None))
            numbers.append(inside[0])
        for number in (n for n in present if n >= FIRST_LABEL):
            label[occupied & (regions == number)] = len(names)
            entry = region_entry(solid, number)
            votes = [
                _vote(solid, key, str(of["number"])) for key, of in entry.get("of", {}).items()
            ]
            known = [vote for vote in votes if vote is not None]
            names.append((entry["name"], "-", min(known) if known else None))
            numbers.append(number)
    frame = solid.frame or Frame.identity()
    rows = _rows(solid, frame, label, names)
    for row, number in zip(rows, numbers, strict=True):
        row["number"], row["particles"] = number, None
    return PartMap(solid, frame, label, rows, [])


def _rows_of(body: Body, points: torch.Tensor) -> NDArray[np.int64]:
    """Row of each point: the last part that holds it, 0 for none."""
    which = np.zeros(len(points), np.int64)
    for number, part in enumerate(body.parts, 1):
        which[select(part, body, points).numpy()] = number
    return which


def _rows(
    solid: Solid, frame: Frame, label: NDArray[np.int32], names: list[tuple[str, str, float | None]]
) -> list[dict[str, Any]]:
    matter = label >= 0
    count = np.bincount(label[matter], minlength=len(names))
    depth = np.bincount(
        label[matter], weights=solid.depth.cpu().numpy()[matter], minlength=len(names)
    )
    edge = solid.voxel * frame.scale
    return [
        {
            "part": name,
            "number": number,
            "material": material,
            "volume": float(count[number] * edge**3),
            "share": float(count[number] / max(int(matter.sum()), 1)),
            "particles": None,
            "mean_depth": float(depth[number] / count[number] * frame.scale)
            if count[number]
            else None,
            "agreement": agreement,
        }
        for number, (name, material, agreement) in enumerate(names)
    ]


def _material(part: Part, body: Body) -> str:
    """The material a part starts from, and what it changes."""
    changes = dict(part.overrides)
    start = changes.pop("material", None)
    name = body.material.name if start is None else start if isinstance(start, str) else start.name
    said = ", ".join(
        f"{key} {value:g}" if isinstance(value, int | float) else f"{key} {value}"
        for key, value in changes.items()
        if isinstance(value, int | float | str)
    )
    return f"{name} ({said})" if said else name


def _agreement(solid: Solid, part: Part) -> float | None:
    """Mean share of the votes that the part's label got on the skin."""
    key = source_key(part.where)
    if key is None:
        return None
    source = (solid.report.get("region_sources") or {}).get(key, {})
    wanted = part.where.get("label")
    names = source.get("labels", {})
    exact = [n for n, name in names.items() if str(wanted) == name] or [
        n for n in names if str(wanted) == n
    ]
    numbers = exact if wanted is not None else list(names)
    votes = [vote for n in numbers if (vote := _vote(solid, key, n)) is not None]
    return float(np.mean(votes)) if votes else None


def _vote(solid: Solid, key: str, number: str) -> float | None:
    source = (solid.report.get("region_sources") or {}).get(key, {})
    value = source.get("agreement", {}).get(number)
    return None if value is None else float(value)
