"""Records: a line per run, read back as written, whatever happened to the end of the file."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest

from gsfluent.errors import InputError
from gsfluent.fracturebench.registry import find
from gsfluent.fracturebench.run import Run
from gsfluent.fracturebench.scene import Scene
from gsfluent.lab.charts.record import Record, append, of_run, read


def record(case: str = "bar", dx: float = 0.1, variant: str = "", error: float = 0.02) -> Record:
    return Record(
        case, "elastic", "gsfluent", variant, {"dx": dx}, "cpu", "m", 10, 20, 0.5,
        [0.2, 0.3, 0.1], 0.4, 1e6, error,
    )  # fmt: skip


def flown(scene: Scene, error: float = 0.0, wall: float = 1.0, failed: str = "") -> Run:
    """Free flight of the two blocks of pull_apart, slower than exact by a share."""
    v = np.repeat((1.0 - error) * scene.v[None], scene.times.shape[0], axis=0)
    x = scene.x + scene.times[:, None, None] * v
    return Run(scene.name, "model", scene.times, x, v, wall, 100, {"dt": 1e-3}, "cpu", failed)


def test_a_record_is_read_back_as_it_was_written(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "chart.jsonl"
    lines = [record(), record(dx=0.05), record(variant="cfl=0.1", error=math.inf)]
    for line in lines:
        append(path, line)
    assert read(path) == [dataclasses.replace(r, measures=[]) for r in lines]
    assert not read(path)[2].ok and read(path)[0].ok
    assert "Infinity" not in path.read_text() and "NaN" not in path.read_text()


def test_a_line_that_was_cut_off_is_left_out_and_removed_by_the_next(tmp_path: Path) -> None:
    path = tmp_path / "chart.jsonl"
    append(path, record())
    whole = path.read_text()
    path.write_text(whole + record(dx=0.05).line()[:-20])
    assert [r.settings["dx"] for r in read(path)] == [0.1]
    append(path, record(dx=0.025))
    assert [r.settings["dx"] for r in read(path)] == [0.1, 0.025]


def test_a_line_that_is_no_record_is_named(tmp_path: Path) -> None:
    path = tmp_path / "chart.jsonl"
    path.write_text(record().line() + '{"case": "bar"}\n')
    with pytest.raises(InputError, match="line 2"):
        read(path)
    with pytest.raises(InputError, match="cannot be read"):
        read(tmp_path / "missing.jsonl")


def test_the_last_of_equal_runs_counts(tmp_path: Path) -> None:
    path = tmp_path / "chart.jsonl"
    for error in (0.5, 0.25):
        append(path, record(error=error))
    assert [r.error for r in read(path)] == [0.25]


def test_repeats_give_median_time_and_median_error() -> None:
    case = find("pull_apart")
    scene = case.build(case.ladder[0], 1)
    runs = [flown(scene, error, wall) for error, wall in ((0.3, 5.0), (0.1, 1.0), (0.2, 2.0))]
    made = of_run(case, scene, runs, variant="shuffled", machine="m", commit="c")
    assert made.error == pytest.approx(0.2)
    assert made.settings["errors"] == pytest.approx([0.3, 0.1, 0.2])
    assert made.wall_per_simulated == pytest.approx(2.0 / scene.seconds)
    assert made.ns_per_point_step == pytest.approx(2e9 / (100 * scene.count))
    assert made.settings["ppc"] == pytest.approx(1.0) and made.settings["dt"] == 1e-3
    assert made.ok and made.key == f"pull_apart|model|shuffled|{scene.dx:.5g}|cpu"


def test_one_repeat_that_broke_off_fails_the_run() -> None:
    case = find("pull_apart")
    scene = case.build(case.ladder[0], 1)
    made = of_run(case, scene, [flown(scene), flown(scene, failed="left the grid")])
    assert made.failed == "left the grid" and made.error == math.inf and not made.ok
    assert json.loads(made.line())["error"] is None
    with pytest.raises(ValueError, match="at least one"):
        of_run(case, scene, [])
