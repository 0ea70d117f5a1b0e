"""Scripts that kill, resume and pack sweeps, at their smallest."""

from __future__ import annotations

import random
from pathlib import Path

import torch
from loaded_scripts import load_script

from gsfluent.progress import LineReporter
from gsfluent.sweep import read_sweep, run_sweep
from gsfluent.sweep.tasks import tasks_of


def test_a_kill_is_counted_and_loses_nothing() -> None:
    kills = load_script("safety/kills")
    found = kills.on_one_machine(1, False, random.Random(1))
    assert kills.count_of(found) == 1 and found["tasks"] == kills.TASKS * found["sweeps"]
    assert not any(found[bad] for bad in ("lost", "doubled", "wrong"))
    table = kills.markdown([{"where": "here", **found}])
    assert f"| here | 1 | 1 {next(w for w in kills.WHOM if found[w])} |" in table


def test_what_is_put_among_the_finished_is_found_there(tmp_path: Path) -> None:
    resume = load_script("bench/sweep/resume")
    file = resume.sweep_file(tmp_path, 5)
    assert resume.finish(file, tmp_path / "out") == 5
    said = run_sweep(
        read_sweep(file, {}, None), tmp_path / "out", device=torch.device("cpu"),
        reporter=LineReporter(),
    )  # fmt: skip
    assert said["ok"] and said["verdicts"] == {"clean": 5}


def test_packed_shots_are_those_one_after_another(tmp_path: Path) -> None:
    packing = load_script("bench/sweep/packing")
    sweeps = [
        read_sweep(packing.sweep_file(tmp_path, [0, 1], 0.1, pack, "cuda"), {}, None)
        for pack in (1, 4)
    ]
    assert [sweep.each.gpu for sweep in sweeps] == [1.0, 0.25]
    one, four = (
        [task.id for task in tasks_of(sweep, tmp_path / "out", device="cuda", seed=0)]
        for sweep in sweeps
    )
    assert one == four and len(set(one)) == 2
    spent = {
        "until_all": 1.0, "first_shot": 2.0, "later_shot": None, "after_last": 0.5,
        "busy_cores": 1.5,
    }  # fmt: skip
    row = {
        "device": "D", "cores": 2, "shots": 2, "pack": 2, "points": 1000, "seconds_of_film": 0.1,
        "one_after_another": {**spent, "wall": 8.0}, "packed": {**spent, "wall": 2.0},
        "peak_device_memory_bytes": 2e9, "same_figures": True,
    }  # fmt: skip
    assert "4.00 times as fast" in packing.markdown(row)
    rows = [
        {"device": "GPU", "cores": 32, "gpus": n, "shots": 64, "pack": 8, "wall": 100.0 / n,
         "same_figures": True, **spent}
        for n in (1, 2)
    ]  # fmt: skip
    assert "| 2 | 50.0 | 0.78 | 2.00 | 1.0 | 2.0 |  | 0.5 | 1.5 | yes |" in packing.table(rows)
