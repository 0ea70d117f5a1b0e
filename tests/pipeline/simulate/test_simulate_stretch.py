"""The total deformation of broken and flowing matter stays a number."""

from __future__ import annotations

import math

import pytest
import torch
from simulation_shapes import ellipsoid

from gsfluent.pipeline.matter.carry import STRETCH
from gsfluent.pipeline.matter.state import State
from gsfluent.pipeline.simulate.run import LARGE, WILD, bounded, tamed
from gsfluent.pipeline.simulate.stage import Simulate
from gsfluent.scene.scene import Scene


def scene() -> Scene:
    ball = Scene()
    ball.add(ellipsoid((0.05,) * 3, splats=200))
    ball.bullet((0.2, 0, 0.05), (0, 0, 0.05), 120.0, radius=0.012)
    return ball


def test_large_deformations_become_what_splats_show_of_them() -> None:
    angle = 0.7
    turn = torch.tensor(
        [[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]]
    )
    wild = turn @ torch.diag(torch.tensor([3e20, 1.2, 1e-9]))
    mild = turn @ torch.diag(torch.tensor([0.9 * LARGE, 1.0, 1.0]))
    lost = torch.full((3, 3), math.nan)
    over = torch.full((3, 3), math.inf)
    result = tamed(torch.stack([wild, mild, lost, over]))
    wanted = turn @ torch.diag(torch.tensor([STRETCH[1], 1.2, STRETCH[0]]))
    assert torch.allclose(result[0], wanted, atol=1e-5)
    assert torch.equal(result[1], mild)
    assert torch.equal(result[2:], torch.eye(3).expand(2, 3, 3))


def test_what_is_tame_is_left_alone() -> None:
    run = Simulate(dx=0.0125).run_of(scene(), 100.0)
    assert bounded(run.state) is run.state
    particles = run.state.particles
    bare = run.state._replace(particles=particles.replace(deformation=None))
    assert bounded(bare) is bare


@pytest.mark.parametrize("amount", [1e12, math.inf])
def test_a_run_goes_on_when_deformations_have_run_away(amount) -> None:
    def spoil(state: State) -> State:
        p = state.particles
        assert p.deformation is not None
        far = p.deformation.clone()
        far[::3] *= amount
        return state._replace(particles=p.replace(deformation=far))

    run = Simulate(dx=0.0125).run_of(scene(), 100.0)
    run.state = spoil(run.state)
    assert run.advance_to(1, None)
    assert run.report()["verdict"] == "clean"


def test_a_hard_shot_keeps_its_deformations_small() -> None:
    simulation = Simulate(dx=0.0125)(scene(), fps=100.0, seconds=0.08)
    *_, last = simulation
    deformation = last.particles.deformation
    # without the bound it was 7e9 here
    assert float(deformation.abs().max()) < WILD
    assert (
        torch.isfinite(last.gaussians.means).all() and torch.isfinite(last.gaussians.scales).all()
    )
    assert simulation.report["verdict"] == "clean"


@pytest.mark.cuda
def test_a_hard_shot_on_the_gpu_outlives_its_deformations() -> None:
    # on an H100 this ended with "deformation must be finite" after 0.2 s
    ball = scene()
    ball.bullet((0, 0.2, 0.05), (0, 0, 0.05), 120.0, radius=0.012, at=0.05)
    simulation = Simulate(dx=0.0125, device="cuda")(ball, fps=100.0, seconds=0.22)
    *_, last = simulation
    assert simulation.report["verdict"] == "clean"
    assert float(last.particles.deformation.abs().max()) < WILD
