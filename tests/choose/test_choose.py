"""The choice by error: Richardson on sequences of known order, and what is picked from them."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from simulation_shapes import ellipsoid

from gsfluent import materials
from gsfluent.choose import shot as choose_shot
from gsfluent.choose.choose import Growth, Probes, Probing, choose, summary
from gsfluent.choose.fit import Fit, History, fit_history
from gsfluent.choose.pick import pick, ranked
from gsfluent.choose.probe import Probe, Seen, window
from gsfluent.choose.seconds import measured_rates, work_of
from gsfluent.config import Shot
from gsfluent.config.settings_solve import read_error
from gsfluent.data import Frame
from gsfluent.errors import InputError
from gsfluent.figure.choice import draw_choice
from gsfluent.progress import LineReporter
from gsfluent.results.record import RunRecord
from gsfluent.results.store import StageStore
from gsfluent.scene.scene import Scene
from gsfluent.stages.context import RunContext

SIZES = (1 / 10, 1 / 14, 1 / 20)
TIME = np.linspace(0.0, 1.0, 12)[:, None]
TRUTH = np.hstack([np.sin(3.0 * TIME), np.cos(2.0 * TIME)])
SHAPE = np.hstack([TIME, 1.0 - TIME])


def made(order: float, amplitude: float, noise: float = 0.0, **keys: Any) -> History:
    """Histories that approach TRUTH with a known order, and seeds that differ by chance."""
    rng = np.random.default_rng(7)
    values = []
    for size in SIZES:
        mean = TRUTH + amplitude * SHAPE * size**order
        off = noise * rng.standard_normal((3, 1, 2)) * np.ones((3, 12, 2))
        values.append(mean + off)
    return History("place", SIZES, tuple(values), **keys)


def true_error(order: float, amplitude: float, size: float) -> float:
    return float(amplitude * size**order * np.sqrt((SHAPE**2).sum(axis=1).mean()))


def fourth_power(cells: int, cfl: float) -> float:
    return 1e-4 * cells**4 * 0.5 / cfl


@pytest.mark.parametrize("order", [0.7, 1.0, 1.6, 2.0])
def test_the_order_and_the_error_are_those_of_the_sequence(order: float) -> None:
    fit = fit_history(made(order, 4.0))
    assert fit.order == pytest.approx(order, abs=1e-6)
    assert fit.misfit < 1e-6
    assert fit.asymptotic
    for cells in (20, 40, 80):  # two of them finer than anything that was run
        wanted = true_error(order, 4.0, 1.0 / cells)
        assert np.median(fit.errors(1.0 / cells)) == pytest.approx(wanted, rel=1e-4)


def test_a_scalar_gives_the_order_of_roache() -> None:
    """Three levels at ratio 2: p = ln((f1 - f2) / (f2 - f3)) / ln 2 (Roache 1998, eq. 5.6.1)."""
    values = [1.0 + 0.3, 1.0 + 0.12, 1.0 + 0.045]
    p = np.log((values[0] - values[1]) / (values[1] - values[2])) / np.log(2.0)
    history = History("x", (0.4, 0.2, 0.1), tuple(np.full((1, 1, 1), v) for v in values))
    # the order is looked for on a grid of 0.025
    assert fit_history(history).order == pytest.approx(p, abs=0.0126)


def test_the_distance_to_a_finer_grid_leaves_out_what_both_are_off_by() -> None:
    fit = fit_history(made(1.0, 4.0))
    wanted = true_error(1.0, 4.0, 1 / 20) - true_error(1.0, 4.0, 1 / 40)
    assert np.median(fit.gaps(1 / 20, 1 / 40)) == pytest.approx(wanted, rel=1e-4)


def test_an_order_beyond_what_the_method_has_is_not_believed() -> None:
    fit = fit_history(made(4.0, 40.0))
    assert fit.order == pytest.approx(2.0)
    # and what is said of finer cells is more than the truth, not less
    assert np.median(fit.errors(1 / 40)) > true_error(4.0, 40.0, 1 / 40)


def test_uncertainty_widens_with_noise() -> None:
    widths = []
    for noise in (0.0, 0.002, 0.01):
        error = fit_history(made(1.0, 2.0, noise)).mean_errors(1 / 40)
        low, high = np.quantile(error, [0.05, 0.95])
        widths.append(high - low)
        assert low <= true_error(1.0, 2.0, 1 / 40) <= high or noise == 0.0
    assert widths[0] < 1e-6 < widths[1] < widths[2]


def test_what_does_not_settle_is_said_to() -> None:
    """The changes grow and turn round: no power of the cells."""
    values = tuple(
        (TRUTH + off * SHAPE)[None].repeat(2, axis=0) for off in (0.0, 0.10, -0.20)
    )  # fmt: skip
    fit = fit_history(History("place", SIZES, values))
    assert not fit.asymptotic
    settings = ranked([fit], 0.4, fourth_power)
    assert "not yet in the asymptotic range: place" in pick([fit], settings, 0.4).reason


def test_the_cheapest_that_meets_the_bound_is_chosen() -> None:
    fits = [fit_history(made(1.0, 1.0)), fit_history(made(2.0, 9.0))]
    choice = pick(fits, ranked(fits, 0.04, fourth_power), 0.04)
    fine = [
        c for c in (10, 12, 14, 16, 20, 24, 28, 32, 40)
        if max(true_error(1.0, 1.0, 1 / c), true_error(2.0, 9.0, 1 / c)) <= 0.04
    ]  # fmt: skip
    assert choice.chosen is not None
    assert choice.chosen.cells == fine[0]
    assert choice.sure == 1.0
    assert choice.floor == 0.0


def test_a_longer_step_is_taken_only_where_its_own_error_fits() -> None:
    fits = [fit_history(made(1.0, 1.0))]
    free = ranked(fits, 0.04, fourth_power, steps={0.5: {}, 0.7: {"place": (0.0, 1 / 14)}})
    dear = ranked(fits, 0.04, fourth_power, steps={0.5: {}, 0.7: {"place": (1.0, 1 / 14)}})
    chosen = [pick(fits, settings, 0.04).chosen for settings in (free, dear)]
    assert [s.cfl for s in chosen if s is not None] == [0.7, 0.5]


def test_growth_after_the_probed_frames_asks_for_finer_cells() -> None:
    fits = [fit_history(made(1.0, 1.0))]
    plain = pick(fits, ranked(fits, 0.04, fourth_power), 0.04).chosen
    grown = pick(fits, ranked(fits, 0.04, fourth_power, growth={"place": 2.0}), 0.04).chosen
    assert plain is not None and grown is not None
    assert grown.cells >= 1.7 * plain.cells


def test_no_setting_claims_less_than_chance() -> None:
    fits = [fit_history(made(1.0, 0.5, noise=0.05, chaotic=True))]
    settings = ranked(fits, 0.02, fourth_power)
    choice = pick(fits, settings, 0.02)
    assert choice.chosen is None
    assert choice.floor > 0.02
    assert min(s.error for s in settings) >= choice.floor
    assert "no setting can claim 2.0%" in choice.reason
    assert choice.enough is not None  # where finer cells change less than chance does


def test_chance_is_not_taken_for_an_error_of_the_cells() -> None:
    """No error at all, only scatter: what is said of the cells stays below the scatter's own."""
    fit = fit_history(made(1.0, 0.0, noise=0.05, chaotic=True))
    scatter = fit.history.scatter(1 / 20)
    assert scatter == pytest.approx(0.05 * np.sqrt(2.0), rel=0.5)
    assert np.median(fit.mean_errors(1 / 20)) < 0.7 * scatter
    plain = fit_history(made(1.0, 4.0, noise=0.05, chaotic=True))
    assert np.median(plain.mean_errors(1 / 20)) == pytest.approx(
        true_error(1.0, 4.0, 1 / 20), rel=0.6
    )


def test_few_seeds_know_their_scatter_badly() -> None:
    """Two levels count, of three seeds and two components: 8 free values, chi^2_8 / 8."""
    fit = fit_history(made(1.0, 0.0, noise=0.05, chaotic=True), draws=4000)
    low, high = np.quantile(fit.chance, [0.05, 0.95])
    assert low == pytest.approx(np.sqrt(8 / 15.51), rel=0.03)  # tables of chi^2_8: 2.733, 15.51
    assert high == pytest.approx(np.sqrt(8 / 2.733), rel=0.03)


def test_a_bound_beyond_the_finest_grid_is_refused() -> None:
    fits = [fit_history(made(0.6, 3.0))]
    choice = pick(fits, ranked(fits, 1e-3, fourth_power), 1e-3)
    assert choice.chosen is None and choice.enough is None
    assert "no setting" in choice.reason
    assert choice.within == pytest.approx(true_error(0.6, 3.0, 1 / 128), rel=1e-3)


@pytest.mark.parametrize(
    ("sizes", "count", "message"),
    [
        ((0.2, 0.1), 2, "three levels"),
        ((0.1, 0.2, 0.3), 3, "must fall"),
    ],
)
def test_levels_that_cannot_be_fitted_are_refused(
    sizes: tuple[float, ...], count: int, message: str
) -> None:
    history = History("x", sizes, tuple(np.zeros((1, 2, 1)) for _ in range(count)))
    with pytest.raises(ValueError, match=message):
        fit_history(history)


def test_the_window_starts_before_something_happens() -> None:
    elastic = np.zeros(30)
    elastic[12:] = 1.0
    empty = np.zeros(30)
    seen = Seen({}, empty, elastic, empty, np.zeros((30, 3)), empty, empty, 1.0, 1.0)
    assert window(seen, 8) == (11, 19)
    assert window(seen, 25) == (5, 30)  # as many as asked for, where there are so many
    assert window(seen, 99) == (0, 30)


@pytest.mark.parametrize(
    ("keys", "message"),
    [({"levels": (10, 20)}, "three or more"), ({"frames": 1}, "2 frames"), ({"seeds": 1}, "seeds")],
)
def test_probes_that_tell_nothing_are_refused(keys: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        Probing(**keys)


@pytest.mark.parametrize(("text", "value"), [("3%", 0.03), ("0.03", 0.03), ("2.5 %", 0.025)])
def test_a_share_is_read(text: str, value: float) -> None:
    assert read_error(text, "--error") == value


@pytest.mark.parametrize("text", ["", "3", "0%", "three", "80%", "nan", "-1%", "3%%"])
def test_what_is_no_share_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="--error must"):
        read_error(text, "--error")


def ball_shot(tmp_path: Path, **keys: Any) -> tuple[Scene, Shot]:
    """A soft ball just above the floor, and a shot of three hundredths of a second."""
    (tmp_path / "ball.ply").touch()
    shot = Shot.from_dict(
        {"splats": "ball.ply", "output": {"fps": 200, "seconds": 0.03}} | keys, tmp_path
    )
    scene = Scene()
    soft = materials.elastic.override(young_modulus=2e4)
    scene.add(
        ellipsoid((0.05, 0.05, 0.05)), soft,
        frame=Frame(torch.eye(3), torch.tensor([0.0, 0.0, 0.052]), 1.0), velocity=(0, 0, -1.0),
    )  # fmt: skip
    return scene, shot


def test_a_ball_on_the_floor_from_end_to_end(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    scene, shot = ball_shot(tmp_path)
    probing = Probing(levels=(8, 10, 14), frames=5, seeds=2, cfl=())
    result = choose(scene, shot, 0.2, probing=probing)
    assert result == choose(scene, shot, 0.2, probing=probing) | {
        "settings": result["settings"], "probe": result["probe"], "chosen": result["chosen"],
        "enough": result["enough"], "seconds_from": result["seconds_from"],
    }  # the same but for the times  # fmt: skip
    assert result["met"] and result["chosen"]["high"] <= 0.25
    # an elastic ball breaks nothing: the floor is not chance
    assert result["floor"] == 0.0
    assert {o["name"] for o in result["observables"]} == {
        "centre of mass", "extents", "momentum", "energy",
    }  # fmt: skip
    errors = [s["error"] for s in sorted(result["settings"], key=lambda s: s["cells"])]
    assert errors == sorted(errors, reverse=True)  # finer cells are never said to be worse
    assert draw_choice(result, tmp_path / "chart.png").stat().st_size > 10_000


@pytest.mark.parametrize("name", ["quality", "cells", "cfl"])
def test_two_choices_of_the_cells_are_refused(tmp_path: Path, name: str) -> None:
    value = {"quality": "preview", "cells": 24, "cfl": 0.4}[name]
    with pytest.raises(InputError, match=f"solve.error chooses .* and {name}"):
        ball_shot(tmp_path, solve={"error": "3%", name: value})


def test_a_resolved_shot_with_an_error_reads_back(tmp_path: Path) -> None:
    _, shot = ball_shot(tmp_path, solve={"error": "3%"})
    assert shot.solve.error == 0.03
    assert Shot.from_dict(shot.resolved(), tmp_path) == shot


def run_of(cells: int, steps: int, points: int, seconds: float) -> Probe:
    empty = np.zeros(1)
    seen = Seen({}, empty, empty, empty, np.zeros((1, 3)), empty, empty, 1.0, 1.0)
    return Probe(
        cells=cells, cfl=0.5, seed=0, seen=seen, seconds=seconds, points=points,
        point_steps=np.array([float(steps * points)]), steps=steps, blocks=(cells / 4) ** 3,
        fields=1, composed=0,
    )  # fmt: skip


def test_work_goes_with_the_cells() -> None:
    """Points as the cube, steps as the cells and as one over the Courant number."""
    whole = [run_of(10, 100, 1000, 1.0), run_of(20, 200, 8000, 16.0)]
    work = work_of(whole, 40, 0.25)
    assert work.points == pytest.approx(64_000)
    assert work.steps == pytest.approx(800)
    assert work.blocks == pytest.approx(1000)


def test_rates_are_those_that_the_probes_were_made_with() -> None:
    runs = [
        run_of(cells, 10 * cells, cells**3, 10 * cells * (2e-3 + 1e-7 * cells**3))
        for cells in (10, 14, 20)
    ]
    slow = run_of(20, 200, 8000, 99.0)  # disturbed: the fastest seed of a level counts
    per_step, per_point = measured_rates([*runs, slow])
    assert per_step == pytest.approx(2e-3, rel=1e-6)
    assert per_point == pytest.approx(1e-7, rel=1e-6)


def staged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fit: Fit, bound: str) -> RunContext:
    """A run about to choose, its probes replaced by one history."""
    scene, shot = ball_shot(tmp_path, solve={"error": bound})
    device = torch.device("cpu")
    record = RunRecord(tmp_path / "run.json", shot.resolved(), device, 0)
    store = StageStore(tmp_path / "stages")

    def chosen(_scene: Scene, _shot: Shot, limit: float, **_keys: Any) -> dict[str, Any]:
        found = pick([fit], ranked([fit], limit, fourth_power), limit)
        empty = Seen({}, *[np.zeros(1)] * 3, np.zeros((1, 3)), *[np.zeros(1)] * 2, 1.0, 1.0)
        one = dataclasses.replace(run_of(10, 1, 1, 1.0), seen=empty)
        probes = Probes((one, one), ((one,),), {}, 0, 1, 1.0)
        return summary(found, [fit], Growth({}, {}), probes, Probing(), "a test")

    monkeypatch.setattr(choose_shot, "load_solids", lambda _context: {})
    monkeypatch.setattr(choose_shot, "build_scene", lambda *_: scene)
    monkeypatch.setattr(choose_shot, "choose", chosen)
    return RunContext(shot, tmp_path, device, 0, store, record, LineReporter())


def test_a_run_that_chance_limits_takes_what_is_fine_enough(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    fit = fit_history(made(1.0, 0.5, noise=0.05, chaotic=True))
    context = staged(tmp_path, monkeypatch, fit, "2%")
    assert choose_shot.choose_stage(context)
    choice = context.record.values["choice"]
    assert not choice["met"] and choice["chosen"] is None
    assert context.shot.solve.cells == choice["enough"]["cells"]
    assert context.shot.solve.error is None
    assert "no setting can claim 2.0%" in caplog.text


def test_a_run_whose_error_cannot_be_met_is_refused_with_what_can(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    context = staged(tmp_path, monkeypatch, fit_history(made(0.6, 3.0)), "0.1%")
    with pytest.raises(InputError, match="cannot be met") as caught:
        choose_shot.choose_stage(context)
    least = true_error(0.6, 3.0, 1 / 128)
    assert f"least that can be promised is solve.error: {least:.1%}" in caught.value.hint
