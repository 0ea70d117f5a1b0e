"""Liquids in a run: jets leave their nozzle at one speed, films hold to a ball, mass is exact."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from simulation_scenes import at
from simulation_shapes import ellipsoid

from gsfluent import materials
from gsfluent.pipeline.liquid.looks import TICK, Liquids
from gsfluent.pipeline.liquid.nozzle import WAITING
from gsfluent.pipeline.liquid.wetting import Skin, held
from gsfluent.pipeline.matter.state import State, kinetic_energy
from gsfluent.pipeline.simulate.groups import grid_mask
from gsfluent.pipeline.simulate.stage import Simulate
from gsfluent.scene.scene import Scene

DX = 0.008
RADIUS = 0.04
BALL = materials.get("elastic").override(young_modulus=5e4)


def poured(volume: float = 2.5e-5) -> Scene:
    """A jet close above a ball that stands on the floor."""
    scene = Scene()
    scene.add(ellipsoid((RADIUS,) * 3), BALL, frame=at(0, 0, RADIUS))
    scene.pour((0.0, 0, 0.1), 1.0, 0.012, volume=volume, material="milk", at=0.003)
    return scene


def test_a_jet_leaves_its_nozzle_at_one_speed_and_loses_nothing(tmp_path: Path) -> None:
    scene, saved = poured(), tmp_path / "state.pt"
    jet = scene.bodies[1]
    frames = Simulate(dx=DX)(scene, fps=100, seconds=0.06)
    run, waited = frames.run, []
    mass = float(run.matter.particles.mass[run.matter.particles.body == 1].double().sum())
    assert mass == pytest.approx(1030.0 * jet.volume, rel=1e-6)
    for frame in frames:
        group = run.state.group[frame.particles.body == 1]
        waits = group == WAITING
        speed = frame.particles.velocity[frame.particles.body == 1][waits]
        assert torch.allclose(speed, torch.tensor(jet.velocity).expand_as(speed))
        waited.append(int(waits.sum()) / group.shape[0])
        assert frame.stats["momentum_error"] < 1e-5
        if frame.index == 2:
            frames.save(saved)
    assert frames.report["verdict"] == "clean"
    assert waited[0] == 1.0 and waited == sorted(waited, reverse=True)
    # A slice leaves at each look: what is out by then is speed times time.
    gone = 1.0 - waited[-1]
    assert gone * jet.length == pytest.approx(0.05 - 0.003, abs=TICK + 0.15 * DX)
    again = Simulate(dx=DX)(scene, fps=100, seconds=0.06, resume=saved)
    *_, last = again
    assert torch.equal(last.particles.position, frame.particles.position)
    assert torch.equal(last.particles.velocity, frame.particles.velocity)


def test_a_film_holds_to_the_ball_it_wets(monkeypatch: pytest.MonkeyPatch) -> None:
    def median() -> float:
        *_, frame = Simulate(dx=DX)(poured(), fps=50, seconds=0.14)
        milk = frame.particles.position[frame.particles.body == 1]
        arm = milk - torch.tensor([0.0, 0.0, RADIUS])
        low = arm[:, 2] < 0.3 * RADIUS  # where contact alone has let go
        assert int(low.sum()) > 50
        return float(arm[low].norm(dim=1).quantile(0.5)) - RADIUS

    wets = median()
    monkeypatch.setattr("gsfluent.pipeline.liquid.wetting.TEARS", 0.0)
    assert wets < 0.6 * median()


def test_wetting_keeps_momentum_and_takes_energy() -> None:
    scene = poured()
    run = Simulate(dx=DX).run_of(scene, 50.0)
    matter = run.matter
    skin = Skin.of(matter, [0])
    assert skin is not None
    out = matter.rest[skin.rows].double() - torch.tensor([0.0, 0.0, RADIUS])
    out = torch.nn.functional.normalize(out, dim=1)
    assert float((out * skin.normals).sum(dim=1).quantile(0.02)) > 0.93
    # The jet laid as a film around the ball, every point on its way.
    p = matter.particles
    rows = (p.body == 1).nonzero()[:, 0]
    generator = torch.Generator().manual_seed(0)
    way = torch.nn.functional.normalize(torch.randn(len(rows), 3, generator=generator), dim=1)
    around = (RADIUS + 0.5 * DX) * way + p.position.new_tensor([0, 0, RADIUS])
    place = p.position.index_copy(0, rows, around)
    velocity = p.velocity.index_copy(0, rows, 0.5 * torch.randn(len(rows), 3, generator=generator))
    state = State.start(matter, run.stepper.rigid.start, (True, True))
    state = state._replace(
        particles=p.replace(position=place, velocity=velocity), position=place.double()
    )
    there = grid_mask(state, matter)
    after = held(state, skin, rows, there, DX).particles
    momentum = [(p.mass.double()[:, None] * v.double()).sum(0) for v in (velocity, after.velocity)]
    scale = float((p.mass.double() * velocity.double().norm(dim=1)).sum())
    assert float((momentum[0] - momentum[1]).norm()) < 1e-7 * scale
    energy = [kinetic_energy(p.mass, v, p.affine, DX) for v in (velocity, after.velocity)]
    assert float(energy[1]) < 0.99 * float(energy[0])


def test_a_scene_without_liquid_is_not_looked_at() -> None:
    scene = Scene()
    scene.add(ellipsoid((RADIUS,) * 3), BALL, frame=at(0, 0, RADIUS))
    run = Simulate(dx=DX).run_of(scene, 50.0)
    assert Liquids(scene, run.matter).next_look(0.0) == math.inf
    assert run.stepper.liquids.look(run.state, grid_mask(run.state, run.matter)) is run.state
