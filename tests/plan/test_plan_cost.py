"""The cost model: fitted from samples, stored, read again, corrected by runs."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import Any

import pytest

from gsfluent.plan import cost as plan_cost
from gsfluent.plan.cost import Cost, CostModel, law_set, machine_key, model_path, stepping
from gsfluent.plan.fit import Sample, fit


def model(**keys: Any) -> CostModel:
    made: dict[str, Any] = {
        "machine": machine_key("cpu"),
        "seconds": {
            "simulate": {"steps": 1e-4, "point_steps_nacc": 1e-7, "point_steps_elastic": 5e-8,
                         "block_steps": 1e-6, "contact_block_steps": 2e-6, "frames": 0.01,
                         "cracked_gaussians": 1e-6},
            "render": {"frames": 0.02, "frame_pixels": 1e-7},
        },
        "made": "2026-01-01T00:00:00+00:00",
    }  # fmt: skip
    return CostModel(**made | keys)


def test_the_fit_recovers_what_timings_were_made_of() -> None:
    truth = {"steps": 3e-4, "point_steps": 1.5e-7, "block_steps": 2e-6}
    sizes = itertools.product((50, 200), (1e3, 2e4, 5e4), (50, 900))
    samples = []
    for steps, points, blocks in sizes:
        features = {"steps": steps, "point_steps": steps * points, "block_steps": steps * blocks}
        seconds = sum(truth[name] * value for name, value in features.items())
        samples.append(Sample("simulate", features, seconds))
    costs, error = fit(samples, list(truth))
    assert costs == pytest.approx(truth, rel=1e-3)
    assert error < 1e-3


def test_the_fit_is_never_negative_and_takes_known_costs_off() -> None:
    falling = [Sample("x", {"a": 1.0, "b": float(n)}, 2.0 / n) for n in (1, 2, 4)]
    costs, _ = fit(falling, ["a", "b"])
    assert min(costs.values()) >= 0.0
    rest, _ = fit([Sample("x", {"a": 2.0, "b": 3.0}, 8.0)], ["b"], {"a": 1.0})
    assert rest["b"] == pytest.approx(2.0, rel=1e-3)
    with pytest.raises(ValueError, match="must take time"):
        fit([Sample("x", {"a": 1.0}, 0.0)], ["a"])


def test_a_simulation_costs_its_steps_and_its_frames() -> None:
    made = model()
    steps = made.predict(1000, 10, 100, laws={"nacc"})
    assert steps.seconds == pytest.approx(100 * (1e-4 + 1000 * 1e-7 + 10 * 1e-6))
    framed = made.predict(1000, 10, 100, laws={"nacc"}, frames=5, gaussians=1e4, brittle=True)
    assert framed.seconds - steps.seconds == pytest.approx(5 * 0.01 + 1e4 * 1e-6)
    elastic = made.predict(1000, 10, 100, laws="elastic")
    assert steps.seconds - elastic.seconds == pytest.approx(100 * 1000 * 5e-8)
    contact = made.predict(1000, 10, 100, laws={"nacc"}, fields=2)
    assert contact.seconds - steps.seconds == pytest.approx(100 * 10 * plan_cost.SHARED * 2e-6)
    assert framed.bytes > steps.bytes > 0
    with pytest.raises(ValueError, match="known: simulate, render"):
        made.stage("wash", {})


def test_laws_fall_into_the_sets_that_have_kernels() -> None:
    assert law_set({"elastic"}) == "elastic"
    assert law_set({"elastic", "nacc"}) == law_set({"nacc"}) == "nacc"
    assert law_set({"nacc", "fluid"}) == "general"
    features = stepping(10, 2, 100, fields=2, laws="nacc", composed_steps=30)
    assert features["steps"] == 70 and features["composed_point_steps"] == 300


def test_a_stored_model_comes_back_the_same(tmp_path: Path) -> None:
    made = model(ratios={"render": [1.2, 0.9]})
    made.save("cpu", tmp_path)
    assert CostModel.load("cpu", tmp_path) == made


def test_a_model_that_is_absent_damaged_or_another_machines_is_no_model(tmp_path: Path) -> None:
    assert CostModel.load("cpu", tmp_path) is None
    path = model().save("cpu", tmp_path)
    good = json.loads(path.read_text())
    for bad in (
        "{", "[]", "null", json.dumps(good | {"format": 0}), json.dumps(good | {"seconds": {}}),
        json.dumps(good | {"seconds": {"render": {"frames": -1.0}}}),
        json.dumps(good | {"ratios": {"render": [0.0]}}), json.dumps(good | {"seconds": 3}),
    ):  # fmt: skip
        path.write_text(bad)
        assert CostModel.load("cpu", tmp_path) is None, bad
    path.write_bytes(b"\xff\xfe\x00")
    assert CostModel.load("cpu", tmp_path) is None
    for key in ("processor", "threads", "build", "version"):
        path.write_text(json.dumps(good | {"machine": good["machine"] | {key: "other"}}))
        assert CostModel.load("cpu", tmp_path) is None, key


def test_where_it_is_stored(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert model_path("cpu").parent == tmp_path / "cache" / "gsfluent"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert model_path("cpu").parent == tmp_path / "home" / ".cache" / "gsfluent"


def test_runs_correct_the_model_and_a_busy_one_cannot_spoil_it() -> None:
    made = model()
    features = {"frames": 10.0}
    said = made.stage("render", features)
    assert said.seconds == pytest.approx(0.2)
    for _ in range(plan_cost.REMEMBERED + 3):  # this machine really takes half as long again
        made.learn("render", made.stage("render", features, corrected=False), Cost(0.3, said.bytes))
    assert len(made.ratios["render"]) == plan_cost.REMEMBERED
    assert made.stage("render", features).seconds == pytest.approx(0.3, rel=0.03)
    assert made.stage("render", features).bytes == pytest.approx(said.bytes, rel=1e-6)
    assert made.stage("render", features, corrected=False).seconds == pytest.approx(0.2)
    for _ in range(plan_cost.REMEMBERED):
        made.learn("render", said, Cost(2000.0, said.bytes))
    assert made.correction("render") == plan_cost.CORRECTION[1]


def test_one_run_is_believed_by_two_thirds() -> None:
    made = model()
    made.learn("render", Cost(1.0, 1), Cost(8.0, 1))
    assert made.correction("render") == pytest.approx(8.0 ** (2 / 3))
    made.learn("render", Cost(1.0, 1), Cost(0.0, 1))  # a stage that was found finished
    assert len(made.ratios["render"]) == 1


@pytest.mark.parametrize(
    ("points", "born", "took"),
    [
        (22_094, 57_450, 513),  # demo
        (435_131, 178_300, 2378),  # bread_torn
        (733_556, 1_155_000, 4809),  # watermelon_dropped
        (1_480_545, 2_408_000, 8538),  # melons_collided
        (1_804_161, 0, 5519),  # milk_poured
    ],
)
def test_memory_of_simulations_that_an_h200_ran(points: int, born: int, took: int) -> None:
    features = {"start": 1.0, "points": float(points), "born": float(born)}
    said = plan_cost.memory_of("simulate", features, "cuda") / 2**20
    assert said == pytest.approx(took, rel=0.25)
