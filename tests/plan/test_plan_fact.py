"""A plan beside what came of it: bookkeeping, what a run stores, what a model learns."""

from __future__ import annotations

import copy
import json
import math
import os
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from simulation_shapes import ellipsoid

from gsfluent.config import Shot
from gsfluent.errors import InputError
from gsfluent.hardware import Load
from gsfluent.io.splats.load import save_splats
from gsfluent.plan import probe as plan_probe
from gsfluent.plan import quick
from gsfluent.plan.cost import CostModel, machine_key
from gsfluent.plan.fact import actual_work, compare, learn, seconds_left
from gsfluent.plan.plan import cost_model, plan_shot
from gsfluent.run.shot import run_shot


def model() -> CostModel:
    """Made-up costs of every stage, large enough to matter."""
    return CostModel(
        machine=machine_key("cpu"),
        seconds={
            "reconstruct": {"steps": 1e-3},
            "isolate": {"splats": 1e-6},
            "fill": {"voxels": 1e-6, "inner": 1e-6},
            "texture": {"exemplar_objects": 1.0, "procedural_objects": 1.0},
            "simulate": {"steps": 1e-4, "point_steps_elastic": 1e-7, "point_steps_nacc": 1e-7,
                         "point_steps_general": 1e-7, "block_steps": 1e-7, "frames": 1e-2},
            "render": {"frames": 1e-2, "frame_pixels": 1e-8},
            "export": {"ply-seq_gaussians": 1e-6},
        },
        made="2026-01-01T00:00:00+00:00",
    )  # fmt: skip


@pytest.fixture(scope="module")
def shot(tmp_path_factory: pytest.TempPathFactory) -> Shot:
    folder = tmp_path_factory.mktemp("shot")
    save_splats(ellipsoid((0.1, 0.1, 0.1), splats=1500).gaussians, folder / "ball.ply")
    return Shot.from_dict(
        {
            "splats": str(folder / "ball.ply"),
            "scale": 1.0,
            "up": "+z",
            "fill": {"resolution": 24},
            "objects": {"ball": {"material": "rubber"}},
            "events": [{"type": "drop", "height": 0.02}],
            "solve": {"quality": "preview", "cells": 10},
            "output": {"fps": 30, "seconds": 0.2, "size": [64, 48]},
        }
    )


@pytest.fixture
def ran(shot: Shot, unplanned: dict[str, Any]) -> dict[str, Any]:
    """What a run without a plan says, to be changed at will."""
    return copy.deepcopy(unplanned)


@pytest.fixture(scope="module")
def unplanned(shot: Shot, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    return run_shot(shot, tmp_path_factory.mktemp("ran") / "out", plan=False)


@pytest.fixture
def stored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache with the made-up model in it, on a machine where nobody else is at work."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(Load, "crowded_since", lambda self, now=None: False)
    model().save("cpu")
    return tmp_path


def test_a_plan_has_every_stage_and_their_sum(shot: Shot) -> None:
    plan = plan_shot(shot, model=model())
    assert list(plan["stages"]) == ["isolate", "fill", "texture", "simulate", "render"]
    assert plan["seconds"] == pytest.approx(sum(s["seconds"] for s in plan["stages"].values()))
    assert plan["memory_bytes"] == max(s["memory_bytes"] for s in plan["stages"].values())
    assert plan["simulate_seconds"] == plan["stages"]["simulate"]["seconds"] > 0.0
    assert plan["cells"] == 10 and plan["calibrated"]
    blank = plan_shot(shot)
    assert not blank["calibrated"] and blank["seconds"] is None
    assert blank["particles"] == plan["particles"] and blank["memory_bytes"] > 1e8
    json.dumps(plan)


def test_a_run_says_what_was_planned_and_learns(shot: Shot, stored: Path) -> None:
    values = run_shot(shot, stored / "out")
    section = values["plan"]
    assert section["calibrated"]
    predicted, actual, ratio = (section[name] for name in ("predicted", "actual", "ratio"))
    assert actual["particles"] == values["simulation"]["particles"]
    assert actual["substeps"] == values["simulation"]["substeps"]
    assert predicted["particles"] == pytest.approx(actual["particles"], rel=0.25)
    assert predicted["substeps"] == pytest.approx(actual["substeps"], rel=0.25)
    assert ratio["seconds"] == pytest.approx(actual["seconds"] / predicted["seconds"])
    stages = {s["name"]: s for s in values["stages"]}
    for name, row in actual["stages"].items():
        assert row["seconds"] == stages[name]["seconds"]
        assert row["memory_bytes"] == stages[name]["peak_memory_bytes"]
    assert actual["seconds"] == pytest.approx(sum(r["seconds"] for r in actual["stages"].values()))
    taught = CostModel.load("cpu")
    assert taught is not None and set(taught.ratios) == set(actual["stages"])
    # every stage of the same work is planned closer to what it took, where it was off at all: one
    # that was right by chance may be off by a quarter now, for others were at work on the machine
    before, again = (plan_shot(shot, model=m)["stages"] for m in (model(), taught))
    for name, row in actual["stages"].items():
        off, less = (abs(math.log(p[name]["seconds"] / row["seconds"])) for p in (before, again))
        assert less < max(off, 0.25), name
    # nothing was done, so nothing is compared or learned
    repeated = run_shot(shot, stored / "out")["plan"]
    assert repeated["actual"]["stages"] == {} and repeated["actual"]["seconds"] is None
    after = CostModel.load("cpu")
    assert after is not None and after.ratios == taught.ratios


def test_a_first_run_looks_at_the_machine_and_never_probes_it(
    shot: Shot,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))

    def never(*_: Any) -> CostModel:
        raise AssertionError("a run must not probe the machine")

    monkeypatch.setattr(plan_probe, "calibrate", never)
    caplog.set_level("INFO", "gsfluent")
    section = run_shot(shot, tmp_path / "out")["plan"]
    assert "this machine is new" in caplog.text and "plan: about " in caplog.text
    assert section["calibrated"] and section["actual"]["seconds"] > 0.0
    assert all(row["seconds"] > 0.0 for row in section["predicted"]["stages"].values())
    # the model is kept, and the run has taught it; the probe is still to come
    taught = CostModel.load("cpu")
    assert taught is not None and not taught.measured and taught.memory_ratios
    plan = plan_shot(shot, model=taught)
    assert plan["calibrated"] and plan["model"]["measured"] == "at a glance"
    with pytest.raises(AssertionError, match="must not probe"):
        cost_model("cpu")  # who asks for the probe gets it
    caplog.clear()
    run_shot(shot, tmp_path / "again")
    assert "this machine is new" not in caplog.text


def test_a_run_where_nothing_can_be_had_in_a_second_teaches(
    shot: Shot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(quick, "quick_model", lambda device: None)  # no reference
    section = run_shot(shot, tmp_path / "out")["plan"]
    assert section["calibrated"] is False
    assert section["predicted"]["seconds"] is None and section["actual"]["seconds"] > 0.0
    assert section["predicted"]["substeps"] > 0
    # the run has taught what it did: the next plan has times, and those that it took
    taught = CostModel.load("cpu")
    assert taught is not None and not taught.measured and not taught.ratios
    plan = plan_shot(shot, model=taught)
    assert plan["calibrated"] and plan["model"]["measured"] == "by finished runs"
    for name, took in section["actual"]["stages"].items():
        assert 0.2 < plan["stages"][name]["seconds"] / took["seconds"] < 5.0


@pytest.mark.parametrize("device", sorted(quick.REFERENCE))
def test_costs_of_the_reference_go_at_the_pace_of_this_machine(
    device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    known = json.loads(quick.REFERENCE[device].read_text(encoding="utf-8"))
    assert set(known["seconds"]) == set(quick.STAGE_PIECES)
    pace = {"solve": 2.0, "draw": 3.0, "arrays": 5.0}
    here = {name: factor * known["pieces"][name] for name, factor in pace.items()}
    monkeypatch.setattr(quick, "pieces", lambda device: here)
    monkeypatch.setattr("torch.cuda.get_device_name", lambda device: "another GPU")
    made = quick.quick_model(device)
    assert made is not None and not made.measured
    for stage, piece in quick.STAGE_PIECES.items():
        for feature, cost in known["seconds"][stage].items():
            wanted = cost * pace["arrays" if feature == "start" else piece]
            assert made.seconds[stage][feature] == pytest.approx(wanted)
    assert quick.quick_model("meta") is None


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
def test_a_look_takes_every_piece(device: str) -> None:
    found = quick.pieces(device)
    assert set(found) == set(quick.STAGE_PIECES.values())
    assert all(seconds > 0.0 for seconds in found.values())


def test_a_crowded_machine_teaches_nothing_slow(
    shot: Shot, tmp_path: Path, ran: dict[str, Any]
) -> None:
    stored, values = tmp_path, ran
    plan = plan_shot(shot, model=model())
    for stage in values["stages"]:
        stage["seconds"] = 1e3
    taught = learn(model(), plan, values, "cpu", stored, crowded=True)
    assert taught.ratios == {} and set(taught.memory_ratios) == set(plan["stages"])
    for stage in values["stages"]:
        stage["seconds"] = 1e-9
    taught = learn(model(), plan, values, "cpu", stored, crowded=True)
    assert set(taught.ratios) == set(plan["stages"])  # what is quick all the same counts
    # others that leave fewer processors than this process has threads
    then, cores = Load(0.0, 100.0, 5.0), os.cpu_count() or 1
    assert not then.crowded_since(Load(10.0, 100.0 + 10.0, 5.0 + 10.0))
    assert then.crowded_since(Load(10.0, 100.0 + 10.0 * cores, 5.0))
    assert not Load(0.0, None, 5.0).crowded_since(Load(10.0, None, 5.0))
    now = Load.now()
    assert now.own > 0.0 and (now.busy is None or now.busy > 0.0)


def test_a_stage_that_no_run_has_had_has_no_time(shot: Shot, stored: Path) -> None:
    known = model()
    known.made = ""
    del known.seconds["texture"]
    plan = plan_shot(shot, model=known)
    assert plan["stages"]["texture"]["seconds"] is None and plan["seconds"] is None
    assert plan["simulate_seconds"] > 0.0


def test_a_damaged_calibration_is_measured_anew(
    stored: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = []

    def measured(*_: Any) -> CostModel:
        calls.append(1)
        return model()

    monkeypatch.setattr(plan_probe, "calibrate", measured)
    assert cost_model("cpu") == model() and not calls
    next(stored.rglob("cost_*.json")).write_text("{")
    assert cost_model("cpu") == model() and len(calls) == 1
    assert CostModel.load("cpu") == model()
    cost_model("cpu", recalibrate=True)
    assert len(calls) == 2


def test_a_time_budget_becomes_cells_and_stays(shot: Shot, stored: Path) -> None:
    def budget(seconds: float) -> Shot:
        values = shot.resolved()
        return Shot.from_dict(values | {"solve": {"seconds_per_frame": seconds}})

    free, tight = (plan_shot(budget(s), model=model()) for s in (1.0, 0.1))
    assert tight["cells"] < free["cells"]
    for plan, seconds in ((free, 1.0), (tight, 0.1)):
        assert plan["simulate_seconds"] / plan["frames"] <= seconds * 1.001
        assert "time budget" in [row["bound"] for row in plan["bounds"]]
        assert plan["budget"]["seconds_per_frame"] == seconds
        assert plan["budget"]["dx_by_formula"] == pytest.approx(plan["dx"], rel=0.8)
    with pytest.raises(InputError, match="seconds_per_frame 1e-05"):
        plan_shot(budget(1e-5), model=model())
    values = run_shot(budget(0.1), stored / "out")
    chosen = values["plan"]["chosen"]
    assert chosen["cells"] == tight["cells"]
    assert values["simulation"]["dx"] == pytest.approx(chosen["dx"], rel=0.15)
    # a model that has learned otherwise does not change a run that has begun
    quick = CostModel.load("cpu")
    assert quick is not None
    quick.ratios["simulate"] = [4.0] * 8
    quick.save("cpu")
    again = run_shot(budget(0.1), stored / "out")
    assert again["plan"]["chosen"]["cells"] == chosen["cells"]
    assert all(stage["resumed"] for stage in again["stages"])


def test_work_that_was_foreseen_wrongly_is_not_the_models_fault(
    shot: Shot, stored: Path, ran: dict[str, Any]
) -> None:
    plan, values = plan_shot(shot, model=model()), ran
    assert "plan" not in values
    work = actual_work(plan["work"], values)
    assert work["simulate"]["steps"] == values["simulation"]["substeps"]
    made, stages = model(), {s["name"]: s for s in values["stages"]}
    exact = made.stage("simulate", work["simulate"], corrected=False).seconds
    made = learn(made, plan, values, "cpu", stored)
    assert made == CostModel.load("cpu", stored)
    assert made.ratios["simulate"][0] == pytest.approx(stages["simulate"]["seconds"] / exact)
    section = compare(plan, values)
    planned = plan["stages"]["simulate"]["seconds"]
    assert section["ratio"]["stages"]["simulate"]["seconds"] == pytest.approx(
        stages["simulate"]["seconds"] / planned
    )


PLANNED = {"fill": 10.0, "simulate": 100.0, "render": 20.0}


def test_time_left_is_the_plan_at_the_pace_of_the_run() -> None:
    assert seconds_left(PLANNED, {}, "fill", 0.0, 0.0) == pytest.approx(130.0)
    # what took twice its time makes more be expected of all that follows, a short stage by less
    slow = seconds_left(PLANNED, {"fill": 20.0}, "simulate", 0.0, 0.0)
    assert slow is not None and 150.0 < slow < 240.0
    late = seconds_left(PLANNED, {"fill": 20.0, "simulate": 200.0}, "render", 0.0, 0.0)
    assert late is not None and 35.0 < late < 40.0
    # on plan, half of the work is half of the time
    assert seconds_left(PLANNED, {"fill": 10.0}, "simulate", 50.0, 0.5) == pytest.approx(70.0)
    # a stage that is late is never said to be over
    late = seconds_left(PLANNED, {"fill": 10.0}, "simulate", 400.0, 0.8)
    assert late is not None and 60.0 < late < 300.0
    over = seconds_left(PLANNED, {"fill": 10.0}, "render", 300.0, 0.0)
    assert over is not None and over > 0.0
    # at its end its own pace counts alone
    end = seconds_left(PLANNED, {"fill": 10.0, "simulate": 100.0}, "render", 99.0, 0.99)
    assert end == pytest.approx(1.0, rel=0.1)
    # nothing is said where the plan knows nothing, and found stages teach nothing
    assert seconds_left({**PLANNED, "render": None}, {}, "fill", 1.0, 0.0) is None
    assert seconds_left(PLANNED, {}, "simulate", 0.0, 0.0) == pytest.approx(120.0)


@given(
    st.floats(0.1, 1e4), st.floats(0.0, 1e4), st.floats(0.0, 1.0), st.sampled_from(list(PLANNED))
)
def test_time_left_is_a_time(took: float, elapsed: float, share: float, current: str) -> None:
    left = seconds_left(PLANNED, {"fill": took}, current, elapsed, share)
    assert left is not None and math.isfinite(left) and left >= 0.0
