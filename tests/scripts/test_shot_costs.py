"""What whole shots cost: the ratio and the table, from what a run says of itself."""

from __future__ import annotations

from typing import Any

import pytest
from loaded_scripts import load_script


def record(seconds: float) -> dict[str, Any]:
    stages = [("fill", 1.0), ("simulate", seconds)]
    return {
        "simulation": {"substeps": 2000, "particles": 50_000},
        "stages": [
            {"name": name, "seconds": wall, "cpu_seconds": 2 * wall, "peak_memory_bytes": 10**9}
            for name, wall in stages
        ],
    }


def test_the_overhead_is_the_stage_over_its_steps() -> None:
    shots = load_script("stages/shots")
    assert shots.overhead_ratio(record(3.0), 10.0) == pytest.approx(3.0)
    assert shots.overhead_ratio(record(3.0), 30.0) == pytest.approx(1.0)
    row = shots.row_of("ball", record(3.0), 10.0)
    assert row["peak_memory_bytes"] == 10**9 and row["peak_device_memory_bytes"] == 0
    short = row | {"shot": "short", "stages": {"simulate": row["stages"]["simulate"]}}
    table = shots.markdown([row, short], "cpu", 10.0)
    assert "| ball | 50,000 | 2,000 | 1.0 (2.0) | 3.0 (6.0) | 3.0 |" in table
    assert "| short | 50,000 | 2,000 |  | 3.0 (6.0) | 3.0 |" in table


def test_the_cost_of_a_turned_splat_has_a_row_for_every_operator() -> None:
    rows = load_script("stages/carry").table(64).splitlines()
    assert len(rows) == 6 and all(float(row.split("|")[2]) > 0.0 for row in rows[2:])
