"""The ladder and its runs: what is turned, what is resumed, what a chart is drawn from."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from in_process import swept

from gsfluent.cli import main
from gsfluent.errors import InputError
from gsfluent.fracturebench.registry import find
from gsfluent.fracturebench.run import Run
from gsfluent.fracturebench.scene import Scene
from gsfluent.lab.charts import run_case as running
from gsfluent.lab.charts.carried_splats import CarriedSplats
from gsfluent.lab.charts.chart import run
from gsfluent.lab.charts.draw import gathered, of_records
from gsfluent.lab.charts.ladder import KNOBS, Setting, ladder, rungs, work
from gsfluent.lab.charts.off_grid import measure_off_grid
from gsfluent.lab.charts.record import Record, append, read
from gsfluent.lab.charts.run_case import measure, shuffled
from gsfluent.lab.frozen.answer import run_case

COARSE = max(find("pull_apart").ladder)


# --- the ladder ---


def test_ladders_over_dx_come_first_and_knobs_are_turned_one_at_a_time() -> None:
    settings = ladder(("bar", "pull_apart"), device="cpu", textbook=False)
    base = [s for s in settings if not s.variant]
    assert settings[:8] == base[:8] and len(base) == 9
    assert [s.dx for s in base if s.case == "bar"] == sorted(find("bar").ladder, reverse=True)
    turned = {s.knob for s in settings}
    assert {"dx", "cfl", "ppc", "dtype", "engine", "gaussians", "dt", "free"} <= turned
    assert {s.case for s in settings if s.knob == "fields"} == {"pull_apart"}
    for words in ("CFL 0.8", "1 per cell, CFL 0.8"):
        swept = {s.dx for s in settings if s.case == "bar" and s.variant == words}
        assert swept == set(find("bar").ladder)
    assert turned <= set(KNOBS)
    keys = [s.key("cpu") for s in settings]
    assert len(set(keys)) == len(keys)
    finer = dataclasses.replace(base[0], dx=base[0].dx / 2)
    assert work(finer) == pytest.approx(16 * work(base[0]))  # dx^-4


def test_a_gpu_goes_on_where_a_cpu_stops() -> None:
    case = find("bar")
    few, many = rungs(case, "cpu"), rungs(case, "cuda:0")
    assert many[: len(few)] == few and many[-1] <= 0.5 * few[-1]


@pytest.mark.parametrize(
    ("given", "words"), [({"names": ("nope",)}, "no case"), ({"only": ("nope",)}, "no knob")]
)
def test_unknown_words_are_refused(given: dict[str, tuple[str]], words: str) -> None:
    with pytest.raises(InputError, match=words):
        ladder(**given)


# --- one run ---


def test_a_shuffled_run_comes_back_in_the_order_of_the_scene() -> None:
    scene = find("pull_apart").build(COARSE, 8)
    seen = []

    def still(mixed: Scene) -> Run:
        seen.append(mixed)
        x = np.repeat(mixed.x[None], mixed.times.shape[0], axis=0)
        return Run(mixed.name, "m", mixed.times, x, 0.0 * x, 1.0, 1)

    done = shuffled(scene, still, 3)
    assert np.array_equal(done.x[0], scene.x) and not np.array_equal(seen[0].x, scene.x)
    assert sorted(map(tuple, seen[0].x)) == sorted(map(tuple, scene.x))


def test_carried_follow_an_affine_motion_exactly() -> None:
    case = find("bar")
    dense, sparse = case.build(1 / 8, 64), case.build(1 / 8, 8)
    turn = torch.tensor([[0.9, -0.3, 0.0], [0.3, 1.1, 0.1], [0.0, 0.0, 1.0]], dtype=torch.float64)
    flow = torch.tensor([[0.0, 2.0, 0.0], [-1.0, 0.0, 0.5], [0.0, 0.0, 0.3]], dtype=torch.float64)
    rest = torch.from_numpy(sparse.x)

    class Moved:
        position = rest @ turn.T + 0.2
        deformation = turn.expand(sparse.count, 3, 3)
        velocity = position @ flow.T
        affine = flow.expand(sparse.count, 3, 3)

    carried = CarriedSplats(dense, sparse, "cpu")
    carried.watch(Moved(), 0)  # type: ignore[arg-type]
    place = torch.from_numpy(dense.x) @ turn.T + 0.2
    assert np.allclose(carried.x[0], place.numpy(), atol=1e-12)
    assert np.allclose(carried.v[0], (place @ flow.T).numpy(), atol=1e-12)
    assert len(carried.seconds) == 1


def test_gaussians_that_ride_move_like_points_of_their_own() -> None:
    each, riding = (
        measure(Setting("bar", 1 / 8, 64, variant=v, options=o), "cpu", 1)
        for v, o in (("points", {}), ("carried", {"carried_by": 8}))
    )
    assert riding.points == each.points // 8 and riding.settings["gaussians"] == each.points
    # eight points a cell are a little softer than 64: the difference of their errors, and no more
    assert riding.error == pytest.approx(each.error, rel=0.05)


def test_fracture_is_judged_as_an_ensemble_and_no_better_than_its_band() -> None:
    case = find("shatter")
    made = measure(Setting("shatter", max(case.ladder), 1), "cpu", 1)
    errors = made.settings["errors"]
    assert len(errors) == 3 and made.error == sorted(errors)[1]
    assert made.error >= made.settings["band"] > 0.0
    (chart,) = of_records([made])
    assert chart._panels()[0].band == made.settings["band"]


def test_leaving_the_grid_is_measured_beside_staying_on_it() -> None:
    on, off = (measure_off_grid(s, "cpu", 1) for s in ladder(("flight",))[:2])
    assert (on.steps, on.variant) == (0, "") and off.steps > 0
    assert on.error < 0.1 * off.error < 0.1
    wrong = measure_off_grid(Setting("rest", -1.0), "cpu", 1)
    assert "dx must be positive" in wrong.failed and not wrong.ok
    with pytest.raises(ValueError, match="flight, rest"):
        measure_off_grid(Setting("bar", 0.1), "cpu", 1)


def test_time_is_that_of_runs_without_a_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    lengths = []

    def told(scene: Scene, **options: object) -> Run:
        lengths.append(scene.times.shape[0])
        return dataclasses.replace(run_case(scene), wall_seconds=100.0 / scene.times.shape[0])

    monkeypatch.setattr(running, "run_case", told)
    scene = find("pull_apart").build(COARSE, 8)
    made = measure(Setting("pull_apart", COARSE), "cpu", 1)
    assert lengths == [scene.times.shape[0], 1] and made.wall_seconds == [100.0]


def test_what_raises_is_a_run_that_failed(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(scene: Scene, **options: object) -> Run:
        raise RuntimeError("out of memory\nmore words")

    monkeypatch.setattr(running, "run_case", broken)
    made = measure(Setting("pull_apart", COARSE), "cpu")
    assert made.failed == "RuntimeError: out of memory" and made.error == math.inf and not made.ok


def test_a_measure_of_too_few_points_is_no_number_and_still_a_line(tmp_path: Path) -> None:
    coarse = max(find("two_material_bar").ladder)
    made = measure(Setting("two_material_bar", coarse, 1), "cpu", 1)
    assert made.ok and math.isnan(made.measures[-1]["value"])
    append(tmp_path / "a.jsonl", made)
    assert read(tmp_path / "a.jsonl")[0].error == made.error


def test_a_run_that_breaks_off_is_kept_with_its_reason() -> None:
    made = measure(Setting("bar", 1 / 8, options={"courant": 3.0}), "cpu", 1)
    assert made.failed and made.error == math.inf


# --- a file of runs ---


def fast(setting: Setting, device: str, repeat: int) -> Record:
    return Record(
        setting.case, "elastic", setting.method, setting.variant,
        {"dx": setting.dx, "knob": setting.knob}, device, "m", 8, 10, 1.0, [1e-3], 1e-3, 1.0, 0.1,
    )  # fmt: skip


def test_a_ladder_is_resumed_and_keeps_to_its_budget(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "chart.jsonl"
    settings = ladder(("bar",), only=("dx",))
    done: list[str] = []

    def counted(setting: Setting, device: str, repeat: int) -> Record:
        done.append(setting.key(device))
        return fast(setting, device, repeat)

    monkeypatch.setattr("gsfluent.lab.charts.chart.measure", counted)
    first = run(settings[:2], path, device="cpu")
    assert first.fresh == 2 and not first.left_out
    path.write_text(path.read_text()[:-30])  # the machine went down while the last was written
    second = run(settings, path, device="cpu")
    assert second.fresh == len(settings) - 1 and len(done) == len(settings) + 1
    assert {r.key for r in read(path) if r.kind != "machine"} == {s.key("cpu") for s in settings}
    none = run([dataclasses.replace(settings[0], variant="new")], path, device="cpu", budget=1e-9)
    assert none.fresh == 0 and len(none.left_out) == 1


def test_runs_that_are_placed_are_those_of_this_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = [Setting("pull_apart", COARSE), Setting("rest", -1.0)]
    here = run(settings, tmp_path / "here.jsonl", device="cpu", repeat=1).records
    calls: list[dict[str, Any]] = []
    monkeypatch.setattr("gsfluent.lab.charts.chart.map", swept(calls))
    path = tmp_path / "there.jsonl"
    there = run(settings, path, device="cpu", repeat=1, on="ray", jobs=3)
    assert there.fresh == 2 and (calls[0]["on"], calls[0]["jobs"]) == ("ray", 3)
    assert [(r.key, r.error, r.failed, r.steps) for r in there.records] == [
        (r.key, r.error, r.failed, r.steps) for r in here
    ]
    assert len(read(path)) == 3 and not path.with_suffix(".tasks").exists()
    assert run(settings, path, device="cpu", on="ray").fresh == 0
    with pytest.raises(InputError, match="one after the other"):
        run(settings, path, device="cpu", jobs=2, budget=9.0)


def test_the_machine_moves_bytes_and_a_floor_follows(tmp_path: Path) -> None:
    done = run([], tmp_path / "a.jsonl", device="cpu")
    (floor,) = done.records
    rate = floor.settings["gigabytes_per_second"]
    assert rate > 0.1 and floor.ns_per_point_step == pytest.approx(208.0 / rate)


def test_the_verb_draws_recorded_lines_of_several_files(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("matplotlib")
    peer = dataclasses.replace(fast(Setting("bar", 0.1), "cpu", 1), method="peer",
                               wall_per_simulated=0.5, error=0.2)  # fmt: skip
    broken = dataclasses.replace(peer, variant="b", error=math.inf, failed="exploded")
    free = Setting("bar", 0.1, knob="free", variant="shuffled points")
    same = dataclasses.replace(
        fast(free, "cpu", 1), settings={"dx": 0.1, "knob": "free", "trades": False}
    )
    append(tmp_path / "a.jsonl", fast(Setting("bar", 0.1), "cpu", 1))
    append(tmp_path / "a.jsonl", same)
    short = Setting("bar", 0.1, knob="cfl", variant="CFL 0.1")
    finer = dataclasses.replace(fast(short, "cpu", 1), wall_per_simulated=5e-3, error=0.11)
    append(tmp_path / "a.jsonl", finer)
    for r in (peer, broken):
        append(tmp_path / "b.jsonl", r)
    out = tmp_path / "out"
    words = ["chart", "--draw", str(tmp_path / "a.jsonl"), str(tmp_path / "b.jsonl")]
    assert main([*words, "-o", str(out), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)["chart"]
    assert said["runs"] == 5 and said["failed"] == 1 and "500" in said["verdict"]
    page = (out / "chart.html").read_text()
    assert "<svg" in page and "exploded" in page and "shuffled points" in page
    tables = (out / "chart.md").read_text()
    assert tables.count("| bar |") >= 6
    assert "| gsfluent | CFL 0.1 | 1 | 1.1 | 1.1 | 1.1 | 5 | 0 |" in tables
    assert (out / "chart.png").stat().st_size > 5000


def test_a_chart_has_one_device(tmp_path: Path) -> None:
    both = [fast(Setting("bar", 0.1), d, 1) for d in ("cpu", "cuda:0")]
    assert [c.device for c in of_records(both)] == ["cpu", "cuda"]
    with pytest.raises(InputError, match="no records"):
        gathered([])


def test_the_verb_runs_a_small_ladder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("matplotlib")
    out = tmp_path / "chart"
    words = ["chart", "--quick", "--only", "dx", "free", "--device", "cpu", "-o", str(out)]
    assert main([*words, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    records = [r for r in read(out / "chart.jsonl") if r.kind != "machine"]
    assert said["run now"] == len(records) == said["chart"]["runs"] - 1
    assert all(r.ok for r in records)
    bars = sorted((r for r in records if r.case == "bar" and not r.variant),
                  key=lambda r: -r.settings["dx"])  # fmt: skip
    assert bars[1].error < 0.7 * bars[0].error  # a finer grid is better
    assert main(["chart", "--repeat", "0", "-o", str(out)]) == 2
    capsys.readouterr()
