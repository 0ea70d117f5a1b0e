"""scripts/accuracy/battery.py: resumes, keeps the rest of its page, says what failed."""

from __future__ import annotations

import json
from pathlib import Path
from types import ModuleType

import pytest
from loaded_scripts import load_script

from gsfluent.lab.world import registry
from gsfluent.lab.world.registry import Problem, Result


@pytest.fixture
def battery(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.setattr(registry, "_PROBLEMS", {})
    monkeypatch.setattr(registry, "discover", lambda: None)
    return load_script("accuracy/battery")


def add(name: str, error: float, calls: list[str], tier: str = "fast") -> None:
    def compute() -> Result:
        calls.append(name)
        if error < 0:
            raise RuntimeError("it | broke")
        return Result(name, "figure", 1.0 + error, 1.0, error, 0.1, "m", "a book")

    registry._PROBLEMS[name] = Problem(name, tier, compute, "what it is")  # type: ignore[arg-type]


def test_a_second_run_computes_only_what_is_missing(battery: ModuleType, tmp_path: Path) -> None:
    figures, page = tmp_path / "b.json", tmp_path / "accuracy.md"
    page.write_text("# Title\n\n<!-- cpu: begin -->\nops\n<!-- cpu: end -->\n")
    calls: list[str] = []
    add("fall", 0.01, calls)
    given = ["--json", str(figures), "--markdown", str(page)]
    assert battery.main(given) == 0 and calls == ["fall"]
    add("rise", 0.02, calls, tier="slow")
    assert battery.main([*given, "--tier", "fast"]) == 0 and calls == ["fall"]
    assert battery.main(given) == 0 and calls == ["fall", "rise"]
    assert battery.main([*given, "--only", "fal", "--fresh"]) == 0 and calls[-1] == "fall"
    text = page.read_text()
    assert text.startswith("# Title") and "\nops\n" in text
    assert text.count("<!-- battery: begin -->") == 1 and text.count("| a book |") == 2
    assert set(json.loads(figures.read_text())["problems"]) == {"fall", "rise"}


def test_a_miss_and_a_failure_are_rows_and_an_exit_code(
    battery: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    calls: list[str] = []
    figures = tmp_path / "b.json"
    add("fall", 0.2, calls)
    assert battery.main(["--json", str(figures)]) == 1
    assert "**MISS**" in capsys.readouterr().out
    registry._PROBLEMS.clear()
    add("drop", -1.0, calls)
    assert battery.main(["--json", str(figures)]) == 1
    out = capsys.readouterr().out
    assert "**did not run**: RuntimeError: it \\| broke" in out and "**MISS**" in out
    assert battery.main(["--json", str(figures)]) == 1 and calls.count("drop") == 2  # tried again


def test_the_accuracy_script_keeps_the_battery(tmp_path: Path, battery: ModuleType) -> None:
    accuracy = load_script("accuracy/ops")
    page = battery.enter("# Accuracy\n", "battery", "table of problems", battery.HEADING)
    assert "table of problems" in accuracy.enter(page, "cpu", "table of ops")
    both = battery.enter(accuracy.enter(page, "cpu", "table of ops"), "battery", "new table")
    assert "table of ops" in both and "table of problems" not in both and "new table" in both


def test_only_a_miss_that_the_page_has_already_is_no_news(
    battery: ModuleType, tmp_path: Path
) -> None:
    add("fall", 0.2, [])
    page = tmp_path / "accuracy.md"
    assert battery.main(["--markdown", str(page)]) == 1
    assert battery.main(["--known", str(page)]) == 0
    page.write_text(page.read_text().replace("| figure |", "| another |"))
    assert battery.main(["--known", str(page)]) == 1
