"""scripts/bench/blades.py at its smallest: a cut beside a drop, and their ratio."""

from __future__ import annotations

from loaded_scripts import load_script


def test_a_cut_is_set_against_a_drop() -> None:
    bench = load_script("bench/blades")
    cases = [*bench.DROPS, *bench.CUTS]
    rows = [bench.measured(case, "elastic", 5, 0.04) for case in cases]
    assert [row["verdict"] for row in rows] == ["clean"] * 4 and rows[0]["steps"] > 0
    rows[1]["cpu_s"], rows[2]["cpu_s"] = 2.0, 3.0
    line = next(line for line in bench.table(rows).splitlines() if "thin blade" in line)
    assert line.endswith("| 1.50 |")
