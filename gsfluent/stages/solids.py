"""The stages of a run that make solids: reconstruct, isolate, fill, texture."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsfluent.config import Shot
from gsfluent.data import Frame, Solid
from gsfluent.data.regions import source_key, source_paths
from gsfluent.errors import InputError
from gsfluent.io import atomic_path, load_capture, load_splats, write_json
from gsfluent.io.checked.arrays import read_npz
from gsfluent.io.checked.files import read_json
from gsfluent.io.solid import load_solid, save_solid
from gsfluent.io.splats.load import save_splats
from gsfluent.pipeline.capture.orient import Orientation, make_frame, orient
from gsfluent.pipeline.fill.mesh_skin import mesh_gaussians
from gsfluent.pipeline.fill.stage import Fill, fill_resolution, visible_extent
from gsfluent.pipeline.reconstruct.evaluate import write_report
from gsfluent.pipeline.reconstruct.isolate import Isolate
from gsfluent.pipeline.reconstruct.stage import Reconstruct
from gsfluent.pipeline.regions.stage import Regions
from gsfluent.pipeline.render.backdrop import no_background
from gsfluent.pipeline.render.cuts import save_cut_views
from gsfluent.pipeline.simulate.stage import QUALITY
from gsfluent.pipeline.texture import Texture
from gsfluent.progress import LineReporter, Reporter
from gsfluent.results.behind import Behind
from gsfluent.results.record import RunRecord, read_frame
from gsfluent.results.store import StageStore, content_digest, publish
from gsfluent.stages.context import RunContext
from gsfluent.stages.known import extended, is_solid, known_solid, parted, source_digest
from gsfluent.stages.select import select_mask

_log = logging.getLogger(__name__)


def reconstruct_stage(context: RunContext) -> None:
    """Photographs to Gaussians: ``stages/reconstruct/model.ply``."""
    shot = context.shot
    if shot.capture is None:
        return
    context.capture = load_capture(shot.capture)
    context.source_key = content_digest(shot.capture)
    capture = context.capture

    def work(folder: Path) -> dict[str, Any]:
        stage = Reconstruct(
            **shot.reconstruct.given(),
            checkpoint=folder / "training.pt",
            device=context.device,
            seed=context.seed,
        )
        gaussians = stage(capture, progress=context.reporter.task("reconstruct"))
        save_splats(gaussians, folder / "model.ply")
        write_report(folder, gaussians, capture)
        return dict(gaussians.report)

    context.do(
        "reconstruct",
        work,
        shot.reconstruct.given(),
        section="reconstruction",
        scratch=("training.pt",),
    )


def isolate_stage(context: RunContext) -> None:
    """The object apart from its background, and where it stands in the scene."""
    shot = context.shot
    if shot.capture is None:
        context.source_key = source_digest(shot)
    source = shot.splats or context.store.root / "reconstruct" / "model.ply"
    placing = {"scale": shot.scale, "size": shot.size, "up": shot.up, "floor": shot.floor}
    placing["front"] = shot.front
    placing["origin"] = shot.origin
    captured = shot.output.backdrop == "captured"

    def work(folder: Path) -> dict[str, Any]:
        if shot.mesh is not None:
            gaussians = mesh_gaussians(shot.mesh, seed=context.seed).to(context.device)
        else:
            gaussians = load_splats(source).validated(source.name)
        # the rows of a solid belong to its volume: nothing is taken from it
        isolate = Isolate("all" if is_solid(shot.splats) else "auto", seed=context.seed)
        whole, background = isolate.split(gaussians, context.capture)
        if is_solid(shot.splats):
            whole = gaussians.replace(report=whole.report)
        stance = orient(whole, context.capture, shot.up, shot.mesh)
        said = ", ".join(f"{part:+.2f}" for part in stance.up)
        _log.info("up is [%s] (%s); set up: in the shot if that is wrong", said, stance.up_from)
        frame = make_frame(whole, context.capture, shot)
        save_splats(whole, folder / "object.ply")
        if background.count:
            save_splats(background, folder / "background.ply")
        elif captured:
            raise no_background()
        write_json(folder / "frame.json", frame.to_dict())
        return dict(whole.report) | {
            "gaussians_kept": whole.count,
            "gaussians_removed": background.count,
            "up": stance.up.tolist(),
            "up_from": stance.up_from,
            "floor_from": stance.floor_from,
            "scale": frame.scale,
            "support_plane": _support_plane(stance, frame),
        }

    context.frame = read_frame(context.do("isolate", work, placing, section="isolation").folder)


def _support_plane(stance: Orientation, frame: Frame) -> dict[str, Any] | None:
    """What the object stood on, ``normal @ x = offset``, in world units and in the scene [m]."""
    if stance.floor_from != "support plane":
        return None
    normal = torch.from_numpy(stance.up).double()
    turned = frame.apply_vector(normal[None])[0].double()
    foot = frame.apply((stance.floor * normal)[None])[0].double()
    return {
        "world": {"normal": normal.tolist(), "offset": stance.floor},
        "scene": {"normal": turned.tolist(), "offset": float(foot @ turned)},
    }


def fill_stage(context: RunContext) -> None:
    """Shells to solids: ``stages/fill/<object>.ply`` for every object of the shot."""
    shot, frame = context.shot, context.frame
    selections = {name: repr(o.select) for name, o in shot.objects.items()}
    labels = [content_digest(o.select.labels) for o in shot.objects.values() if o.select.labels]
    options = shot.fill.given(frame.scale)
    cells = QUALITY[shot.solve.quality]
    # a finer simulation asks for another solid only where it asks for finer voxels
    fine = options.get("resolution", fill_resolution(1.0, 1.0, cells))

    def work(folder: Path) -> dict[str, Any]:
        everything = load_splats(context.store.root / "isolate" / "object.ply")
        masks = {}
        taken = torch.zeros(everything.count, dtype=torch.bool)
        for name, settings in shot.objects.items():
            masks[name] = select_mask(everything, settings.select, frame) & ~taken
            taken |= masks[name]
        whole = known_solid(
            shot, everything, {"resolution": fill_resolution(1.0, 1.0, cells)} | options,
            seed=context.seed, progress=context.reporter.task("fill"),
        )  # fmt: skip
        if whole is not None:
            # splats inside a mesh are none of those that were selected
            masks = {
                name: extended(mask, everything, whole.gaussians) for name, mask in masks.items()
            }
            reports = []
            for name, solid in parted(whole, masks).items():
                save_solid(solid.transformed(frame), folder / f"{name}.ply")
                reports.append(solid.report | {"volume_m3": solid.volume * frame.scale**3})
            return _merged(reports)
        objects = {name: everything.select(mask) for name, mask in masks.items()}
        extents = {name: visible_extent(splats) for name, splats in objects.items()}
        largest = max(extents.values())
        down = tuple((-frame.rotation[2]).tolist())
        reports = []
        for name, splats in objects.items():
            wanted = {"resolution": fill_resolution(extents[name], largest, cells)}
            stage = Fill(**wanted | options, down=down, seed=context.seed)
            solid = stage(
                splats.to(context.device), context.capture, progress=context.reporter.task("fill")
            )
            save_solid(solid.transformed(frame), folder / f"{name}.ply")
            reports.append(solid.report | {"volume_m3": solid.volume * frame.scale**3})
        return _merged(reports)

    context.do("fill", work, options, fine, selections, labels, section="fill")


def texture_stage(context: RunContext) -> None:
    """Colours for the inside: ``stages/texture/<object>.ply`` and ``OUT/interior.png``."""
    shot = context.shot
    options = shot.texture.given()
    exemplar = content_digest(shot.texture.exemplar) if shot.texture.exemplar else None
    # a material says what is inside where nothing else does
    insides = {} if options else {name: o.material for name, o in shot.objects.items()}

    def work(folder: Path) -> dict[str, Any]:
        reports = []
        for name in shot.objects:
            solid = load_solid(context.store.root / "fill" / f"{name}.ply").to(context.device)
            if solid.color is not None and not options:
                _log.info("texture: %s has an inside with colours already, they stay", name)
                save_solid(solid, folder / f"{name}.ply")
                save_cut_views(solid, folder / f"{name}.png")
                reports.append({"method": "textured before"})
                continue
            # slices finished before a kill are found again: the folder outlives it
            stage = Texture(
                **options,
                material=insides.get(name),
                device=str(context.device),
                resume=folder / f"{name}.slices",
                seed=context.seed,
            )
            textured = stage(solid, context.capture, progress=context.reporter.task("texture"))
            with Behind() as beside:
                beside.do(save_solid, textured, folder / f"{name}.ply")
                save_cut_views(textured, folder / f"{name}.png")
            reports.append({k: v for k, v in textured.report.items() if k != "fill"})
        return _merged(reports)

    result = context.do("texture", work, options, exemplar, insides, section="texture")
    first = next(iter(shot.objects))
    publish(result, f"{first}.png", context.out / "interior.png")
    context.record.values["outputs"]["interior"] = "interior.png"


def _merged(reports: list[dict[str, Any]]) -> dict[str, Any]:
    """One report: the object's own, or counts and volumes summed when there are more objects."""
    if len(reports) == 1:
        return reports[0]
    total: dict[str, Any] = dict(reports[0])
    for key in ("interior_gaussians", "volume", "volume_m3", "leaks", "slices"):
        if all(isinstance(report.get(key), int | float) for report in reports):
            total[key] = sum(report[key] for report in reports)
    total["objects"] = reports
    return total


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

    def work(folder: Path) -> dict[str, Any]:
        reports = {}
        for name, sources in wanted.items():
            solid = load_solid(context.store.root / "texture" / f"{name}.ply").to(context.device)
            progress = context.reporter.task("regions")
            labelled = Regions(sources)(solid, context.capture, progress, frame=context.frame)
            assert labelled.regions is not None
            with atomic_path(folder / f"{name}.npz") as temporary, open(temporary, "wb") as stream:
                np.savez_compressed(stream, regions=labelled.regions.cpu().numpy())
            write_json(folder / f"{name}.json", {k: labelled.report[k] for k in _KEYS})
            reports[name] = labelled.report["region_sources"]
        return reports

    context.do("regions", work, content, placing, section="regions")


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
    hint = "remove the folder; the next run makes it again"
    regions = read_npz(path.with_name(path.name + ".npz"), ["regions"], hint)["regions"]
    table = read_json(path.with_name(path.name + ".json"), hint)
    if not isinstance(table, dict) or not set(_KEYS) <= set(table):
        raise InputError(f"{path}.json: not the labels of a run", hint)
    report = {**solid.report, **{key: table[key] for key in _KEYS}}
    try:
        return solid.replace(regions=torch.from_numpy(regions), report=report)
    except (TypeError, ValueError) as error:
        raise InputError(f"{path}.npz: not the labels of this solid ({error})", hint) from error


def context_of(
    shot: Shot, out: Path, device: torch.device | str, seed: int, reporter: Reporter | None = None
) -> RunContext:
    """What stages need to take up, or to begin, a run in a folder; nothing is written yet."""
    device = torch.device(device)
    record = RunRecord(out / "run.json", shot.resolved(), device, seed)
    store = StageStore(out / "stages")
    return RunContext(shot, out, device, seed, store, record, reporter or LineReporter())


def make_solids(context: RunContext) -> None:
    """Do the stages up to the solids and their regions, or find them done.

    Raises:
        InputError: The shot, or a file that it names, is wrong.
    """
    for stage in (reconstruct_stage, isolate_stage, fill_stage, texture_stage, regions_stage):
        stage(context)
