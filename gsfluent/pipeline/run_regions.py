"""The stage of a run that projects masks and label images onto the solids."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsfluent.data import Solid
from gsfluent.errors import InputError
from gsfluent.io import atomic_path, write_json
from gsfluent.io.solid import load_solid
from gsfluent.pipeline.regions import label_regions
from gsfluent.pipeline.regions_table import source_key, source_paths
from gsfluent.pipeline.run_context import RunContext
from gsfluent.pipeline.run_store import content_digest, fingerprint

__all__ = ["load_solids", "regions_stage"]

_KEYS = ("regions", "region_sources")


def _sources(context: RunContext) -> dict[str, list[dict[str, Any]]]:
    """Conditions that need labels, by object."""
    found = {
        name: [
            where
            for part in settings.parts or ()
            if source_key(where := part.where.given()) is not None
        ]
        for name, settings in context.shot.objects.items()
    }
    return {name: sources for name, sources in found.items() if sources}


def regions_stage(context: RunContext) -> None:
    """Labels for the solids: ``stages/regions/<object>.npz`` and ``.json``, where parts ask."""
    wanted = _sources(context)
    if not wanted:
        return
    content = {
        name: [
            [source_key(where), [content_digest(file) for file in source_paths(where).values()]]
            for where in sources
        ]
        for name, sources in wanted.items()
    }
    placing = context.frame.to_dict()  # label images are taken along the scene's axes
    key = fingerprint("regions", context.key(context.source_key, content, placing))

    def work(folder: Path) -> dict[str, Any]:
        reports = {}
        for name, sources in wanted.items():
            solid = load_solid(context.store.root / "texture" / f"{name}.ply").to(context.device)
            labelled = label_regions(
                solid,
                sources,
                context.capture,
                frame=context.frame,
                progress=context.reporter.task("regions"),
            )
            assert labelled.regions is not None
            with (
                atomic_path(folder / f"{name}.npz") as temporary,
                open(temporary, "wb") as stream,
            ):
                np.savez_compressed(stream, regions=labelled.regions.cpu().numpy())
            write_json(folder / f"{name}.json", {k: labelled.report[k] for k in _KEYS})
            reports[name] = labelled.report["region_sources"]
        return reports

    result = context.store.run("regions", key, work)
    context.record.values["regions"] = dict(result.report)
    context.source_key = result.fingerprint


def load_solids(context: RunContext) -> dict[str, Solid]:
    """The textured solids of the run's objects by name, with their labels where parts ask."""
    root, labelled = context.store.root, _sources(context)
    solids = {}
    for name in context.shot.objects:
        solid = load_solid(root / "texture" / f"{name}.ply")
        if name in labelled:
            solid = _with_labels(solid, root / "regions" / name)
        solids[name] = solid
    return solids


def _with_labels(solid: Solid, path: Path) -> Solid:
    import json
    import zipfile

    try:
        with np.load(path.with_name(path.name + ".npz"), allow_pickle=False) as data:
            regions = torch.from_numpy(data["regions"])
        table = json.loads(path.with_name(path.name + ".json").read_text(encoding="utf-8"))
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(
            f"{path}: the labels of the run are damaged ({error})",
            "remove the folder; the next run makes them again",
        ) from error
    return solid.replace(regions=regions, report={**solid.report, **table})
