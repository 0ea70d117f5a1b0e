"""The page of a run: says what run.json says, and nothing that it does not."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from gsfluent.cli import main
from gsfluent.errors import InputError
from gsfluent.figure.series import Panel, curves
from gsfluent.run.report import read_run, report_page, write_report


def record(**more: Any) -> dict[str, Any]:
    return {
        "version": "0.1.0", "verdict": "clean", "reason": "every stage finished", "device": "cpu",
        "seed": 0, "stages": [
            {"name": "fill", "seconds": 1.0, "peak_memory_bytes": 500_000_000},
            {"name": "simulate", "seconds": 3.0, "peak_memory_bytes": 2_000_000_000,
             "resumed": True},
        ],
        "simulation": {
            "particles": 1234, "dx": 0.01, "momentum_bar": 1e-4,
            "per_frame": {
                "time": [0.0, 0.1, 0.2], "kinetic": [0.0, 1.0, 2.0], "elastic": [0.0, 0.5, 0.25],
                "dissipated": [0.0, 0.0, 0.5], "gravity": [3.0, 1.5, 0.25],
                "momentum": [[0.0, 0.0, 0.0], [3.0, 4.0, 0.0], [0.0, 0.0, 1.0]],
                "fragments": [1, 1, 7], "momentum_error": [0.0, None, 1e-7],
            },
            "skipped": {"free_flight_seconds": 0.125},
        },
        "outputs": {},
    } | more  # fmt: skip


def test_what_was_measured_stands_there(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    text = report_page(tmp_path, record()).render()
    assert "clean: every stage finished" in text and 'class="good"' in text
    for words in ("1 234", "75 %", "taken up from before", "free flight seconds", "0.125", "0.5"):
        assert words in text
    assert text.count("<svg") == 1 and "<video" not in text and "Plan against fact" not in text


def test_what_broke_is_drawn_and_told_where_the_run_has_kept_it(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    old = report_page(tmp_path, record()).render()
    for words in ("ever broken", "loose", "over 1 %", "blocks in use"):
        assert words not in old
    values = record()
    values["simulation"]["per_frame"] |= {
        "loose_fraction": [0.0, 0.0, 0.0123], "broken_fraction": [0.0, 0.0, 0.0456],
        "pieces": [1, 1, 11], "pieces_over_1_percent": [1, 1, 4], "active_blocks": [28, 28, 31],
    }  # fmt: skip
    text = report_page(tmp_path, values).render()
    for words in ("0.0123", "0.0456", ">11<", ">4<"):
        assert words in text
    drawn = text[text.index("<svg") :]
    for words in ("ever broken", "loose", "over 1 % of the matter", "blocks in use"):
        assert words in drawn


def test_what_grips_took_is_told(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    values = record()
    values["simulation"]["per_frame"]["grips"] = [
        {"jaw": {"force": [0.0, 0.0, f], "moment": [3.0 * f, 4.0 * f, 0.0]}}
        for f in (0.0, 7.0, 2.0)
    ]
    values["simulation"]["grips"] = [
        {"name": "jaw", "force": 7.0, "force_at": 0.1, "moment": 35.0, "moment_at": 0.1}
    ]
    text = report_page(tmp_path, values).render()
    for words in ("Grips", "Force of each grip", "jaw", ">7<", ">35<"):
        assert words in text


@pytest.mark.parametrize(("verdict", "kind"), [("healed", "warn"), ("failed", "bad")])
def test_what_went_wrong_is_coloured(verdict: str, kind: str, tmp_path: Path) -> None:
    text = report_page(tmp_path, record(verdict=verdict, simulation=None)).render()
    assert f'<p class="{kind}">{verdict}' in text and "<svg" not in text


def test_plan_stands_against_fact(tmp_path: Path) -> None:
    plan = {
        "calibrated": False,
        "predicted": {
            "particles": 1000,
            "memory_bytes": 2_000_000,
            "stages": {"fill": {"seconds": 2.0}, "texture": {"seconds": 5.0}},
        },
        "actual": {
            "particles": 1234,
            "memory_bytes": 3_000_000,
            "stages": {"fill": {"seconds": 1.0}},
        },
    }
    values = record(plan=plan, warnings=["too <thin>"])
    text = report_page(tmp_path, values).render()
    assert "1.234" in text and "fill: seconds" in text and "too &lt;thin&gt;" in text
    assert "memory [MB]" in text and ">1.5<" in text and "measures what work costs" in text
    assert "texture: seconds" not in text  # it did not run, so nothing can be said


def test_a_page_is_written_whole_and_by_the_verb(tmp_path: Path) -> None:
    (tmp_path / "run.json").write_text(json.dumps(record()))
    first = write_report(tmp_path, read_run(tmp_path)).read_bytes()
    (tmp_path / "report.html").unlink()
    assert main(["report", str(tmp_path)]) == 0
    assert (tmp_path / "report.html").read_bytes() == first
    assert sorted(p.name for p in tmp_path.iterdir()) == ["report.html", "run.json"]


@pytest.mark.parametrize("content", [None, "{", "[]", "{}"])
def test_no_record_is_named(content: str | None, tmp_path: Path) -> None:
    if content is not None:
        (tmp_path / "run.json").write_text(content)
    with pytest.raises(InputError, match=r"run\.json"):
        read_run(tmp_path)
    assert main(["report", str(tmp_path)]) == 2


def test_curves_leave_out_what_holds_no_number_and_refuse_other_lengths() -> None:
    pytest.importorskip("matplotlib")
    assert curves([0.0, 1.0], "t", [Panel("none", "m", {"a": [None, None]})]) == ""
    assert curves([0.0, 1.0], "t", [Panel("zero", "m", {"a": [0.0, 0.0]}, log=True)]) == ""
    assert "<svg" in curves([0.0, 1.0], "t", [Panel("one", "m", {"a": [None, 2.0]})])
    with pytest.raises(ValueError, match="3 values over 2"):
        curves([0.0, 1.0], "t", [Panel("long", "m", {"a": [1.0, 2.0, 3.0]})])
