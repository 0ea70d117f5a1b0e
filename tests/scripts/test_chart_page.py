"""scripts/pictures/chart.py enters what was recorded; the page names what there is."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from types import ModuleType

import pytest
from loaded_scripts import load_script

from gsfluent.lab.charts.ladder import CASES, KNOBS, OFF_GRID
from gsfluent.lab.charts.record import Record, append

ROOT = Path(__file__).parents[2]


@pytest.fixture
def script() -> ModuleType:
    return load_script("pictures/chart")


def record(method: str, time: float, error: float) -> Record:
    return Record(
        "bar", "elastic", method, "", {"dx": 0.1}, "cpu", "Some CPU, 2 of 2 cores", 10, 20, 1.0,
        [time], time, 5.0, error,
    )  # fmt: skip


def test_recorded_lines_become_a_figure_and_tables(
    script: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "chart.md"
    page.write_text("# Title\n")
    words = ["--data", str(tmp_path), "--images", str(tmp_path), "--markdown", str(page)]
    assert script.main([*words, "--device", "cpu"]) == 2  # nothing was recorded
    append(tmp_path / "chart_cpu.jsonl", record("gsfluent", 1.0, 0.01))
    append(tmp_path / "peers_cpu.jsonl", record("somebody", 250.0, 0.02))
    assert script.main(words) == 0
    text = page.read_text()
    assert "## Two cores" in text and "images/chart_cpu.png" in text and "Some CPU" in text
    assert "| bar | somebody | 1 | 0.02 | 0.01 | 250 | 250 | 250 | 0 |" in text
    assert (tmp_path / "chart_cpu.png").stat().st_size <= script.MOST_BYTES
    slower = dataclasses.replace(record("gsfluent", 500.0, 0.01), date="later")
    append(tmp_path / "chart_cpu.jsonl", slower)
    assert script.main(words) == 0
    text = page.read_text()
    assert text.count("## Two cores") == 1 and "not at: bar, somebody at 0.02: 0.5 times" in text
    capsys.readouterr()


def test_the_page_names_what_there_is() -> None:
    text = (ROOT / "docs" / "measured" / "chart.md").read_text(encoding="utf-8")
    tests = "".join(
        (ROOT / "tests" / "lab" / "charts" / name).read_text(encoding="utf-8")
        for name in ("test_trades_nothing.py", "test_trades_nothing_cuda.py")
    )
    named = set(re.findall(r"`(test_\w+)`", text))
    defined = set(re.findall(r"^def (test_\w+)", tests, re.MULTILINE))
    assert named <= defined and len(named) >= 14
    cases = text[text.index("## The cases") : text.index("## The knobs")]
    assert all(re.search(rf"\b{name}\b", cases) for name in (*CASES, *OFF_GRID))
    knobs = text[text.index("## The knobs") : text.index("## What trades nothing")]
    assert all(re.search(rf"\b{name}\b", knobs) for name in KNOBS)
