"""``gsfluent inspect`` on a shot or a solid: its parts, before anything is simulated."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import torch

from gsfluent.config import Shot
from gsfluent.errors import InputError
from gsfluent.inspection.parts import PartMap, body_parts, solid_regions
from gsfluent.inspection.parts_picture import save_parts_picture
from gsfluent.io.solid import load_solid
from gsfluent.pipeline.matter.points import grid_spacing
from gsfluent.pipeline.simulate.stage import QUALITY
from gsfluent.progress import Reporter
from gsfluent.results.lock import locked
from gsfluent.stages.breaking import breaking_rows, landing_speed
from gsfluent.stages.simulate import build_scene
from gsfluent.stages.solids import context_of, load_solids, make_solids


def inspect_shot(
    shot: Shot,
    run: Path,
    out: Path | None = None,
    *,
    device: torch.device | str = "cpu",
    seed: int = 0,
    reporter: Reporter | None = None,
) -> dict[str, Any]:
    """Show the parts of a shot's objects.

    The stages up to the parts are done in the folder of the run, or found finished there;
    ``gsfluent run`` goes on from them.

    Args:
        shot: The shot.
        run: Folder of the run.
        out: PNG to write; with several objects ``<name>`` is added to its stem.
        device: Where the stages compute.
        seed: Seed of everything random.
        reporter: Receives progress; log lines by default.

    Returns:
        ``objects``: per object the rows of :class:`PartMap` as ``parts``, ``sources`` (what the
        photographs said), ``breaking`` (:func:`gsfluent.stages.breaking.breaking_rows`, of a fall
        onto the floor), ``warnings``, ``picture`` and, where a segmentation has several labels,
        ``labels_picture`` of them all.

    Raises:
        InputError: The shot is wrong, or a part asks for what the solid does not have.
    """
    context = context_of(shot, run, device, seed, reporter)
    with locked(run):
        make_solids(context)
    scene = build_scene(shot, load_solids(context), context.frame)
    dx = grid_spacing(scene, shot.solve.cells or QUALITY[shot.solve.quality])
    objects, pull = {}, math.hypot(*scene.gravity)
    bodies = [body for body in scene.bodies if body.solid is not None]
    for body in bodies:
        path = out
        if out is not None and len(bodies) > 1:
            path = out.with_name(f"{out.stem}_{body.name}{out.suffix}")
        shown = _shown(body_parts(body, dx), path, body.name, all_labels=True)
        rows = breaking_rows(body, landing_speed(body, scene), pull, dx)
        objects[body.name] = shown | {"breaking": rows}
    return {"kind": "shot", "run": str(run), "objects": objects}


def inspect_solid(path: Path, out: Path | None = None) -> dict[str, Any]:
    """Show the regions of a solid written by ``gsfluent fill`` or ``texture``.

    Raises:
        InputError: The solid cannot be read.
    """
    solid = load_solid(path)
    if solid.regions is None or not bool((solid.regions > 0).any()):
        raise InputError(f"{path}: the solid has no regions", "inspect the shot that has the parts")
    return _shown(solid_regions(solid), out, path.name)


def _shown(
    parts: PartMap, out: Path | None, title: str, *, all_labels: bool = False
) -> dict[str, Any]:
    sources = parts.solid.report.get("region_sources") or {}
    report: dict[str, Any] = {"parts": parts.rows, "sources": sources, "warnings": parts.warnings}
    if out is not None:
        save_parts_picture(parts, out, title)
        report["picture"] = str(out)
        if all_labels and any(len(source["labels"]) > 1 for source in sources.values()):
            # which of a segmenter's parts is which, before they are called by name
            beside = out.with_name(f"{out.stem}_labels{out.suffix}")
            save_parts_picture(solid_regions(parts.solid), beside, f"{title}: every label")
            report["labels_picture"] = str(beside)
    return report
