"""The simulation stage: flight, balance, contact, health, resume, breaking."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from simulation_shapes import ellipsoid

from gsfluent import materials, ops
from gsfluent.data import Frame
from gsfluent.errors import InputError
from gsfluent.pipeline.simulate.engine import SolverOptions
from gsfluent.pipeline.simulate.stage import Simulate
from gsfluent.scene.scene import Scene

SOFT = materials.elastic.override(young_modulus=2e4)


def at(x: float, y: float, z: float) -> Frame:
    return Frame(torch.eye(3), torch.tensor([x, y, z]), 1.0)


def ball_scene(height: float = 0.3, **scene_options) -> Scene:
    scene = Scene(**scene_options)
    scene.add(ellipsoid(), SOFT)
    scene.drop(height)
    return scene


def test_flight_is_exactly_ballistic():
    scene = Scene(floor=None)
    scene.add(ellipsoid(), SOFT, velocity=(1.0, -2.0, 3.0))
    start = None
    simulation = Simulate(dx=0.04)(scene, fps=10, seconds=1.0)
    for frame in simulation:
        center = frame.particles.position.double().mean(dim=0)
        start = center if start is None else start
        t = frame.time
        wanted = torch.tensor([1.0 * t, -2.0 * t, 3.0 * t - 0.5 * 9.81 * t * t])
        assert torch.allclose(center - start, wanted.double(), atol=2e-6)
    report = simulation.report
    assert report["substeps"] == 0 and report["skipped"]["free_flight_seconds"] == 0.9
    assert report["momentum_error"] < 1e-6


def test_spinning_flight_keeps_energy_and_angular_momentum():
    scene = Scene(floor=None, gravity=(0, 0, 0))
    scene.add(ellipsoid((0.1, 0.07, 0.05)), SOFT, angular_velocity=(1.0, 9.0, 0.5))
    frames = list(Simulate(dx=0.03)(scene, fps=10, seconds=1.5))
    first, last = frames[0], frames[-1]
    assert last.energy["kinetic"] == pytest.approx(first.energy["kinetic"], rel=1e-4)
    spin = torch.tensor([f.stats["angular_momentum"] for f in frames])
    assert torch.allclose(spin, spin[:1].expand_as(spin), rtol=1e-3, atol=1e-3 * spin.abs().max())
    arm = last.particles.position - last.particles.position.mean(dim=0)
    rest = first.particles.position - first.particles.position.mean(dim=0)
    assert torch.allclose(arm.norm(dim=1), rest.norm(dim=1), atol=1e-6)
    assert float((arm - rest).norm(dim=1).max()) > 0.05


def test_flight_equals_the_grid():
    """Leaving the grid out changes nothing but round-off and the grid's own time-step error."""
    ends = []
    for free_flight in (True, False):
        simulation = Simulate(dx=0.04, free_flight=free_flight)(
            ball_scene(0.6), fps=20, seconds=0.35
        )
        *_, last = simulation
        ends.append(last.particles.position)
        steps = simulation.report["substeps"]
        assert (steps == 0) == free_flight
    # symplectic Euler falls g t dt / 2 below the parabola; nothing else may differ
    bias = 0.5 * 9.81 * 0.3 * simulation.report["dt_max"]
    gap = ends[0] - ends[1]
    assert 0 < float(gap[:, 2].min()) and float(gap[:, 2].max()) < 1.02 * bias
    assert float(gap[:, :2].abs().max()) < 1e-5


def test_an_elastic_ball_bounces_and_balances_momentum():
    scene = Scene()
    scene.add(ellipsoid(), materials.elastic)
    scene.drop(0.3)
    simulation = Simulate(dx=0.025)(scene, fps=40, seconds=0.5)
    frames = list(simulation)
    report = simulation.report
    assert report["verdict"] == "clean"
    assert report["momentum_error"] < 1e-5
    total = [f.energy["kinetic"] + f.energy["elastic"] + f.energy["gravity"] for f in frames]
    fall = frames[0].energy["gravity"] - frames[0].particles.mass.sum().item() * 9.81 * 0.1
    assert total[-1] < total[0] and total[0] - total[-1] < 0.25 * fall
    lowest = [float(f.particles.position[:, 2].min()) for f in frames]
    landing = lowest.index(min(lowest))
    assert max(lowest[landing:]) > 0.1
    assert all(f.stats["damaged_fraction"] == 0 for f in frames)


def test_a_ball_comes_to_rest_on_the_floor():
    scene = ball_scene(0.0)
    simulation = Simulate(dx=0.04)(scene, fps=10, seconds=1.5)
    *_, last = simulation
    weight = float(last.particles.mass.sum()) * 9.81
    assert last.energy["kinetic"] < weight * 0.1 * 0.04  # it bounces by a tenth of a cell at most
    lowest = float(last.particles.position[:, 2].min())
    assert -0.02 < lowest < 0.04
    assert simulation.report["momentum_error"] < 1e-5


def test_two_bodies_conserve_momentum_and_exchange_it():
    scene = Scene(floor=None, gravity=(0, 0, 0))
    scene.add(ellipsoid((0.06,) * 3), SOFT, frame=at(-0.1, 0, 0), velocity=(2.0, 0, 0))
    scene.add(ellipsoid((0.06,) * 3), SOFT, frame=at(0.1, 0.02, 0))
    simulate = Simulate(dx=0.02)
    simulation = simulate(scene, fps=40, seconds=0.2)
    frames = list(simulation)
    report = simulation.report
    assert report["momentum_error"] < 1e-6
    assert report["skipped"]["contact_steps_done"] > 0
    a, b = simulate.prepare(scene).ranges
    speed = [frames[-1].particles.velocity[r[0] : r[1], 0].mean().item() for r in (a, b)]
    assert speed[1] > 1.0 > 0.9 > speed[0]


def test_contact_is_left_out_while_bodies_are_apart():
    scene = Scene(floor=0.0)
    scene.add(ellipsoid((0.05,) * 3), SOFT, frame=at(-0.3, 0, 0.05))
    scene.add(ellipsoid((0.05,) * 3), SOFT, frame=at(0.3, 0, 0.05))
    simulation = Simulate(dx=0.02)(scene, fps=20, seconds=0.1)
    list(simulation)
    skipped = simulation.report["skipped"]
    assert skipped["contact_steps"] > 0 and skipped["contact_steps_done"] == 0


def poison(after: int, times: int):
    """Make a hook that writes NaN into one velocity, ``times`` times, after so many steps."""
    left = [times]

    def hook(state):
        if state.step < after or left[0] == 0:
            return state
        left[0] -= 1
        velocity = state.particles.velocity.clone()
        velocity[7, 1] = math.nan
        return state._replace(particles=state.particles.replace(velocity=velocity))

    return hook


def test_one_nan_is_rolled_back_and_healed():
    clean = Simulate(dx=0.04)
    *_, wanted = clean(ball_scene(0.01), fps=20, seconds=0.3)
    simulation = Simulate(dx=0.04, step_hook=poison(30, 1))(ball_scene(0.01), fps=20, seconds=0.3)
    frames = list(simulation)
    report = simulation.report
    assert report["verdict"] == "healed" and report["rollbacks"] == 1
    assert "finite" in report["reason"] or "speed" in report["reason"]
    assert len(frames) == 6
    assert all(f.stats["non_finite"] == 0 for f in frames)
    difference = (frames[-1].particles.position - wanted.particles.position).abs().max()
    assert float(difference) < 0.05 * 0.04


def test_an_incurable_run_fails_and_says_where():
    simulation = Simulate(dx=0.04, step_hook=poison(30, -1), max_rollbacks=3)(
        ball_scene(0.01), fps=20, seconds=0.3
    )
    frames = list(simulation)
    report = simulation.report
    assert report["verdict"] == "failed" and report["rollbacks"] == 3
    assert "frame" in report["reason"] and "step" in report["reason"]
    assert 0 < len(frames) < 6 and report["frames"] == len(frames)
    assert all(bool(torch.isfinite(f.particles.position).all()) for f in frames)


def test_energy_from_nowhere_is_noticed():
    def kick(state):
        if state.step != 30:
            return state
        velocity = state.particles.velocity * 3.0 + 2.0
        return state._replace(particles=state.particles.replace(velocity=velocity))

    simulation = Simulate(dx=0.04, step_hook=kick, max_rollbacks=2)(
        ball_scene(0.01), fps=20, seconds=0.3
    )
    list(simulation)
    report = simulation.report
    assert report["verdict"] in ("healed", "failed") and "energy rose" in report["reason"]


@pytest.mark.parametrize(("cells", "well"), [(0.2, True), (0.5, False)])
def test_a_body_at_rest_may_be_lifted_by_less_than_its_cells_can_tell(cells, well):
    """What it rests on wakes it: nothing moves yet, so no kinetic energy says what is much."""
    scene = Scene()
    scene.add(ellipsoid((0.1,) * 3), materials.elastic, frame=at(0, 0, 0.1))
    run = Simulate(dx=0.04)(scene, fps=50, seconds=0.1).run
    up = torch.tensor([0.0, 0.0, cells * 0.04], dtype=torch.float64)
    lifted = run.state._replace(position=run.state.position + up)
    trouble = run.watch.check(lifted, run.stepper)
    assert (trouble is None) == well


def test_resuming_repeats_the_run_bit_for_bit(tmp_path):
    scene = Scene()
    scene.add(ellipsoid(), materials.fruit.watermelon.override(parts=()))
    scene.drop(1.0)
    wanted, saved = None, tmp_path / "state.pt"
    whole = Simulate(dx=0.03)(scene, fps=40, seconds=0.65)
    for frame in whole:
        if frame.index == 20:
            whole.save(saved)
        wanted = frame
    again = Simulate(dx=0.03)(scene, fps=40, seconds=0.65, resume=saved)
    frames = list(again)
    assert [f.index for f in frames] == list(range(21, 26))
    got = frames[-1]
    for name in ("position", "velocity", "alpha", "strain", "deformation"):
        assert torch.equal(getattr(got.particles, name), getattr(wanted.particles, name)), name
    one, two = whole.report, again.report
    for key in ("substeps", "momentum_error", "verdict", "active_blocks_max"):
        assert one[key] == two[key]
    assert one["per_frame"] == two["per_frame"]


def test_a_state_of_another_scene_is_refused(tmp_path):
    simulation = Simulate(dx=0.04)(ball_scene(), fps=20, seconds=0.1)
    next(iter(simulation))
    simulation.save(tmp_path / "s.pt")
    with pytest.raises(InputError, match="another scene"):
        Simulate(dx=0.04, seed=1)(ball_scene(), fps=20, seconds=0.1, resume=tmp_path / "s.pt")
    with pytest.raises(InputError, match="frames per second"):
        Simulate(dx=0.04)(ball_scene(), fps=30, seconds=0.1, resume=tmp_path / "s.pt")
    with pytest.raises(InputError, match="no file"):
        Simulate(dx=0.04)(ball_scene(), fps=20, seconds=0.1, resume=tmp_path / "none.pt")
    (tmp_path / "bad.pt").write_bytes(b"not a state")
    with pytest.raises(InputError, match="cannot be read"):
        Simulate(dx=0.04)(ball_scene(), fps=20, seconds=0.1, resume=tmp_path / "bad.pt")


def test_bad_settings_are_refused():
    with pytest.raises(InputError, match="quality"):
        Simulate(quality="best")
    with pytest.raises(InputError, match="dx"):
        Simulate(dx=-1.0)
    with pytest.raises(InputError, match="fps"):
        Simulate()(ball_scene(), fps=0)
    with pytest.raises(InputError, match="no frame to save"):
        Simulate()(ball_scene()).save("state.pt")
    with pytest.raises(InputError, match="cfl"):
        Simulate(cfl=1.5)
    with pytest.raises(TypeError, match="courant"):
        Simulate(courant=0.5)


def test_options_are_given_by_name_or_as_one_record():
    options = SolverOptions(cfl=0.3, sleep=False)
    assert Simulate(cfl=0.3, sleep=False).options == options == Simulate(options=options).options
    assert Simulate(options=options, cfl=0.4).options == SolverOptions(cfl=0.4, sleep=False)


@pytest.mark.parametrize(("cfl", "share"), [(0.5, 0.0), (0.8, 0.0), (0.25, 0.5)])
def test_the_solver_keeps_what_shorter_steps_would_lose(monkeypatch, cfl, share):
    made, solver = [], ops.Solver

    def watched(*given, **options):
        made.append(solver(*given, **options))
        return made[-1]

    monkeypatch.setattr(ops, "Solver", watched)
    options = SolverOptions(cfl=cfl, free_flight=False, piece_flight=False, sleep=False)
    for _ in Simulate(dx=0.025, options=options)(ball_scene(), fps=200, seconds=0.01):
        pass
    assert made and all(s.flip == pytest.approx(share) for s in made)


def test_options_are_taken_under_their_old_names(caplog):
    options = Simulate(loose_crumbs=True, loose_debris=True, contact_near=False).options
    assert options == SolverOptions(contact_proximity=False)
    assert "contact_near is called contact_proximity now" in caplog.text
    for name in ("loose_crumbs", "loose_debris"):
        assert f"{name} does nothing now" in caplog.text
    assert "contact_near is called contact_proximity now" in caplog.text


def test_names_in_a_saved_state_stay(tmp_path):
    """What a version before wrote is read by this one, whatever its fields are called now."""
    simulation = Simulate(dx=0.04)(ball_scene(), fps=20, seconds=0.1)
    next(simulation)
    simulation.save(tmp_path / "s.pt")
    values = torch.load(tmp_path / "s.pt", weights_only=True)
    assert sorted(values) == sorted(
        ["version", "fingerprint", "particles", "tensors", "time", "step", "landed", "kicked"]
        + ["extra"]
    )
    assert sorted(values["particles"]) == ["affine", "alpha", "deformation", "strain", "velocity"]
    assert sorted(values["tensors"]) == sorted(
        ["position", "peak", "stray", "field", "cut", "group", "asleep", "calm", "unit"]
        + ["ever", "lowest", "alpha_seen", "time_seen", "calm_at", "cut_links"]
        + ["impulse", "colliders", "work", "dissipated"]
    )
    assert set(values["extra"]) >= {"counters", "watch", "ledger", "per_frame", "repair"}


def test_a_stage_keeps_nothing_of_the_scenes_it_was_given():
    """Two runs of one stage, taken by turns, are those it gives one after the other."""
    simulate = Simulate(dx=0.04)
    alone = list(simulate(ball_scene(0.01), fps=20, seconds=0.15))
    before = dict(vars(simulate))
    low, high = (simulate(ball_scene(h), fps=20, seconds=0.15) for h in (0.01, 0.3))
    frames = [pair[0] for pair in zip(low, high, strict=True)]
    assert dict(vars(simulate)) == before and len(frames) == 3
    for one, two in zip(alone, frames, strict=True):
        assert torch.equal(one.particles.position, two.particles.position)
        assert torch.equal(one.gaussians.means, two.gaussians.means)
    assert low.report["frames"] == 3 and next(low, None) is None


def test_a_bullet_gives_momentum_to_what_it_hits():
    scene = Scene(floor=None, gravity=(0, 0, 0))
    scene.add(ellipsoid((0.04,) * 3), materials.fruit.watermelon)
    scene.bullet(start=(0.3, 0, 0), toward=(0, 0, 0), speed=40.0, radius=0.008, at=0.0)
    simulate = Simulate(dx=0.008)
    simulation = simulate(scene, fps=100, seconds=0.03)
    frames = list(simulation)
    apple, bullet = simulate.prepare(scene).ranges
    report = simulation.report
    assert report["momentum_error"] < 1e-5
    last = frames[-1].particles
    assert float(last.velocity[bullet[0] : bullet[1], 0].mean()) > -38.0
    pushed = (last.mass[:, None] * last.velocity)[apple[0] : apple[1], 0].sum()
    assert float(pushed) < -0.01
    assert frames[-1].stats["damaged_fraction"] > 0.002
    assert report["skipped"]["free_flight_body_steps"] >= 0


def test_frame_times_are_exact_and_figures_complete():
    frames = list(Simulate(dx=0.04)(ball_scene(0.0), fps=24, seconds=0.25))
    assert [f.time for f in frames] == [k / 24 for k in range(6)]
    for key in (
        "kinetic",
        "elastic",
        "dissipated",
        "gravity",
        "momentum",
        "angular_momentum",
        "damaged_fraction",
        "fragments",
        "largest_fragment",
        "alpha_max",
        "non_finite",
    ):
        assert key in frames[-1].stats  # fmt: skip


@pytest.mark.parametrize(
    "change",
    [{"young_modulus": 3e5}, {"density": 1200.0}, {"cohesion": 0.5}, {"hardening": 2.0},
     {"friction_angle": 20.0}, {"alpha0": -0.01}, {"shear_damage": 0.1}, {"poisson_ratio": 0.1},
     {"law": "elastic"}],
)  # fmt: skip
def test_every_material_parameter_changes_the_result(change):
    ends = []
    for material in (materials.fruit.apple, materials.fruit.apple.override(**change)):
        scene = Scene()
        scene.add(ellipsoid((0.05,) * 3), material, velocity=(0, 0, -6.0))
        scene.drop(0.02)
        *_, last = Simulate(dx=0.02, splats=False)(scene, fps=50, seconds=0.05)
        ends.append(last.particles.position)
    assert float((ends[0] - ends[1]).abs().max()) > 1e-6


def test_irreversible_breaking_changes_what_pressed_debris_can_hold():
    shares = []
    for irreversible in (True, False):
        scene = Scene()
        scene.add(ellipsoid((0.05,) * 3), materials.fruit.apple, velocity=(0, 0, -20.0))
        scene.drop(0.02)
        simulate = Simulate(dx=0.02, splats=False, irreversible=irreversible)
        *_, last = simulate(scene, fps=50, seconds=0.06)
        assert last.stats["damaged_fraction"] > 0.1
        shares.append(last.particles.alpha)
    assert not torch.equal(shares[0], shares[1])


def test_far_debris_leaves_the_grid_and_still_balances_momentum():
    def throw(state):
        if state.step != 20:
            return state
        p = state.particles
        position = p.position.clone()
        position[:10] += torch.tensor([3.0, 0.0, 0.0])
        peak = state.peak.clone()
        peak[:10] = 0.1
        return state._replace(particles=p.replace(position=position), peak=peak)

    scene = Scene()
    material = materials.fruit.apple.override(variation=0.0)
    scene.add(ellipsoid((0.05,) * 3), material)
    scene.drop(0.001)
    simulation = Simulate(dx=0.02, splats=False, step_hook=throw)(scene, fps=20, seconds=0.3)
    *_, last = simulation
    report = simulation.report
    assert report["skipped"]["stray_points"] == 10
    assert report["active_blocks_max"] < 200
    assert report["momentum_error"] < 1e-5
    debris = last.particles.position[:10]
    assert float(debris[:, 2].abs().max()) < 1e-6 and float(debris[:, 0].min()) > 2.5
    assert float(last.particles.velocity[:10].abs().max()) < 1e-6


def test_points_on_the_device_are_whole_after_landing_one_by_one():
    """The bodies land at different times; nothing is lost and rows keep their meaning."""
    scene = Scene()
    scene.add(ellipsoid((0.05,) * 3), SOFT, frame=at(-0.2, 0, 0.06))
    scene.add(ellipsoid((0.05,) * 3), SOFT, frame=at(0.2, 0, 0.4))
    simulate = Simulate(dx=0.025)
    simulation = simulate(scene, fps=20, seconds=0.2)
    frames = list(simulation)
    second = simulate.prepare(scene).ranges[1]
    fallen = frames[-1].particles.position[second[0] : second[1], 2].mean()
    start = frames[0].particles.position[second[0] : second[1], 2].mean()
    t = frames[-1].time
    assert float(start - fallen) == pytest.approx(0.5 * 9.81 * t * t, rel=1e-4)
    assert simulation.report["skipped"]["free_flight_body_steps"] > 0
    assert simulation.report["momentum_error"] < 1e-5
    assert dataclasses.is_dataclass(frames[-1])
