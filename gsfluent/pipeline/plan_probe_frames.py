"""What a simulated frame costs beside its steps: pieces, carrying, cracks, saving, measured."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import torch

from gsfluent.data import Frame, Solid
from gsfluent.io.solid import load_solid
from gsfluent.pipeline.plan_cost import framing
from gsfluent.pipeline.plan_fit import Sample
from gsfluent.pipeline.run_frames import save_frame
from gsfluent.pipeline.run_simulate import saved, thin_walls
from gsfluent.pipeline.simulate import Simulate
from gsfluent.scene import Scene

__all__ = ["frame_samples"]

_FRAMES = 6
_FPS = 200.0
_SPEED = 4.0
_CELLS = 14


def frame_samples(out: Path, device: torch.device) -> list[Sample]:
    """Time the frames of a melon that bounces (rubber) and of one that breaks.

    Args:
        out: Folder of a small run.
        device: Where to simulate.

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
    scene.add(solid, material, frame=solid.frame or Frame.identity(), velocity=(0, 0, -_SPEED))
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
            stage.save_state(Path(name) / "state.pt")
            points = float(frame.particles.count)
    rest = time.perf_counter() - start - float(stage.report()["seconds"])
    start = time.perf_counter()
    thin_walls(scene, side / _CELLS)
    return setup + time.perf_counter() - start, max(rest, 1e-4), points
