"""A session one can poke: the same physics as a shot, deterministic, with its balances kept."""

from __future__ import annotations

import math

import pytest
import torch
from simulation_shapes import ellipsoid

from gsfluent import materials
from gsfluent.errors import InputError
from gsfluent.live.session import MOST_LOOSE, LiveSession
from gsfluent.pipeline.simulate.grow import copy_of, grow, shrink
from gsfluent.pipeline.simulate.health import figures_of
from gsfluent.pipeline.simulate.stage import Simulate
from gsfluent.scene.scene import Scene
from gsfluent.stages.simulate import saved

DX = 0.0125
SOFT = materials.elastic.override(young_modulus=2e4)
BULLET = {"type": "bullet", "from": [0.2, 0, 0.05], "toward": [0, 0, 0.05], "speed": 30.0}
BLADE = {"type": "blade", "path": [[0, 0, 0.12], [0, 0, -0.01]], "width": 0.2, "speed": 4.0}
THROW = {"type": "throw", "velocity": [0.5, 0, 2.0], "spin": [0, 9.0, 0]}


def standing(material="fruit.watermelon") -> Scene:
    scene = Scene()
    scene.add(ellipsoid((0.05,) * 3, splats=200), material, name="ball")
    return scene


def session(**options) -> LiveSession:
    return LiveSession(standing(), dx=DX, fps=100.0, **options)


@pytest.mark.parametrize("event", [BULLET, BULLET | {"rigid": True, "radius": 0.02}, BLADE, THROW],
                         ids=["bullet", "rigid bullet", "blade", "throw"])  # fmt: skip
def test_a_poke_is_the_event_of_a_shot(event) -> None:
    at, count = 0.03, 8
    live = session()
    live.advance(at)
    given = live.poke(event)
    assert given["at"] == live.time == at
    frames = live.advance((count - 3 - 1) / 100.0)
    scene = standing()
    scene.add_event(event | {"at": at})
    simulate = Simulate(dx=DX, standing=True)
    simulation = simulate(scene, fps=100.0, seconds=count / 100.0)
    *_, last = simulation
    assert last.index == live.index and last.time == live.time
    # to the bit: the same matter in the same state goes through the same code
    assert torch.equal(last.particles.position, frames[-1].positions)
    assert torch.equal(last.particles.velocity, frames[-1].velocity)
    assert torch.equal(last.damage, frames[-1].damage)
    moved = last.particles.position[:100] - simulate.prepare(scene).rest[:100]
    assert float(moved.norm(dim=1).max()) > 1e-4
    assert simulation.report["substeps"] == live.report()["substeps"] > 0


def test_with_many_frames_a_second_it_still_is_that_event() -> None:
    # at 600 frames a second not every frame is looked at for new pieces
    live = LiveSession(standing(), dx=DX, fps=60.0, slow=10.0)
    live.advance(5 / 600)
    live.poke(BULLET)
    live.advance(5 / 600)
    live.poke(THROW)
    frames = live.advance(15 / 600)
    scene = standing()
    scene.add_event(BULLET | {"at": live.pokes[0]["at"]})
    scene.add_event(THROW | {"at": live.pokes[1]["at"]})
    simulate = Simulate(dx=DX, standing=True)
    *_, last = simulate(scene, fps=600.0, seconds=26 / 600)
    assert last.index == live.index == 25
    assert torch.equal(last.particles.position, frames[-1].positions)
    assert torch.equal(last.fragments, frames[-1].fragments)
    assert float(last.stats["damaged_fraction"]) > 0.0


def test_the_same_pokes_give_the_same_frames() -> None:
    ends = []
    live = session()
    for _ in range(2):
        live.reset()
        live.poke(BULLET)
        live.advance(0.02)
        live.poke(THROW)
        ends.append(live.advance(0.03)[-1])
        live.advance(0.01)  # what comes after does not matter
    assert torch.equal(ends[0].positions, ends[1].positions)
    assert torch.equal(ends[0].gaussians.means, ends[1].gaussians.means)
    assert ends[0].time == ends[1].time


def test_at_rest_nothing_is_computed() -> None:
    live = session()
    assert live.at_rest
    frames = live.advance(0.1)
    assert live.at_rest and live.report()["substeps"] == 0
    assert torch.equal(frames[-1].positions, frames[0].positions)
    live.throw((0, 0, 1.0))
    assert not live.at_rest
    live.advance(0.05)
    assert live.report()["substeps"] > 0


def test_new_matter_leaves_the_old_as_it_was_and_adds_its_own_momentum_and_energy() -> None:
    live = session()
    live.throw((0.3, 0.1, 1.0), spin=(0, 5.0, 2.0))
    live.advance(0.03)
    run = live.run
    before, old = figures_of(run.matter, run.state, run.scene.gravity), run.state
    scene = copy_of(run.scene)
    scene.add_event(BULLET | {"at": live.time})
    grow(run, scene)
    count = old.position.shape[0]
    assert torch.equal(run.state.position[:count], old.position)
    assert torch.equal(run.state.particles.strain[:count], old.particles.strain)
    after = figures_of(run.matter, run.state, run.scene.gravity)
    mass = 4 / 3 * math.pi * 0.008**3 * 7800
    lattice = run.matter.ranges[1][1] - run.matter.ranges[1][0]
    assert lattice > 20
    ball = figures_of(run.matter, run.state, (0, 0, 0)).kinetic - before.kinetic
    assert ball == pytest.approx(0.5 * mass * 30.0**2, rel=1e-6)
    assert after.momentum[0] - before.momentum[0] == pytest.approx(-mass * 30.0, rel=1e-6)
    assert run.ledger.error(run.state, after) < 1e-6
    # and out again
    shrink(run, [1], solids=1)
    gone = figures_of(run.matter, run.state, run.scene.gravity)
    assert gone.momentum == before.momentum and gone.total == before.total
    assert torch.equal(run.state.position, old.position)
    assert run.ledger.error(run.state, gone) < 1e-6
    assert len(run.links) == len(live._prepared[0].links)


def test_balances_hold_over_many_pokes_and_what_flies_away_is_dropped() -> None:
    live = LiveSession(standing(SOFT), dx=DX, fps=50.0)
    for side in (0.2, 0.25, 0.3):
        live.shoot((side, 0.02, 0.09), (-1, 0, 0), 40.0)
        live.advance(0.04)
    assert len(live.scene.bodies) < 4 and live.dropped > 0
    live.throw((0, 0, 1.0))
    live.advance(0.04)
    report = live.report()
    assert report["verdict"] == "clean" and report["momentum_error"] < 1e-5
    assert report["dropped_points"] == live.dropped


def test_no_more_than_so_many_bullets_at_a_time() -> None:
    live = session()
    for i in range(MOST_LOOSE + 3):
        live.shoot((1.0, 0, 0.05 + 0.1 * i), (0, 1, 0), 1.0)
    assert len(live.scene.bodies) == MOST_LOOSE + 1
    assert len(live.run.state.landed) == MOST_LOOSE + 1 and live.dropped > 0
    live.advance(0.02)
    assert live.report()["verdict"] == "clean"


def test_an_impulse_gives_exactly_its_momentum() -> None:
    live = LiveSession(standing(SOFT), dx=DX, fps=100.0)
    velocity = (0.4, -0.2, 1.5)
    live.throw(velocity, spin=(0, 0, 12.0))
    run = live.run
    pushed = run.impulses.given(run.state)
    now = figures_of(run.matter, pushed, run.scene.gravity)
    mass = float(run.matter.particles.mass.double().sum())
    assert now.momentum == pytest.approx([mass * v for v in velocity], rel=1e-6)
    p = pushed.particles
    center = (p.mass[:, None] * pushed.position).sum(0) / p.mass.sum()
    arm = pushed.position - center
    inertia = float((p.mass * (arm[:, 0] ** 2 + arm[:, 1] ** 2)).sum()) + 0.5 * mass * DX**2
    spin = now.angular_momentum[2] - float(
        torch.linalg.cross(center, mass * torch.tensor(velocity).double())[2]
    )
    assert spin == pytest.approx(12.0 * inertia, rel=1e-5)


def test_slow_motion_takes_shorter_steps_to_the_same_place() -> None:
    live = session()
    live.set_slow(4.0)
    assert live.interval == 1 / 400
    frames = live.advance(0.01)
    assert [round(f.time * 400) for f in frames] == [1, 2, 3, 4]
    live.set_slow(1.0)
    assert live.advance(0.01)[-1].time == pytest.approx(0.02, abs=1e-12)


def test_cells_of_quality_live_keep_to_the_device() -> None:
    live = LiveSession(standing())
    assert 2_000 < live.run.matter.particles.count < 8_000


@pytest.mark.parametrize(
    ("poke", "words"),
    [
        (lambda s: s.throw((1, 2)), "three components"),
        (lambda s: s.throw((math.nan, 0, 0)), "finite"),
        (lambda s: s.throw((1, 0, 0), object="cup"), "no object is called 'cup'"),
        (lambda s: s.shoot((1, 0, 0.1), (0, 0, 0)), "must not be zero"),
        (lambda s: s.shoot((1, 0, 0.1), (1, 0, 0), -3.0), "speed"),
        (lambda s: s.shoot((1, 0, 0.1), (1, 0, 0), 3.0, 0.0), "radius"),
        (lambda s: s.shoot((0, 0, 0.05), (1, 0, 0), 3.0), "inside the matter"),
        (lambda s: s.shoot((1, 0, -1.0), (1, 0, 0), 3.0), "below the floor"),
        (lambda s: s.cut([[0, 0, 1]]), "two or more points"),
        (lambda s: s.cut_plane((0, 0, 0)), "must not be zero"),
        (lambda s: s.poke({"type": "drop", "height": 1.0}), "no poke"),
        (lambda s: s.advance(math.inf), "finite"),
        (lambda s: s.set_slow(0.0), "slow"),
    ],
)
def test_bad_pokes_are_refused_and_change_nothing(poke, words) -> None:
    live = session()
    before = live.run.state
    with pytest.raises(InputError, match=words):
        poke(live)
    assert live.run.state is before and live.pokes == [] and live.at_rest


def test_no_object_no_session() -> None:
    with pytest.raises(InputError, match="no object to poke"):
        LiveSession(Scene())
    with pytest.raises(InputError, match="unknown quality"):
        session(quality="superb")


def test_after_a_failure_it_says_so_and_can_be_reset() -> None:
    live = session()
    live.throw((0, 0, 1.0))
    live.advance(0.01)
    broken = live.run.state.particles
    live.run.state = live.run.state._replace(
        particles=broken.replace(velocity=broken.velocity * math.nan)
    )
    assert live.advance(0.05) == [] and "frame 2" in live.failure
    with pytest.raises(InputError, match=r"has failed(.|\n)*reset"):
        live.throw((0, 0, 1.0))
    assert live.report()["verdict"] == "failed"
    live.reset()
    assert live.failure == "" and live.at_rest and live.pokes == []
    live.throw((0, 0, 1.0))
    assert len(live.advance(0.05)) == 5


@pytest.mark.parametrize("rigid", [False, True])
def test_a_late_bullet_hits_as_an_early_one_does(rigid) -> None:
    # its way there, as a free flight from time 0, once led through the floor
    ends = []
    for at in (0.0, 0.5):
        scene = standing()
        scene.add_event(BULLET | {"at": at, "rigid": rigid, "radius": 0.012})
        simulate = Simulate(dx=DX, standing=True)
        frames = list(simulate(scene, fps=50.0, seconds=at + 0.06))
        ends.append(frames[-1])
        seen = saved(frames[0], scene).gaussians
        steel = seen.means[:, 0] > 0.15
        assert bool(steel.any()) == (at == 0.0 or not rigid)
        assert at == 0.0 or not bool(seen.opacities[steel].any())
    early, late = (end.particles.position for end in ends)
    assert float(ends[0].stats["damaged_fraction"]) > 0.01
    assert torch.allclose(early, late, atol=2e-3)
    assert ends[0].stats["damaged_fraction"] == pytest.approx(
        ends[1].stats["damaged_fraction"], rel=0.02
    )


def test_loose_debris_leaves_the_grid_with_its_momentum() -> None:
    scene = Scene(floor=None, gravity=(0, 0, 0))
    scene.add(ellipsoid((0.05,) * 3, splats=200), name="ball")
    live = LiveSession(scene, dx=DX, fps=100.0)
    live.shoot((0.2, 0, 0), (-1, 0, 0), 80.0, 0.01)
    live.advance(0.03)
    run, state = live.run, live.run.state
    assert len(run.scene.bodies) == 2 and 50 < int(state.loose.sum()) < state.loose.numel()
    now = figures_of(run.matter, state, run.scene.gravity)
    bullet = 4 / 3 * math.pi * 0.01**3 * 7800 * 80.0
    assert now.momentum == pytest.approx((-bullet, 0, 0), abs=1e-5 * bullet)
    assert not state.particles.strain[state.loose].any()
