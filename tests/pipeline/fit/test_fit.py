"""Fits find what made a motion, and say what the motion does not show."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from fit_scenes import SIDE, elastic, scene, seen

from gsfluent import materials
from gsfluent.data import Camera
from gsfluent.draw import draw
from gsfluent.errors import InputError
from gsfluent.geometry import look_at
from gsfluent.materials import Material
from gsfluent.pipeline import Fit
from gsfluent.pipeline.fit.forward import Forward
from gsfluent.pipeline.fit.parameters import FINER, Parameter, Unknowns, read_learn
from gsfluent.pipeline.fit.solve import (
    Problem,
    _covariance,
    in_stages,
    lasting,
    linearise,
    run_at,
    search,
)
from gsfluent.pipeline.fit.stage import LEFT, conclude, least_informed
from gsfluent.pipeline.fit.task import unknowns_of
from gsfluent.pipeline.matter import build_matter
from gsfluent.targets import Clouds, Force, Masks, Points
from gsfluent.targets.target import Followers

DX = 0.08
NAMES = ["thing.young_modulus", "thing.poisson_ratio", "thing.velocity"]


@pytest.fixture(scope="module")
def tracks() -> Any:
    """A cube that flies, lands and bounces."""
    return seen(scene(elastic(1e5, 0.3), velocity=(0.2, 0.0, -2.0)), DX)[0]


def problem(target: Any, guess: Any, names: list[str]) -> Problem:
    forward = Forward(guess, target.times, DX)
    unknowns = read_learn(guess, names)
    return Problem(forward, target.observe(forward.setting()), unknowns, target.step)


def test_a_twin_is_found(tracks: Any) -> None:
    """The search alone, on the grid of the truth: its own error, and nothing of the grid's."""
    guess = scene(elastic(2e4, 0.15), velocity=(0.2, 0.0, -1.6))
    made = problem(Points(tracks), guess, NAMES)
    found = in_stages(made, made.unknowns.start)
    values = made.unknowns.values(found.free)
    assert math.log10(values["thing.young_modulus"]) == pytest.approx(5.0, abs=1e-4)
    assert values["thing.poisson_ratio"] == pytest.approx(0.3, abs=1e-3)
    np.testing.assert_allclose(values["thing.velocity"], (0.2, 0.0, -2.0), atol=1e-3)
    assert found.rms < 1e-2 and found.runs < 120


def test_the_same_bits_twice(tracks: Any) -> None:
    made = problem(Points(tracks), scene(elastic(7e4)), NAMES[:1])
    one, two = (search(made, made.unknowns.start, 5, rounds=2).free for _ in range(2))
    assert np.array_equal(one, two)


def test_masses_are_shared_out_as_in_a_simulation() -> None:
    flows = materials.get("water")
    for material, even in ((elastic(), False), (flows, True)):
        thing = scene(material)
        own = Forward(thing, [0.0, 0.1], DX)._mass
        wanted = build_matter(thing, DX, inertia=True).particles.mass.double()
        assert (float(own.std() / own.mean()) < 1e-6) == even
        for of in (torch.min, torch.max):
            assert float(of(own) / own.mean()) == pytest.approx(
                float(of(wanted) / wanted.mean()), abs=0.1
            )


def test_the_motion_is_that_of_the_closed_form_before_contact() -> None:
    made = scene(elastic(), velocity=(0.3, -0.1, 0.5), gap=0.5)
    forward = Forward(made, [0.0, 0.05, 0.1], DX)
    values = {"thing.velocity": [0.3, -0.1, 0.2], "thing.angular_velocity": [0.0, 0.0, 2.0]}
    motion = forward.run(values, 3, forward.step(values))
    middle = motion.position.mean(dim=1)
    wanted = torch.tensor([0.03, -0.01, 0.02 - 0.5 * 9.81 * 0.01], dtype=torch.float64)
    torch.testing.assert_close(middle[2] - middle[0], wanted, atol=1e-3, rtol=0)
    arm = motion.position - middle[:, None]
    turned = torch.atan2(
        (arm[0, :, 0] * arm[2, :, 1] - arm[0, :, 1] * arm[2, :, 0]).sum(),
        (arm[0, :, :2] * arm[2, :, :2]).sum(),
    )
    assert float(turned) == pytest.approx(0.2, abs=0.02)


def test_what_a_grid_shifts_is_noise_of_the_body_not_of_its_points(tracks: Any) -> None:
    made = problem(Points(tracks), scene(elastic(1e5)), NAMES[:1])
    frames = len(tracks)
    finer = Forward(made.forward.scene, made.forward.times, 0.5 * DX)
    made.refine(finer, made.unknowns.start, frames)
    shift, turn, strain = made.trust[-1, 1:]
    assert shift < 0.2 * made.trust[-1, 0] and max(turn, strain) <= 1.0
    assert (np.diff(made.trust[:, 1:], axis=0) <= 0.0).all()  # no pattern is surer later
    gap = np.random.default_rng(0).normal(size=3 * tracks.shape[1] * (frames - 1))
    frame = np.repeat(np.arange(1, frames), 3 * tracks.shape[1])
    np.testing.assert_allclose(made.weighed(made.weighed(gap, frame), frame, -1.0), gap)
    even = np.where(frame == frames - 1, np.tile([1.0, 0.0, 0.0], len(frame) // 3), 0.0)
    np.testing.assert_allclose(made.weighed(even, frame), shift * even, atol=1e-12)


def test_noise_is_in_the_bands(tracks: Any) -> None:
    """3 mm on each coordinate: the truth within three of the sd that the fit itself gives."""
    noisy = tracks + 3e-3 * np.random.default_rng(1).standard_normal(tracks.shape)
    made = problem(
        Points(noisy, sigma=3e-3), scene(elastic(8e4), velocity=(0.2, 0.0, -2.0)), NAMES[:2]
    )
    found = in_stages(made, made.unknowns.start, shares=(0.5, 1.0))
    sd = np.sqrt(np.diag(found.covariance))
    truth = Unknowns(read_learn(scene(elastic()), NAMES[:2]).parameters).start
    assert (np.abs(found.free - truth) < 3.0 * sd).all() and 0.9 < found.rms < 1.1
    assert sd[0] < 0.02


def test_clouds_without_names_find_the_stiffness() -> None:
    forward = Forward(scene(elastic(1e5)), [k / 24 for k in range(7)], DX)
    motion = forward.run({}, 7, forward.step({}))
    random = np.random.default_rng(0)
    skin = (random.random((2400, 3)) - 0.5) * SIDE
    axis = random.integers(0, 3, 2400)
    skin[np.arange(2400), axis] = 0.5 * SIDE * np.sign(skin[np.arange(2400), axis])
    follow = Followers(
        "test", torch.from_numpy(skin + [0, 0, 0.5 * SIDE + 0.06]), forward.setting()
    )
    clouds = [
        follow.places(motion, k)[0].numpy()[random.permutation(2400)[: 2400 - 7 * k]]
        for k in range(7)
    ]
    made = problem(Clouds(clouds, most=2400), scene(elastic(5e4)), NAMES[:1])
    found = search(made, made.unknowns.start, 7)
    assert abs(found.free[0] - 5.0) < 1e-3


def test_silhouettes_find_the_stiffness() -> None:
    """Two cameras; the truth is drawn at four times the pixels that are compared."""
    forward = Forward(scene(elastic(1e5)), [k / 24 for k in range(6)], DX)
    motion = forward.run({}, 6, forward.step({}))
    splats = forward.setting().splats
    assert splats is not None
    follow = Followers("test", splats.means.double(), forward.setting())
    cameras, films = [], []
    K = torch.tensor([[120.0, 0, 64], [0, 120.0, 64], [0, 0, 1]], dtype=torch.float64)
    for angle in (0.2, 1.7):
        eye = torch.tensor([1.1 * math.cos(angle), 1.1 * math.sin(angle), 0.35])
        pose = look_at(
            eye.double(), torch.tensor([0, 0, 0.2]).double(), torch.tensor([0, 0, 1.0]).double()
        )
        cameras.append(Camera(pose, K, 128, 128))
        films.append(
            [
                draw(splats.replace(means=follow.places(motion, k)[0].float()), cameras[-1]).alpha
                for k in range(6)
            ]
        )
    masks = torch.stack([torch.stack(film) for film in films]).numpy()
    made = problem(Masks(cameras, masks), scene(elastic(7e4)), NAMES[:1])
    found = search(made, made.unknowns.start, 6, rounds=8)
    assert abs(found.free[0] - 5.0) < 0.03


def test_a_press_shows_the_stiffness_by_its_force() -> None:
    def pressed(young: float) -> Any:
        made = scene(elastic(young), velocity=(0.0, 0.0, 0.0), gap=0.0)
        made.add_collider(
            "plane", at=(0.0, 0.0, 0.32), normal=(0.0, 0.0, -1.0), velocity=(0.0, 0.0, -0.2),
            name="press",
        )  # fmt: skip
        return made

    times = [0.02 * k for k in range(8)]
    forward = Forward(pressed(1e5), times, DX)
    motion = forward.run({}, 8, forward.step({}))
    row = forward.rigid.names.index("press")
    force = -motion.impulse[:, row, 2].double().diff() / 0.02
    target = Force([0.2 * t for t in times], [0.0, *force.tolist()], speed=0.2)
    made = problem(target, pressed(3e4), NAMES[:1])
    found = search(made, made.unknowns.start, 8)
    assert abs(found.free[0] - 5.0) < 1e-3


def test_what_the_motion_does_not_show_is_a_bound() -> None:
    """In free flight nothing strains: stiffness and ratio stay beliefs, the velocity is found."""
    truth = scene(elastic(1e5), velocity=(0.1, 0.0, 0.0), gap=1.0)
    tracks, _ = seen(truth, DX, frames=5)
    guess = scene(elastic(3e4), gap=1.0, velocity=(0.0, 0.0, 0.1))
    found = Fit(NAMES, starts=1, cells=4, grids=1)(guess, Points(tracks))
    assert set(found.unidentified) == {"thing.young_modulus", "thing.poisson_ratio"}
    assert "between" in found.unidentified["thing.young_modulus"]
    np.testing.assert_allclose(found.values["thing.velocity"], (0.1, 0.0, 0.0), atol=2e-3)
    assert found.scene.bodies[0].material.young_modulus == 3e4  # no value of what is unknown
    assert found.scene.bodies[0].velocity == tuple(found.values["thing.velocity"])
    assert "1 %" in found.report["warnings"][0] and found.report["least_informed"]


def test_two_grids_and_several_starts_widen_the_band(tracks: Any) -> None:
    calls: list[int] = []

    def runner(function: Any, items: Any) -> list[Any]:
        done = [function(item) for item in items]
        calls.append(len(done))
        return done

    fit = Fit({"thing": {"young_modulus": (1e4, 1e6)}}, starts=2, cells=4, runner=runner)
    found = fit(scene(elastic(3e5), velocity=(0.2, 0.0, -2.0)), Points(tracks[:6]))
    assert calls == [2, 1]
    number = found.report["parameters"]["thing.young_modulus"]
    assert number["sd"] >= 0.5 * LEFT * abs(number["grid"][0]) > 0.0
    assert abs(math.log10(number["value"]) - 5.0) < 0.3
    assert [g["points"] for g in found.report["grids"]] == [512, 4096]


def test_a_finer_grid_sets_right_what_a_coarse_one_does_wrong() -> None:
    """The truth on three times as many cells, shaken by nothing: one grid alone is far off."""
    truth = scene(elastic(1e5), velocity=(0.0, 0.0, -2.0))
    tracks, _ = seen(truth, SIDE / 12, frames=8)
    guess = scene(elastic(8e4), velocity=(0.0, 0.0, -2.0))
    one, two = (
        Fit(NAMES[:1], starts=1, cells=4, grids=grids, offset=False)(guess, Points(tracks))
        for grids in (1, 2)
    )
    error = [abs(math.log10(f.values[NAMES[0]]) - 5.0) for f in (one, two)]
    assert error[1] < 0.25 * error[0]
    assert two.report["rms"] < 0.6 * one.report["rms"]
    assert 1.0 < two.values["grid.extrapolation"] < 2.0
    moved = two.report["parameters"][NAMES[0]]["grid"][0]
    assert two.sd[NAMES[0]] >= 0.5 * LEFT * abs(moved) > 0.0


def test_with_the_whole_change_the_finer_grid_is_what_is_compared(tracks: Any) -> None:
    """Its own points, not those of the coarser grid moved as they are."""
    guess, target = scene(elastic(8e4), velocity=(0.2, 0.0, -2.0)), Points(tracks)
    forward, finer = Forward(guess, target.times, DX), Forward(guess, target.times, DX / 2)
    unknowns = unknowns_of(guess, NAMES, offset=False)
    free = unknowns.start.copy()
    free[unknowns.slices()[FINER]] = 1.0
    fine = target.observe(finer.setting())
    bound = target.observe(forward.setting())
    gaps = []
    for one in (None, fine):
        made = Problem(forward, bound, unknowns, target.step, fine=one)
        made.refine(finer, free, 6)
        gaps.append(made._gaps(run_at(made, free, 6)[1], 6, None)[0])
    values = unknowns.values(free)
    values.pop(FINER)
    alone = fine.residuals(finer.run(values, 6, finer.step(values)), 6, None)[0].numpy()
    np.testing.assert_allclose(gaps[1], alone, atol=1e-6)
    assert np.abs(gaps[0] - alone).max() > 1e-3


def test_coordinates_and_values_are_inverse() -> None:
    for key, value in (
        ("a.young_modulus", 3e5), ("a.poisson_ratio", 0.31), ("a.friction_angle", 41.0),
        ("a.velocity", -2.0), ("floor.offset", 0.4),
    ):  # fmt: skip
        p = Parameter(key, (value,))
        free = p.free([value])
        assert p.value(free)[0] == pytest.approx(value)
        slope = (p.value(free + 1e-6) - p.value(free))[0] / 1e-6
        if p.kind != "log":  # reported in decades
            assert slope == pytest.approx(p.slope(free)[0], rel=1e-4)


def test_starts_fill_the_bounds() -> None:
    unknowns = read_learn(scene(elastic()), {"thing": {"young_modulus": (1e3, 1e7)}})
    drawn = np.sort([s[0] for s in unknowns.starts(5, 0)[1:]])
    assert (np.floor(drawn - 3.0) == np.arange(4)).all()  # one in each quarter


def test_what_goes_together_is_said_in_words() -> None:
    unknowns = read_learn(scene(elastic()), NAMES[:2])
    weak = np.array([[1.0, -1.0], [-1.0, 1.0]]) * 1e4 + np.eye(2)
    words = least_informed(weak, unknowns.labels(), unknowns)
    assert len(words) == 1 and "young_modulus up with thing.poisson_ratio up" in words[0]
    state = {"free": unknowns.start, "covariance": np.linalg.inv(weak), "information": weak,
             "strain": 0.2, "rms": 1.0, "per_frame": [], "grids": []}  # fmt: skip
    found = conclude(scene(elastic()), unknowns, state, [])
    assert list(found.correlation) == [("thing.poisson_ratio", "thing.young_modulus")]


@pytest.mark.parametrize(
    ("learn", "what"),
    [
        (["nobody.young_modulus"], "no object"), (["thing.viscosity"], "cannot be learnt"),
        (["thing.density"], "stiffness over density"), ([], "nothing is to be learnt"),
        ({"thing": {"young_modulus": (5, 1)}}, "bounds"), ({"thing": {"young_modulus": 3}}, "give"),
    ],
)  # fmt: skip
def test_what_cannot_be_learnt_is_said(learn: Any, what: str) -> None:
    with pytest.raises(InputError, match=what):
        read_learn(scene(elastic()), learn)


def test_what_breaks_is_refused() -> None:
    with pytest.raises(InputError, match="does not break"):
        Forward(scene(Material("m", 1e6, 0.3, 900.0)), [0.0, 0.1], DX)


def test_targets_elsewhere_are_refused(tracks: Any) -> None:
    with pytest.raises(InputError, match="from the matter"):
        problem(Points(tracks + 5.0), scene(elastic()), NAMES[:1])
    for wrong in (tracks[0], tracks[:1], np.full_like(tracks, np.nan)):
        with pytest.raises(InputError, match=r"targets\.Points"):
            Points(wrong)
    with pytest.raises(InputError, match="ascend"):
        Force([0, 0.1, 0.1], [0, 1, 2], speed=1.0)


def test_runs_side_by_side_are_those_one_by_one(
    tracks: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a GPU does them: bodies that never meet, on the same floor, and the same Jacobian."""
    made = problem(Points(tracks), scene(elastic(7e4)), NAMES)
    forward, free = made.forward, made.unknowns.start
    values = [made.unknowns.values(free + step) for step in (0.0, 0.1, -0.1)]
    dt = 0.8 * forward.step(values[1])
    alone = [forward.run(v, 6, dt) for v in values]
    together = forward.run_all(values, 6, dt)
    for one, other in zip(alone, together, strict=True):
        assert float((one.position - other.position).abs().max()) < 1e-9
        assert float((one.deformation - other.deformation).abs().max()) < 1e-8
    assert float((alone[1].position - alone[2].position).abs().max()) > 1e-3
    before = linearise(made, free, 6)
    monkeypatch.setattr(Forward, "side_by_side", 2)
    runs = forward.runs
    after = linearise(made, free, 6)
    size = float(np.abs(before.jacobian).max())
    assert float(np.abs(after.jacobian - before.jacobian).max()) < 1e-4 * size
    assert forward.runs - runs == 5  # its middle is known


def test_a_misfit_that_lasts_widens_the_bands_and_noise_does_not() -> None:
    """A millimetre too far in every frame of contact hides in a number; as much noise does not."""
    random = np.random.default_rng(0)
    frame = np.repeat(np.arange(8), 60)
    way = random.standard_normal(60)
    jacobian = np.concatenate([(k + 1) * way for k in range(8)])[:, None]
    pattern = random.standard_normal(60)
    lasts = np.concatenate([np.sin(0.4 * k) * pattern for k in range(8)])
    noise = random.standard_normal(480)
    still = np.tile(pattern, 8)  # a point that was seen wrong in frame 0
    assert lasting(lasts, frame) > 0.3
    assert lasting(noise, frame) == 0.0 and lasting(still + 0.1 * noise, frame) == 0.0
    assert lasting(noise[1:], frame[1:]) == 0.0
    one, rows = np.ones(480), np.arange(1)
    sd = [
        float(np.sqrt(_covariance(jacobian, r, one, frame, np.ones(1), rows)[0, 0]))
        for r in (noise, lasts)
    ]
    exact = 1.0 / np.sqrt(float((jacobian**2).sum()) + 1.0)
    assert sd[0] < 2.0 * exact and sd[1] > 5.0 * exact
