"""What a step of the solver costs: points, blocks, contact, by set of laws, measured.

The scenes go the way of every simulation, :class:`gsfluent.pipeline.simulate.run.Run` with
its
checks and looks, on the resident solver and on the composable operators.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

import torch

from gsfluent import materials
from gsfluent.data import INTERIOR, SURFACE, Frame, Gaussians, Solid
from gsfluent.io.solid import load_solid
from gsfluent.materials import Material
from gsfluent.pipeline.simulate.engine import CFL
from gsfluent.pipeline.simulate.run import Run
from gsfluent.pipeline.simulate.stage import Simulate
from gsfluent.plan.cost import LAW_SETS, framing, law_set, stepping
from gsfluent.plan.fit import Sample, fit
from gsfluent.results.frames import save_frame
from gsfluent.scene.scene import Scene
from gsfluent.stages.findings import thin_walls
from gsfluent.stages.simulate import saved

_STEPS = 48
_WARM = 8
_SPEED = 6.0
"""Of the balls [m/s]: fast enough to break what is brittle."""


def measure_solver(device: torch.device | str) -> tuple[dict[str, float], float]:
    """Costs of the features of :func:`gsfluent.plan.cost.stepping`.

    Returns:
        Seconds per unit of each feature, and the largest relative error of the fit.
    """
    brittle = materials.get("fruit.watermelon").override(variation=0.0)
    soft = materials.get("elastic").override(young_modulus=1e6)
    liquid = materials.get("water")
    samples = [
        measured_ball(soft, 8, device),
        measured_ball(soft, 16, device),
        measured_ball(brittle, 8, device),
        measured_ball(brittle, 14, device),
        measured_ball(brittle, 17, device),
        measured_ball(liquid, 12, device),
        measured_ball(soft, 12, device, law_kernels=False),
        measured_ball(brittle, 40, device, debris=True),
        measured_ball(brittle, 10, device, two=True),
        measured_ball(brittle, 13, device, two=True),
        measured_ball(soft, 8, device, resident=False),
        measured_ball(soft, 16, device, resident=False),
    ]
    features = [
        "steps", *(f"point_steps_{name}" for name in LAW_SETS), "block_steps",
        "contact_block_steps", "composed_steps", "composed_point_steps",
    ]  # fmt: skip
    return fit(samples, features)


def measured_ball(
    material: Material,
    cells: int,
    device: torch.device | str,
    *,
    two: bool = False,
    debris: bool = False,
    resident: bool = True,
    law_kernels: bool = True,
) -> Sample:
    """Time 48 steps of a ball that strikes the floor, two that meet, or debris in flight."""
    radius = 0.1
    scene = Scene()
    for side in (-1.0, 1.0) if two else (0.0,):
        place = Frame(torch.eye(3), torch.tensor([side * radius * 0.98, 0.0, radius]), 1.0)
        velocity = (-side * _SPEED, 0.0, 0.0) if two else (0.0, 0.0, -_SPEED)
        scene.add(
            ball(radius, 2 * cells, debris=debris), material, frame=place,
            velocity=(0.0, 0.0, 0.0) if debris else velocity, parts=[],
        )  # fmt: skip
    stage = Simulate(
        dx=2.0 * radius / cells, splats=False, free_flight=False, sleep=False,
        resident=resident, law_kernels=law_kernels, device=device,
    )  # fmt: skip
    wave = scene.bodies[0].material.wave_speed
    step = CFL * 2.0 * radius / cells / (wave + (0.0 if debris else _SPEED))
    run = stage.run_of(scene, 1.0)
    with torch.no_grad():
        run.advance_to(0, None, time=_WARM * step)
        before, start = _counted(run, device)
        run.advance_to(1, None, time=(_WARM + _STEPS) * step)
        after, end = _counted(run, device)
    steps = after["steps"] - before["steps"]
    blocks = max(1, after["block_steps"] - before["block_steps"])
    features = stepping(
        (after["particle_steps"] - before["particle_steps"]) / steps,
        blocks / steps,
        steps,
        fields=2 if two else 1,
        laws=law_set({material.law}) if law_kernels else "general",
        composed_steps=after["composed_steps"] - before["composed_steps"],
        shared=(after["contact_block_steps"] - before["contact_block_steps"]) / blocks,
    )
    return Sample("simulate", features, end - start)


def _counted(run: Run, device: torch.device | str) -> tuple[dict[str, Any], float]:
    """The counters of a run, and the time."""
    counters = dict(vars(run.stepper.counters))
    if torch.device(device).type == "cuda":
        torch.cuda.synchronize(device)
    return counters, time.perf_counter()


def ball(radius: float, voxels: int, *, splats: int = 16, debris: bool = False) -> Solid:
    """A ball about the origin; as debris, of every fifth voxel in each direction only."""
    axis = (torch.arange(voxels) + 0.5) / voxels * 2.0 - 1.0
    x, y, z = torch.meshgrid(axis, axis, axis, indexing="ij")
    level = (x * x + y * y + z * z).sqrt()
    inside = level <= 1.0
    if debris:
        row = torch.arange(voxels) % 5 == 0
        inside = inside & row[:, None, None] & row[:, None] & row
    depth = (1.0 - level).clamp(min=0.0) * radius
    generator = torch.Generator().manual_seed(0)
    means = torch.nn.functional.normalize(torch.randn(splats, 3, generator=generator), dim=1)
    labels = torch.full((splats,), SURFACE, dtype=torch.int32)
    labels[splats // 2 :] = INTERIOR
    gaussians = Gaussians.from_colors(
        means * radius, torch.full((splats,), 0.05 * radius), torch.full((splats, 3), 0.5)
    ).replace(labels=labels)
    origin = torch.full((3,), -radius)
    color = torch.full((*inside.shape, 3), 0.5)
    return Solid(gaussians, inside, depth, origin, 2.0 * radius / voxels, color)


_FRAMES = 6


_FPS = 200.0


_THROWN = 4.0


_CELLS = 14


def frame_samples(out: Path, device: torch.device) -> list[Sample]:
    """Time the frames of a melon that bounces (rubber) and of one that breaks.

    Returns:
        What setting up costs, what frames in which nothing is broken cost, and what the breaking
        adds to them.
    """
    solid = load_solid(out / "stages" / "texture" / "melon.ply")
    splats = float(solid.gaussians.count)
    setup, plain, _ = _times(solid, "rubber", device)
    _, broken, points = _times(solid, "fruit.watermelon", device)
    whole = framing(_FRAMES, splats, points, brittle=False)
    frames = whole | {"start_gaussians": 0.0}
    return [
        Sample("simulate", {"start_gaussians": splats}, setup),
        Sample("simulate", frames, plain),
        Sample("simulate", frames | {"cracked_gaussians": splats}, max(broken, plain)),
    ]


def _times(solid: Solid, material: str, device: torch.device) -> tuple[float, float, float]:
    """Seconds of setting up, and of all frames beside the steps; points."""
    scene = Scene()
    scene.add(solid, material, frame=solid.frame or Frame.identity(), velocity=(0, 0, -_THROWN))
    scene.drop(0.01)
    side = float((scene.bodies[0].bounds()[1] - scene.bodies[0].bounds()[0]).max())
    stage = Simulate(dx=side / _CELLS, device=device)
    start = time.perf_counter()
    frames = stage(scene, fps=_FPS, seconds=_FRAMES / _FPS)
    setup = time.perf_counter() - start
    start, points = time.perf_counter(), 0.0
    with tempfile.TemporaryDirectory(prefix="gsfluent_probe_") as name:
        for frame in frames:
            save_frame(Path(name), saved(frame, scene))
            frames.save(Path(name) / "state.pt")
            points = float(frame.particles.count)
    rest = time.perf_counter() - start - float(frames.report["seconds"])
    start = time.perf_counter()
    thin_walls(scene, side / _CELLS)
    return setup + time.perf_counter() - start, max(rest, 1e-4), points
