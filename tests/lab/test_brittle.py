"""What kills brittle MPM: the experiments of docs/measured/brittle_gpu.md, in small."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from loaded_scripts import load_script

from gsfluent.lab.problems.fracture import brittle
from gsfluent.lab.textbook.solver import Textbook, Variant

ROOT = Path(__file__).resolve().parents[2]
SINGLE, DOUBLE = torch.float32, torch.float64


def test_the_chance_to_lie_half_way_is_that_of_the_precision() -> None:
    """Users.md 0.3: 1.3e-5 of random float32 positions per axis (at 128 dx and more)."""
    random = np.random.default_rng(5)
    x = 32.0 + 32.0 * random.random(20_000_000, dtype=np.float64)
    hits = int((x.astype(np.float32) % 1.0 == 0.5).sum())
    one = brittle.debris(1, away=32.0)
    assert one.count == 1
    assert hits / x.size == pytest.approx(brittle.hit_rate(one, SINGLE) / 3.0, rel=0.4)
    assert brittle.hit_rate(one, DOUBLE) < 1e-8 * brittle.hit_rate(one, SINGLE)


def test_debris_dies_by_an_unguarded_division_at_the_rate_of_rounding() -> None:
    waited, rates = [], []
    for seed in range(6):
        scene = brittle.debris(10, away=100.0, seed=seed)
        run = brittle.run(scene, Variant(guarded=False), steps=400, dt=1e-3)
        assert run.birth is not None
        assert run.birth.stage == "g2p" and run.birth.alone and run.birth.massless
        waited.append(run.steps)
        rates.append(brittle.hit_rate(scene, SINGLE))
    expected = 1.0 / np.mean(rates)
    assert 0.25 * expected < np.mean(waited) < 3.0 * expected  # six waiting times
    scene = brittle.debris(10, away=100.0)
    for variant, dtype in ((Variant(), SINGLE), (Variant(guarded=False), DOUBLE)):
        assert brittle.run(scene, variant, steps=100, dt=1e-3, dtype=dtype).birth is None


def test_debris_is_exposed_on_every_axis_and_a_point_in_a_crowd_on_none() -> None:
    scene = brittle.debris(3)
    rate = brittle.exposure(Textbook(scene, Variant()))
    assert rate == pytest.approx(brittle.hit_rate(scene, SINGLE), rel=1e-6)
    ball = Textbook(brittle.drop(0.1), Variant())
    everything = brittle.hit_rate(brittle.drop(0.1), SINGLE)
    assert 0.0 < brittle.exposure(ball) < 0.3 * everything  # its surface alone


def test_damage_depends_on_the_step_least_with_the_implicit_dynamic_centre() -> None:
    """Share of broken points at dt and dt/2."""
    change = {}
    for kind in ("fixed_explicit", "dynamic_explicit", "dynamic_implicit"):
        scene = brittle.drop(0.08)
        share = [
            brittle.run(
                scene, Variant(storage="strain", return_map=kind), steps=80 * part,
                dt=brittle.step(scene) / part, dtype=DOUBLE,
            ).broken
            for part in (1, 2)
        ]  # fmt: skip
        change[kind] = abs(share[1] - share[0])
    assert change["dynamic_implicit"] < 0.03
    assert min(change["fixed_explicit"], change["dynamic_explicit"]) > 0.06


def test_the_script_goes_on_where_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    script = load_script("study/brittle/run")
    record = tmp_path / "brittle.jsonl"
    line = [
        "run.py", "-o", str(record), "--quick", "--parts", "inversion", "--markdown",
        str(tmp_path / "page.md"), "--figure", str(tmp_path / "page.png"),
    ]  # fmt: skip
    monkeypatch.setattr(sys, "argv", line)
    assert script.main() == 0
    first = record.read_text()
    found = [json.loads(each) for each in first.splitlines()]
    assert len(found) == 8
    dead = [r for r in found if r["birth"]]
    assert dead and all(r["variant"]["storage"] == "F" and not r["variant"]["clamp"] for r in dead)
    assert {r["birth"]["stage"] for r in dead} == {"return map"}
    assert script.main() == 0
    assert record.read_text() == first
    page = (tmp_path / "page.md").read_text()
    assert page.count("<!-- brittle factors: begin -->") == 1 and "return map, step" in page
    assert (tmp_path / "page.png").stat().st_size > 1000
    assert "fast impact" in capsys.readouterr().out
