"""Whole runs on a GPU: everything off and on the grid, against the CPU. Skipped without a GPU."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from simulation_scenes import SOFT, at, near_miss, resting
from simulation_shapes import ellipsoid

from gsfluent import has_cuda, materials
from gsfluent.errors import InputError
from gsfluent.pipeline.simulate.stage import Simulate, SimulationFrame
from gsfluent.scene.scene import Scene
from gsfluent.stages.simulate import saved

pytestmark = [
    pytest.mark.cuda,
    pytest.mark.skipif(not has_cuda(), reason="needs a GPU and gsfluent's CUDA kernels"),
]


def pressed() -> Scene:
    scene = Scene()
    scene.add(ellipsoid((0.05,) * 3), SOFT)
    scene.press(speed=0.3, stroke=0.02)
    return scene


def shot(rigid: bool, density: float = 8e3) -> Scene:
    scene = Scene(floor=None, gravity=(0, 0, 0))
    scene.add(ellipsoid((0.05,) * 3), SOFT)
    scene.bullet((0.2, 0.01, 0), (0, 0.01, 0), 8.0, radius=0.03, density=density, rigid=rigid)
    return scene


def cut() -> Scene:
    scene = Scene(floor=None, gravity=(0, 0, 0))
    scene.add(ellipsoid((0.05,) * 3), SOFT, frame=at(0, 0, 0.1))
    scene.blade([(0, 0, 0.2), (0, 0, 0.0)], width=0.3, edge=(0, 1, 0), speed=4.0)
    return scene


def smashed() -> Scene:
    scene = Scene()
    apple = materials.fruit.apple.override(variation=0.0)
    scene.add(ellipsoid((0.05,) * 3), apple, velocity=(0, 0, -8.0))
    scene.drop(0.02)
    return scene


def run(
    scene: Scene, device: str, fps: float, seconds: float, **options: Any
) -> tuple[list[SimulationFrame], dict]:  # type: ignore[type-arg]
    simulation = Simulate(dx=0.02, device=device, **options)(scene, fps=fps, seconds=seconds)
    frames = list(simulation)
    report = simulation.report
    assert report["verdict"] == "clean", report["reason"]
    assert report["momentum_error"] < 1e-5
    return frames, report


# Contact is one blow per step, and sums in another order change what breaks: cells of tolerance.
@pytest.mark.parametrize(
    ("make", "fps", "seconds", "cells"),
    [
        (near_miss, 40, 0.3, 0.02),
        (lambda: resting(True), 10, 2.0, 0.5),
        (pressed, 20, 0.2, 0.1),
        (lambda: shot(False), 50, 0.08, 0.5),
        (lambda: shot(True), 50, 0.08, 0.5),
        (cut, 25, 0.16, 0.05),
        (smashed, 100, 0.03, 0.5),
    ],
)
def test_a_run_on_the_gpu_equals_one_on_the_cpu(
    make: Callable[[], Scene], fps: float, seconds: float, cells: float
) -> None:
    scene = make()
    (here, one), (there, two) = (run(scene, device, fps, seconds) for device in ("cpu", "cuda"))
    assert len(here) == len(there)
    for key in ("naps", "wakes", "pieces_flown"):
        assert one[key] == two[key], key
    assert (one["composed_steps"] > 0) == (two["composed_steps"] > 0)
    for a, b in zip(here, there, strict=True):
        assert b.particles.position.device.type == "cuda"
        apart = (a.particles.position - b.particles.position.cpu()).norm(dim=1).mean()
        assert float(apart) < cells * 0.02, a.index
        assert abs(a.stats["fragments"] - b.stats["fragments"]) <= (1 if make is smashed else 0)
    kept = saved(there[-1], scene)
    assert bool(torch.isfinite(kept.gaussians.means).all())


def stacked() -> Scene:
    """A ball that lands on another, which lies on the floor."""
    scene = Scene()
    for height in (0.05, 0.16):
        scene.add(ellipsoid((0.05,) * 3), SOFT, frame=at(0.0, 0.0, height))
    return scene


# Off the nodes nothing waits for a node to be reached: what falls is where it is on a CPU.
@pytest.mark.parametrize("options", [{"surface": True}, {"surface": True, "cfl": 0.25}])
def test_points_are_pushed_and_keep_their_motion_as_on_the_cpu(options: dict[str, Any]) -> None:
    (here, _), (there, _) = (
        run(stacked(), device, 50, 0.1, sleep=False, **options) for device in ("cpu", "cuda")
    )
    assert len(here) == len(there)
    for a, b in zip(here, there, strict=True):
        apart = (a.particles.position - b.particles.position.cpu()).norm(dim=1).mean()
        assert float(apart) < 0.05 * 0.02, a.index


def test_a_state_goes_from_one_device_to_the_other(tmp_path: Path) -> None:
    """What was saved on the GPU is taken up on the CPU, with a sleeper in it."""
    first = Simulate(dx=0.02, device="cuda")(resting(True), fps=10, seconds=2.0)
    for frame in first:
        if frame.index == 18:
            first.save(tmp_path / "state.pt")
            break
    assert first.report["naps"] == 1
    second = Simulate(dx=0.02)(resting(True), fps=10, seconds=2.0, resume=tmp_path / "state.pt")
    frames = list(second)
    assert [f.index for f in frames] == [19]
    assert second.report["wakes"] == 1 and second.report["verdict"] == "clean"


def test_trouble_on_the_gpu_is_healed_and_placed() -> None:
    left = [1]

    def poison(state):  # type: ignore[no-untyped-def]
        if state.step != 20 or not left[0]:
            return state
        left[0] = 0
        velocity = state.particles.velocity.clone()
        velocity[-5:] = torch.nan
        return state._replace(particles=state.particles.replace(velocity=velocity))

    simulation = Simulate(dx=0.02, device="cuda", step_hook=poison)(pressed(), fps=20, seconds=0.2)
    frames = list(simulation)
    report = simulation.report
    assert report["verdict"] == "healed" and len(frames) == 4
    assert "box (" in report["reason"] and "went back to" in report["reason"]


@pytest.mark.parametrize("make", [smashed, cut, lambda: shot(True)])
def test_the_same_run_gives_the_same_bits(make: Callable[[], Scene]) -> None:
    ends = []
    for _ in range(2):
        simulate = Simulate(dx=0.02, device="cuda", deterministic=True)
        ends.append(list(simulate(make(), fps=100, seconds=0.03))[-1])
    assert torch.equal(ends[0].particles.position, ends[1].particles.position)
    assert torch.equal(ends[0].particles.velocity, ends[1].particles.velocity)


def test_what_has_no_order_on_a_gpu_is_refused_when_bits_matter() -> None:
    with pytest.raises(InputError, match="no order on a GPU"):
        light = shot(True, density=100.0)
        list(Simulate(dx=0.02, device="cuda", deterministic=True)(light, fps=25, seconds=0.16))
