"""The stages of a run that make solids: reconstruct, isolate, fill, texture."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Any

import torch

from gsfluent.data import Frame
from gsfluent.io import load_capture, load_splats, write_json
from gsfluent.io.solid import load_solid, save_solid
from gsfluent.io.splats import save_splats
from gsfluent.pipeline.fill import Fill
from gsfluent.pipeline.fill_resolution import fill_resolution, visible_extent
from gsfluent.pipeline.isolate import Isolate
from gsfluent.pipeline.orient import Orientation, make_frame, orient
from gsfluent.pipeline.reconstruct import Reconstruct
from gsfluent.pipeline.reconstruct_report import write_report
from gsfluent.pipeline.render_backdrop import no_background
from gsfluent.pipeline.render_cuts import save_cut_views
from gsfluent.pipeline.run_context import RunContext
from gsfluent.pipeline.run_store import content_digest, fingerprint, publish
from gsfluent.pipeline.select import select_mask
from gsfluent.pipeline.simulate import QUALITY
from gsfluent.pipeline.texture import Texture

_log = logging.getLogger(__name__)


def reconstruct_stage(context: RunContext) -> None:
    """Photographs to Gaussians: ``stages/reconstruct/model.ply``."""
    shot = context.shot
    if shot.capture is None:
        return
    context.capture = load_capture(shot.capture)
    context.source_key = content_digest(shot.capture)
    key = fingerprint("reconstruct", context.key(context.source_key, shot.reconstruct.given()))
    capture = context.capture

    def work(folder: Path) -> dict[str, Any]:
        stage = Reconstruct(
            **shot.reconstruct.given(),
            checkpoint=folder / "training.pt",
            device=context.device,
            seed=context.seed,
        )
        gaussians, report = stage(capture, progress=context.reporter.task("reconstruct"))
        save_splats(gaussians, folder / "model.ply")
        write_report(folder, gaussians, capture, report)
        return dict(report)

    result = context.store.run("reconstruct", key, work)
    context.record.values["reconstruction"] = result.report
    context.source_key = result.fingerprint


def isolate_stage(context: RunContext) -> None:
    """The object apart from its background, and where it stands in the scene."""
    shot = context.shot
    if shot.splats is not None:
        source = shot.splats
        context.source_key = content_digest(source)
    else:
        source = context.store.root / "reconstruct" / "model.ply"
    placing = {"scale": shot.scale, "size": shot.size, "up": shot.up, "floor": shot.floor}
    placing["origin"] = shot.origin
    captured = shot.output.backdrop == "captured"
    key = fingerprint("isolate", context.key(context.source_key, placing))

    def work(folder: Path) -> dict[str, Any]:
        gaussians = load_splats(source).validated(source.name)
        stage = Isolate(seed=context.seed)
        whole, background = stage.split(gaussians, context.capture)
        stance = orient(whole, context.capture, shot.up)
        frame = make_frame(whole, context.capture, shot)
        save_splats(whole, folder / "object.ply")
        if background.count:
            save_splats(background, folder / "background.ply")
        elif captured:
            raise no_background()
        write_json(folder / "frame.json", frame.to_dict())
        return dict(stage.report) | {
            "gaussians_kept": whole.count,
            "gaussians_removed": background.count,
            "up": stance.up.tolist(),
            "up_from": stance.up_from,
            "floor_from": stance.floor_from,
            "scale": frame.scale,
            "support_plane": _support_plane(stance, frame),
        }

    result = context.store.run("isolate", key, work)
    context.frame = read_frame(result.folder)
    context.record.values["isolation"] = result.report
    context.source_key = result.fingerprint


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


def read_frame(folder: Path) -> Frame:
    """World-to-scene frame that the isolate stage wrote; the floor, if any, is at z = 0."""
    return Frame.from_dict(json.loads((folder / "frame.json").read_text(encoding="utf-8")))


def fill_stage(context: RunContext) -> None:
    """Shells to solids: ``stages/fill/<object>.ply`` for every object of the shot."""
    shot, frame = context.shot, context.frame
    selections = {name: repr(o.select) for name, o in shot.objects.items()}
    labels = [content_digest(o.select.labels) for o in shot.objects.values() if o.select.labels]
    options = shot.fill.given(frame.scale)
    cells = QUALITY[shot.solve.quality]
    # a finer simulation asks for another solid only where it asks for finer voxels
    fine = options.get("resolution", fill_resolution(1.0, 1.0, cells))
    key = fingerprint("fill", context.key(context.source_key, options, fine, selections, labels))

    def work(folder: Path) -> dict[str, Any]:
        everything = load_splats(context.store.root / "isolate" / "object.ply")
        objects = {}
        taken = torch.zeros(everything.count, dtype=torch.bool)
        for name, settings in shot.objects.items():
            mask = select_mask(everything, settings.select, frame) & ~taken
            taken |= mask
            objects[name] = everything.select(mask)
        extents = {name: visible_extent(splats) for name, splats in objects.items()}
        largest = max(extents.values())
        down = tuple((-frame.rotation[2]).tolist())
        reports = []
        for name, splats in objects.items():
            wanted = {"resolution": fill_resolution(extents[name], largest, cells)}
            stage = Fill(**wanted | options, down=down, seed=context.seed)
            solid = stage(
                splats.to(context.device),
                context.capture,
                progress=context.reporter.task("fill"),
            )
            solid.transformed(frame).save(folder / f"{name}.ply")
            reports.append(solid.report | {"volume_m3": solid.volume * frame.scale**3})
        return _merged(reports)

    result = context.store.run("fill", key, work)
    context.record.values["fill"] = dict(result.report)
    context.source_key = result.fingerprint


def texture_stage(context: RunContext) -> None:
    """Colours for the inside: ``stages/texture/<object>.ply`` and ``OUT/interior.png``."""
    shot = context.shot
    options = shot.texture.given()
    exemplar = content_digest(shot.texture.exemplar) if shot.texture.exemplar else None
    key = fingerprint("texture", context.key(context.source_key, options, exemplar))

    def work(folder: Path) -> dict[str, Any]:
        reports = []
        for name in shot.objects:
            solid = load_solid(context.store.root / "fill" / f"{name}.ply")
            # slices finished before a kill are found again: the folder outlives it
            stage = Texture(
                **options,
                device=str(context.device),
                resume=folder / f"{name}.slices",
                seed=context.seed,
            )
            textured = stage(solid, context.capture, progress=context.reporter.task("texture"))
            save_solid(textured, folder / f"{name}.ply")
            save_cut_views(textured, folder / f"{name}.png")
            reports.append({k: v for k, v in textured.report.items() if k != "fill"})
        return _merged(reports)

    result = context.store.run("texture", key, work)
    first = next(iter(shot.objects))
    publish(result.folder / f"{first}.png", context.out / "interior.png")
    context.record.values["texture"] = dict(result.report)
    context.record.values["outputs"]["interior"] = "interior.png"
    context.source_key = result.fingerprint


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
