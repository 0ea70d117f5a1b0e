"""The ten-second probe: small runs of the real stages, timed, and the costs fitted to them.

Three small shots of a drawn melon go through the stages of a run themselves, each
larger than the last; the first also pays for what a fresh process pays once (libraries, kernels, a
GPU's context). The solver is measured apart (:mod:`gsfluent.plan.probe_parts`), because
there one number for all laws would not do.
"""

from __future__ import annotations

import dataclasses
import json
import logging
import tempfile
import time
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import torch

from gsfluent.config import Shot
from gsfluent.config.settings import EXPORTS
from gsfluent.errors import GsfluentError
from gsfluent.io import load_capture, save_image
from gsfluent.io.solid import load_solid, save_solid
from gsfluent.pipeline.capture.hull import masked_views
from gsfluent.pipeline.render.cuts import save_cut_views
from gsfluent.plan.cost import CostModel, machine_key
from gsfluent.plan.fact import actual_work
from gsfluent.plan.fit import Sample, fit
from gsfluent.plan.proxy import look_at_photographs
from gsfluent.plan.work import isolate_work, reconstruct_work, render_work
from gsfluent.progress import Progress, quiet_logs, report_progress
from gsfluent.stages.chain import run_stages
from gsfluent.stages.solids import context_of

_log = logging.getLogger(__name__)

FEATURES: dict[str, tuple[str, ...]] = {
    "reconstruct": ("start", "images", "steps", "step_pixels", "step_splats"),
    "isolate": ("start", "splats"),
    "fill": ("start", "images", "voxels", "inner"),
    "texture": ("start", "exemplar_objects", "exemplar_voxels"),
    "render": ("start", "gaussians", "frames", "frame_pixels", "frame_gaussians"),
}
"""What each stage's cost is made of; ``simulate`` has its own module, exports are per kind."""
FRAME_FEATURES = ("frames", "frame_gaussians", "start_gaussians", "cracked_gaussians")
_VIEWS = 10
_PHOTOGRAPH = 160


@dataclasses.dataclass(frozen=True)
class Size:
    """One small shot."""

    name: str
    iterations: int
    splats: int
    image_size: int
    resolution: int
    cells: int
    frames: int
    picture: tuple[int, int]
    material: str


SIZES = (
    Size("cold", 10, 2000, 64, 24, 8, 2, (64, 48), "rubber"),
    Size("small", 30, 3000, 80, 28, 10, 4, (128, 96), "fruit.watermelon"),
    Size("large", 30, 12000, 160, 50, 14, 3, (256, 192), "rubber"),
    Size("large", 30, 12000, 160, 50, 14, 6, (384, 288), "fruit.watermelon"),
)
"""The last is the third, broken, with more and larger frames: its first stages are found done."""
_TRAININGS = ((80, 3000, 90), (160, 3000, 30))
"""Longest side [pixels], splats and steps of trainings beside those of the shots."""


def calibrate(device: torch.device | str, progress: Progress | None = None) -> CostModel:
    """Measure what work costs on a device: 18 s on two quiet cores, 47 s on an H100."""
    from gsfluent.plan.probe_parts import frame_samples, measure_solver

    device = torch.device(device)
    began = time.perf_counter()
    total = len(SIZES) + 3
    parts: list[tuple[str, float]] = []

    def report(number: int, what: str) -> None:
        parts.append((what, time.perf_counter() - began - sum(took for _, took in parts)))
        report_progress(progress, number, total, what)

    with (
        tempfile.TemporaryDirectory(prefix="gsfluent_probe_") as name,
        quiet_logs("gsfluent", logging.ERROR),
    ):
        folder = Path(name)
        draw_capture(folder / "photographs")
        report(1, "photographs")
        samples: list[Sample] = []
        for number, size in enumerate(SIZES):
            values, planned = run_small(folder, size, device)
            samples += stage_samples(values, planned, cold=number == 0)
            if number == 0:
                first = simulation_sample(values, planned)
            report(number + 2, f"{size.name} shot")
        samples += other_samples(folder / "small", device)
        samples += [*training_samples(folder, device), figures_sample(folder / "large", device)]
        framed = [s for name in ("small", "large") for s in frame_samples(folder / name, device)]
        report(total - 1, "exports, trainings, frames")
    costs: dict[str, dict[str, float]] = {}
    errors: dict[str, float] = {}
    for stage, features in FEATURES.items():
        mine = [s for s in samples if s.stage == stage and "procedural_voxels" not in s.features]
        costs[stage], errors[stage] = fit(mine, features)
    more = [s for s in samples if s.stage == "texture" and "procedural_voxels" in s.features]
    found, _ = fit(more, ("procedural_objects", "procedural_voxels"))
    costs["texture"] |= found
    exports = [s for s in samples if s.stage == "export"]
    costs["export"], errors["export"] = export_costs(exports)
    costs["simulate"], errors["simulate"] = measure_solver(device)
    frame_costs, _ = fit(framed, FRAME_FEATURES)
    # what a fresh process pays once shows in the first small shot
    cold, _ = fit([first], ("start",), frame_costs)
    costs["simulate"] |= frame_costs | cold
    report(total, "solver")
    model = CostModel(
        machine=machine_key(device),
        seconds=costs,
        made=datetime.now(UTC).isoformat(timespec="seconds"),
        probe_seconds=time.perf_counter() - began,
        errors=errors,
    )
    _log.info(
        "measured what work costs on this device in %.1f s: %s",
        model.probe_seconds,
        ", ".join(f"{what} {took:.1f} s" for what, took in parts),
    )
    return model


def draw_capture(folder: Path) -> None:
    """Photographs of a drawn melon and of a cut through another one, in a capture folder."""
    from gsfluent.demo.capture import cut_photograph, make_object, photograph, ring_cameras

    (folder / "images").mkdir(parents=True)
    melon = make_object("watermelon", 0)
    frames = []
    for number, view in enumerate(ring_cameras(melon, _VIEWS, on_table=False)):
        image, mask = photograph(melon, view, _PHOTOGRAPH)
        save_image(torch.cat([image, mask[..., None]], -1), folder / f"images/{number:03d}.png")
        pose = torch.linalg.inv(view) @ torch.diag(view.new_tensor([1.0, -1.0, -1.0, 1.0]))
        frames.append({"file_path": f"images/{number:03d}.png", "transform_matrix": pose.tolist()})
    image, mask = cut_photograph(make_object("watermelon", 1000).one(), 192)
    save_image(torch.cat([image, mask[..., None]], -1), folder / "cut.png")
    focal = 0.5 * _PHOTOGRAPH / 0.36397  # half the angle of view of the generator: 20 degrees
    document = {
        "camera_model": "PINHOLE", "w": _PHOTOGRAPH, "h": _PHOTOGRAPH, "fl_x": focal,
        "fl_y": focal, "cx": 0.5 * _PHOTOGRAPH, "cy": 0.5 * _PHOTOGRAPH, "frames": frames,
    }  # fmt: skip
    (folder / "transforms.json").write_text(json.dumps(document), encoding="utf-8")


def run_small(
    folder: Path, size: Size, device: torch.device
) -> tuple[dict[str, Any], dict[str, dict[str, float]]]:
    """Run one small shot: ``run.json``, and the features known before."""
    fps = 200.0
    shot = Shot.from_dict(
        {
            "capture": str(folder / "photographs"),
            "scale": 1.0,
            "up": "+z",
            "reconstruct": {
                "iterations": size.iterations,
                "max_gaussians": size.splats,
                "image_size": size.image_size,
            },
            "fill": {"resolution": size.resolution},
            "texture": {"method": "exemplar", "exemplar": str(folder / "photographs" / "cut.png")},
            "objects": {"melon": {"material": size.material}},
            "events": [{"type": "drop", "height": 0.01}, {"type": "throw", "velocity": [0, 0, -4]}],
            "solve": {"quality": "preview", "cells": size.cells},
            "output": {"fps": fps, "seconds": size.frames / fps, "size": list(size.picture)},
        }
    )
    (folder / size.name).mkdir(exist_ok=True)
    context = context_of(shot, folder / size.name, device, 0, _Silent())
    run_stages(context)
    values = context.record.finish(context.store.results)
    assert shot.capture is not None  # given above
    capture = load_capture(shot.capture)
    photographs = look_at_photographs(shot, capture, masked_views(capture))
    empty = {"start": 1.0, "splats": 0.0, "objects": 1.0}
    planned = {
        "reconstruct": reconstruct_work(photographs, shot),
        "isolate": isolate_work(0.0),
        "fill": empty | {"images": float(_VIEWS)},
        "texture": {"start": 1.0, "exemplar_objects": 1.0, "exemplar_voxels": 0.0},
        "simulate": {
            "point_steps_nacc": 0.0,
            "gaussians": 0.0,
            "cracked_gaussians": float(size.material != "rubber"),
        },
        "render": render_work(shot, size.frames, 0.0),
    }
    return values, actual_work(planned, values)


def figures_sample(out: Path, device: torch.device) -> Sample:
    """What a film costs once, however long it is: the splats as they ride without any care."""
    from gsfluent.pipeline.light.from_shot import light_of
    from gsfluent.pipeline.render.figures import FilmFigures
    from gsfluent.pipeline.render.film import Film
    from gsfluent.results.record import shot_of

    shot = shot_of(out)
    start = time.perf_counter()
    film = Film(out, shot, light_of(shot), device)
    first = film.frame(0)
    FilmFigures(first, film.around)
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    features = {"gaussians": float(first.gaussians.count)}
    return Sample("render", features, time.perf_counter() - start)


def training_samples(folder: Path, device: torch.device) -> list[Sample]:
    """Trainings alone: more steps at one size, and more pixels with as many splats."""
    from gsfluent.pipeline.reconstruct.stage import Reconstruct

    found = []
    for side, splats, steps in _TRAININGS:
        settings = {"iterations": steps, "max_gaussians": splats, "image_size": side}
        shot = Shot.from_dict({"capture": str(folder / "photographs"), "reconstruct": settings})
        assert shot.capture is not None  # given above
        capture = load_capture(shot.capture)
        start = time.perf_counter()
        stage = Reconstruct(steps, splats, image_size=side, device=device)
        gaussians = stage(capture)
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        seconds = time.perf_counter() - start
        photographs = look_at_photographs(shot, capture, masked_views(capture))
        features = reconstruct_work(photographs, shot, float(gaussians.count)) | {"start": 0.0}
        found.append(Sample("reconstruct", features, seconds))
    return found


def stage_samples(
    values: Mapping[str, Any], work: Mapping[str, Mapping[str, float]], *, cold: bool
) -> list[Sample]:
    """One sample per stage that was not found finished."""
    done = {s["name"]: s["seconds"] for s in values["stages"] if not s["resumed"]}
    return [
        Sample(name, dict(work[name]) | {"start": float(cold)}, max(done[name], 1e-4))
        for name in FEATURES
        if name in done
    ]


def simulation_sample(values: Mapping[str, Any], work: Mapping[str, Mapping[str, float]]) -> Sample:
    """What the first simulation of this process took beside its steps."""
    stage = next(s for s in values["stages"] if s["name"] == "simulate")
    rest = stage["seconds"] - float(values["simulation"]["seconds"])
    return Sample("simulate", dict(work["simulate"]) | {"start": 1.0}, max(rest, 1e-4))


def other_samples(out: Path, device: torch.device) -> list[Sample]:
    """Textures by rule, and every kind of export, of a finished small run."""
    from gsfluent.pipeline.texture import Texture

    samples = []
    for folder in (out, out.parent / "large"):
        solid = load_solid(folder / "stages" / "fill" / "melon.ply")
        voxels = {"procedural_objects": 1.0, "procedural_voxels": float(solid.occupancy.numel())}
        start = time.perf_counter()
        textured = Texture(method="procedural", preset="bone", device=str(device))(solid)
        save_solid(textured, folder / "procedural.ply")
        save_cut_views(textured, folder / "procedural.png")
        samples.append(Sample("texture", voxels, time.perf_counter() - start))
    values = json.loads((out / "run.json").read_text(encoding="utf-8"))
    frames = values["render"]["frames"]
    splats = values["isolation"]["gaussians_kept"] + values["fill"]["interior_gaussians"]
    return samples + export_samples(out, frames * splats)


def export_samples(out: Path, splats: float) -> list[Sample]:
    """Every kind of export of a run whose frames have so many splats in all, where it can be."""
    found = []
    for kind in EXPORTS:
        try:
            found.append(export_sample(out, kind, splats))
        except GsfluentError as error:  # an extra that is not installed: nobody can use it either
            _log.debug("export %s is not measured: %s", kind, error)
    return found


def export_sample(out: Path, kind: str, splats: float) -> Sample:
    """One kind of export.

    Raises:
        InputError: What it needs is not installed.
    """
    from gsfluent.export.write import write_exports

    start = time.perf_counter()
    write_exports(out, [kind])
    return Sample("export", {f"{kind}_gaussians": splats}, time.perf_counter() - start)


def export_costs(samples: Sequence[Sample]) -> tuple[dict[str, float], float]:
    """Cost of each kind; what could not be measured is as dear as the others on average."""
    found, error = fit(samples, sorted({name for s in samples for name in s.features}))
    mean = sum(found.values()) / len(found)
    return {f"{kind}_gaussians": mean for kind in EXPORTS} | found, error


class _Silent:
    """A reporter that says nothing."""

    def task(self, name: str) -> Progress:
        """A callback that does nothing."""
        return lambda done, total, text: None
