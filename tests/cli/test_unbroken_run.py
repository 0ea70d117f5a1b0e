"""A run in which nothing breaks on walls too thin: every place where a user looks says so."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest
import torch
from ball_shot import write_shot

from gsfluent.cli import main
from gsfluent.errors import RunError
from gsfluent.io import load_splats, save_splats


@pytest.fixture
def hard(ball: Path, tmp_path: Path) -> Path:
    """A shot of a brittle lens that is too strong for its fall, 0.36 m thick on cells of 0.25 m."""
    whole = load_splats(ball)
    flat = whole.replace(means=whole.means * torch.tensor([1.0, 1.0, 0.4]))
    save_splats(flat, tmp_path / "lens.ply")
    return write_shot(
        tmp_path / "shot.yaml",
        tmp_path / "lens.ply",
        objects={
            "ball": {
                "material": "bread",
                "tensile_strength": 1e6,
                "compressive_strength": 2e6,
                "fracture_energy": 1e6,
            }
        },
        events=[{"type": "drop", "height": 0.6}],
        solve={"cells": 8},
        output={"fps": 20, "seconds": 0.6, "size": [64, 48], "what": ["mp4"]},
    )


def test_it_is_told_everywhere(hard: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = hard.parent / "out"
    assert main(["run", str(hard), "-o", str(out)]) == 0
    record = json.loads((out / "run.json").read_text())
    simulation = record["simulation"]
    (found,) = simulation["unbroken"]
    assert found["speed"] == pytest.approx(math.sqrt(2 * 9.81 * 0.6), rel=0.1)
    assert record["verdict"] == simulation["verdict"] == "clean"
    thin, struck = simulation["notes"]
    walls = simulation["thin"]["ball"]
    assert walls["warning"] in thin and f"solve.cells: {walls['solve_cells']} " in thin
    assert walls["solve_cells"] == math.ceil(8 * walls["cells_needed"]) > 16
    assert "nothing broke" in struck and f"{found['speed_needed']:.2g} m/s" in struck
    shown, told = capsys.readouterr()
    said = told.splitlines()
    # told where it was found, and again in the list at the end, each once
    assert record["warnings"][-2:] == [thin, struck]
    assert len(set(record["warnings"])) == len(record["warnings"])
    assert said[-len(record["warnings"]) :] == [f"  ! {note}" for note in record["warnings"]]
    for note in (thin, struck):
        assert note in record["reason"] and note in said[:-2]
    assert any("simulate: 1 piece" in line and "0 % broken" in line for line in said)
    page = (out / "report.html").read_text()
    assert f'<p class="warn">clean: {record["reason"]}' in page and "Nothing broke" in page
    assert "Warnings" in page
    # a table ends the run, the record stays in its file
    assert "clean: " in shown and str(out / "video.mp4") in shown and len(shown.splitlines()) < 20


def test_thin_walls_are_told_before_anything_moves(
    hard: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(*_: Any) -> None:
        raise RunError("the disk is full")

    monkeypatch.setattr("gsfluent.results.frames.FrameWriter.write", full)
    assert main(["run", str(hard), "-o", str(hard.parent / "out")]) != 0
    said = capsys.readouterr().err
    assert "ball: 100 % of the surface stands on walls under 3 cells" in said
    assert "hint: solve.cells: " in said and "frame 1" not in said
