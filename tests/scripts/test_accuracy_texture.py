"""scripts/accuracy/texture/known.py runs at a tiny size, keeps its lines, enters its tables."""

from __future__ import annotations

import json
from pathlib import Path
from types import ModuleType

import pytest
from loaded_scripts import load_script


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> ModuleType:
    found = load_script("accuracy/texture/known")
    monkeypatch.setattr(found, "LINES", tmp_path / "data" / "lines.jsonl")
    monkeypatch.setattr(found, "PAGE", tmp_path / "page.md")
    found.PAGE.write_text("# Title\n")
    return found


def test_lines_tables_and_sheet(script: ModuleType, tmp_path: Path) -> None:
    run = ["--size", "32", "--only", "marble", "--draws", "1", "--write"]
    assert script.main([*run, "--methods", "color_copy", "procedural"]) == 0
    assert script.main([*run, "--methods", "color_copy"]) == 0
    lines = [json.loads(line) for line in script.LINES.read_text().splitlines()]
    # the second run of a method replaces the first
    assert [line["method"] for line in lines] == ["color_copy", "procedural"]
    for line in lines:
        assert line["crossing"] == 0.0
        assert line["figures"]["ratio"]["patch"] > 0
    text = script.PAGE.read_text()
    assert text.startswith("# Title") and text.count("<!-- texture 32 cpu: begin -->") == 1
    assert "| color_copy |" in text and "another draw (floor)" in text


def test_sheet_is_a_small_picture(script: ModuleType, tmp_path: Path) -> None:
    from PIL import Image

    known = script.known_interior("cake", 32, 0)
    judge = script.Judge(known, [script.known_interior("cake", 32, 1)])
    script.draw_sheet(tmp_path / "sheet.jpg", judge, {"color_copy": known.domain.skin})
    with Image.open(tmp_path / "sheet.jpg") as sheet:
        assert sheet.size == (3 * 128, 5 * 128 + 18)
    assert (tmp_path / "sheet.jpg").stat().st_size < 300_000
