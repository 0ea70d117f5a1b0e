"""The judge of fracture pictures from end to end, on a small melon."""

from __future__ import annotations

import json
import sys

import pytest
import torch
from loaded_scripts import load_script

from gsfluent.data import SPRAY, Gaussians


@pytest.fixture
def script():
    return load_script("accuracy/cracks")


def test_methods_are_told_apart_and_work_is_kept(script, tmp_path, monkeypatch, capsys):
    options = ["--object", "melon", "--cells", "12", "--resolution", "32", "--finer", "3"]
    options += ["--size", "144", "--frames", "48,49", "--cache", str(tmp_path / "cache")]
    options += ["--sheets", str(tmp_path / "sheets"), "--json", str(tmp_path / "all.json")]

    def run(*more: str) -> str:
        monkeypatch.setattr(sys, "argv", ["cracks.py", *options, *more])
        assert script.main() == 0
        return capsys.readouterr().out

    run("--only", "raw,raw-total,chunks")
    found = json.loads((tmp_path / "all.json").read_text())["melon"]["methods"]
    # clean pieces are nearer to the truth than beads, and those than needles across the picture
    assert found["chunks"]["psnr"] > found["raw"]["psnr"]
    assert found["raw"]["psnr"] > found["raw-total"]["psnr"] + 0.2
    assert all(0.0 < row["flicker"] < 10.0 for row in found.values())
    # the truth has no holes and is its own truth
    assert found["truth"]["holes"] < 0.2 and found["truth"]["ssim"] == pytest.approx(1.0)
    assert 0.0 <= found["raw"]["holes"] <= found["raw"]["most holes"] <= 100.0
    assert (tmp_path / "sheets" / "melon_049.png").is_file()

    kept = {path: path.stat().st_mtime_ns for path in (tmp_path / "cache").rglob("*.*")}
    table = run("--only", "mvee")
    assert "| mvee |" in table and "| raw |" not in table
    promised = run("--chunks")
    rows = dict(line.strip("| ").split(" | ", 1) for line in promised.splitlines() if "|" in line)
    assert rows["sum of the volumes, voxels lost"] == "0 | 0"
    assert float(rows["overlap of pieces [%]"].split(" | ")[1]) < 5.0
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "cache").rglob("*.*")} == kept


def test_pieces_are_chunks_without_grains(monkeypatch):
    cases = load_script("accuracy/crack_cases")
    splats = Gaussians.from_colors(torch.rand(5, 3), torch.full((5,), 0.01), torch.rand(5, 3))
    labels = torch.tensor([0, SPRAY, 2, SPRAY, 0], dtype=torch.int32)
    groups = torch.arange(5, dtype=torch.int32)
    whole = cases.Drawn(splats.replace(labels=labels), groups, splats.means)
    monkeypatch.setattr(cases, "repaired", lambda *_: whole)
    found = cases.METHODS["pieces"](None, None)
    assert torch.equal(found.gaussians.means, splats.means[[0, 2, 4]])
    assert found.groups.tolist() == [0, 2, 4] and found.shown is splats.means


def test_flat_cuts_have_the_heights_that_were_asked_for(script):
    found = script.flat_cuts(cells=16, rough=0.3)
    assert 0.6 < found["slope"] < 1.0
    assert 0.7 < found["rms over the material's"] < 1.3
