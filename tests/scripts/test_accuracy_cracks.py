"""The judge of fracture pictures from end to end, on a small melon."""

from __future__ import annotations

import json
import sys

import pytest
from loaded_scripts import load_script


@pytest.fixture
def script():
    return load_script("accuracy/cracks")


def test_methods_are_told_apart_and_work_is_kept(script, tmp_path, monkeypatch, capsys):
    options = ["--object", "melon", "--cells", "12", "--resolution", "40", "--voxels", "60"]
    options += ["--size", "200", "--frames", "24,25", "--cache", str(tmp_path / "cache")]
    options += ["--sheets", str(tmp_path / "sheets"), "--json", str(tmp_path / "all.json")]

    def run(*more: str) -> str:
        monkeypatch.setattr(sys, "argv", ["cracks.py", *options, *more])
        assert script.main() == 0
        return capsys.readouterr().out

    run("--only", "raw,raw-total,ideal")
    found = json.loads((tmp_path / "all.json").read_text())["melon"]["methods"]
    # the true motion cannot be further from the truth than needles that reach across the picture
    assert found["ideal"]["psnr"] > found["raw-total"]["psnr"] + 0.2
    assert found["raw"]["psnr"] > found["raw-total"]["psnr"] + 0.2
    assert all(0.0 < row["flicker"] < 10.0 for row in found.values())
    # the truth has no holes and is its own truth
    assert found["truth"]["holes"] < 0.2 and found["truth"]["ssim"] == pytest.approx(1.0)
    assert 0.0 <= found["raw"]["holes"] <= found["raw"]["most holes"] <= 100.0
    assert (tmp_path / "sheets" / "melon_025.png").is_file()

    kept = {path: path.stat().st_mtime_ns for path in (tmp_path / "cache").rglob("*.*")}
    table = run("--only", "carried")
    assert "| carried |" in table and "| raw |" not in table
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "cache").rglob("*.*")} == kept
