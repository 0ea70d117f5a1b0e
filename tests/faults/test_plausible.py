"""A verdict is not believed when what came out cannot be: crushed, sunk, without its volume."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from simulation_shapes import ellipsoid
from torch import Tensor

from gsfluent import materials
from gsfluent.data import Frame
from gsfluent.pipeline.matter.state import State
from gsfluent.pipeline.simulate.run import Run
from gsfluent.pipeline.simulate.stage import Simulate
from gsfluent.results.frames import load_frame, save_frame
from gsfluent.scene.scene import Scene

SOFT = materials.elastic.override(young_modulus=2e4)


def dropped(material: materials.Material = SOFT, **options: object) -> Scene:
    scene = Scene(**options)  # type: ignore[arg-type]
    scene.add(
        ellipsoid((0.1, 0.08, 0.06)), material, frame=Frame(torch.eye(3), torch.zeros(3), 1.0)
    )
    scene.drop(0.001)
    return scene


@pytest.fixture(scope="module")
def run() -> Run:
    return Simulate(dx=0.03).run_of(dropped(), 20.0)


def test_gravity_of_a_million_has_failed_with_its_cause() -> None:
    simulation = Simulate(dx=0.03)(dropped(gravity=(0, 0, -1e6)), fps=20, seconds=0.2)
    assert len(list(simulation)) < 4
    report = simulation.report
    assert report["verdict"] == "failed" and "frame" in report["reason"]
    assert "likely cause" in report["reason"] and "hint:" in report["reason"]


@pytest.mark.parametrize("pull", [0.0, 9.81, 98.1])
def test_what_gravity_does_to_jelly_is_plausible(pull: float) -> None:
    simulation = Simulate(dx=0.03)(dropped(gravity=(0, 0, -pull)), fps=20, seconds=0.3)
    assert len(list(simulation)) == 6 and simulation.report["verdict"] == "clean"


def moved(run: Run, change: Callable[[Tensor], Tensor]) -> State:
    state = run.state
    place = change(state.position)
    return state._replace(position=place, particles=state.particles.replace(position=place.float()))


@pytest.mark.parametrize("seed", range(5))
def test_a_body_that_only_moves_and_turns_is_plausible(run: Run, seed: int) -> None:
    chance = torch.Generator().manual_seed(seed)
    turn, _ = torch.linalg.qr(torch.randn(3, 3, generator=chance, dtype=torch.float64))
    way = torch.rand(3, generator=chance, dtype=torch.float64) + torch.tensor([0.0, 0.0, 0.2])
    state = moved(run, lambda x: x.double() @ turn.T + way)
    assert run.watch.implausible(state, [False], 0.0) == ""


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda x: x * torch.tensor([1.0, 1.0, 1e-7]), "m thick, and was"),
        (lambda x: x @ torch.tensor([[1.0, 1, 0], [1, 1, 0], [0, 0, 1]]).to(x), "m thick"),
        (lambda x: x - torch.tensor([0.0, 0.0, 0.15]), "below the floor, with"),
    ],
    ids=["flat", "flat and slanting", "sunk"],
)
def test_what_cannot_be_is_said(run: Run, change: Callable[[Tensor], Tensor], said: str) -> None:
    run.watch.reasons.clear()
    words = run.watch.implausible(moved(run, change), [False], 0.0)
    assert said in words and "'object'" in words
    verdict = run.watch.verdict(3)
    assert verdict.startswith("frame 3: ") and words in verdict and "hint:" in verdict
    # one that waits to be fired, and a world without a floor
    assert run.watch.implausible(moved(run, change), [True], 0.0) == ""


def test_without_a_floor_nothing_lies_below_it(run: Run) -> None:
    state = moved(run, lambda x: x - 5.0)
    assert run.watch.implausible(state, [False], None) == ""


def test_a_lost_volume_is_said(run: Run) -> None:
    strain = run.state.particles.strain.clone()
    strain[:, :3] = 0.1 ** (2 / 3) - 1.0  # J = 0.1 everywhere
    state = run.state._replace(particles=run.state.particles.replace(strain=strain))
    assert "has 0.1 of its volume" in run.watch.implausible(state, [False], 0.0)


def test_a_puddle_may_be_flat() -> None:
    water = dataclasses.replace(materials.get("water"))
    run = Simulate(dx=0.03).run_of(dropped(water), 20.0)
    flat = moved(run, lambda x: x * torch.tensor([3.0, 3.0, 1e-3]))
    assert run.watch.implausible(flat, [False], 0.0) == ""


def test_a_speed_beyond_all_sense_is_finite_on_disk(finished: Path, tmp_path: Path) -> None:
    frame = load_frame(finished / "stages" / "simulate", 0)
    save_frame(tmp_path, dataclasses.replace(frame, velocity=frame.velocity + 1e6))
    assert load_frame(tmp_path, 0).velocity.min() == 65504.0  # the largest half
