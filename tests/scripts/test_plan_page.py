"""scripts/study/shots/plan.py: the table says what was recorded, each shot taught by the others."""

from __future__ import annotations

import json
from typing import Any

import pytest
from loaded_scripts import load_script

plan_accuracy = load_script("study/shots/plan")


def line(scene: str, took: float, **keys: Any) -> dict[str, Any]:
    """A shot of one stage that the probe thinks takes one second."""
    stages = {"render": {"seconds": 1.0, "memory_bytes": 10**9}}
    work = {"render": {"frames": 10.0, "gaussians": 1e5, "pixels": 1e5, "start": 1.0}}
    made = {
        "scene": scene, "machine": "Some CPU", "device": "cpu", "commit": "abc", "taught": 0,
        "probe": {"seconds": {"render": {"frames": 0.1}}, "probe_seconds": 10.0,
                  "machine": {"device": "cpu"}},
        "alone": stages, "plan": stages,
        "actual": {"render": {"seconds": took, "cpu_seconds": took, "memory_bytes": 10**9}},
        "work_planned": work, "work_actual": work,
        "counts": {name: [100.0, 110.0] for name in ("particles", "substeps", "active_blocks")},
    }  # fmt: skip
    return made | keys


def test_a_shot_is_taught_by_the_others_alone() -> None:
    lines = [line("bread_torn", 8.0), *(line("cake_cut", 2.0) for _ in range(8))]
    # eight runs that took twice the probe's second, weighed against half a run of one
    assert plan_accuracy.taught(lines[0], lines[1:])["render"].seconds == pytest.approx(
        2.0 ** (8 / 8.5)
    )
    assert plan_accuracy.taught(lines[0], [])["render"].seconds == pytest.approx(1.0)


def test_the_table_marks_what_is_above_the_bar() -> None:
    assert plan_accuracy.off(1.2, 1.0) == "+20%"
    assert plan_accuracy.off(0.7, 1.0) == "**-30%**"
    text = plan_accuracy.tables([line("bread_torn", 1.0), line("cake_cut", 4.0)])
    rows = [row for row in text.splitlines() if row.startswith("| bread_torn")]
    assert "1.0 s | +0%" in rows[0] and "-9%" in rows[0]
    assert "**-75%**" in text and "10 s" in text
    assert plan_accuracy.tables([]) == "no lines yet"


def test_the_last_line_of_a_shot_counts() -> None:
    lines = [line("bread_torn", 1.0), line("bread_torn", 3.0), line("cake_cut", 1.0, device="cuda")]
    found = plan_accuracy.latest(lines, "cpu")
    assert [one["actual"]["render"]["seconds"] for one in found] == [3.0]


def test_memory_is_fitted_stage_by_stage() -> None:
    lines = []
    for number, name in enumerate(("bread_torn", "cake_cut", "milk_poured")):
        one = json.loads(json.dumps(line(name, 1.0)))
        work = one["work_actual"]["render"]
        work |= {"gaussians": 1e5 * (1 + number), "pixels": 3e5 * (1 + number % 2)}
        size = 4e8 * work["start"] + 700.0 * work["gaussians"] + 650.0 * work["pixels"]
        one["actual"]["render"]["memory_bytes"] = size
        lines.append(one)
    found = plan_accuracy.fit_memory(lines)["cpu"]["render"]
    assert found["gaussians"] == pytest.approx(700.0, rel=0.02)
    assert found["pixels"] == pytest.approx(650.0, rel=0.02)
    assert found["worst"] < 0.01
