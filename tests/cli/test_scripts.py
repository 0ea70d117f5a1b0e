"""The thin scripts over the stages run on small inputs and leave what they say."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from loaded_scripts import load_script
from PIL import Image

import gsfluent as gf
from gsfluent.demo import make_capture

SCRIPTS = Path(__file__).resolve().parents[2] / "scripts" / "stages"


@pytest.mark.parametrize("name", ["fill", "simulate", "render"])
def test_scripts_are_thin(name: str) -> None:
    assert len((SCRIPTS / f"{name}.py").read_text(encoding="utf-8").splitlines()) <= 80


def test_reconstruct_script(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make_capture("watermelon", tmp_path / "capture", views=9, size=64)
    model, report = tmp_path / "model.ply", tmp_path / "report"
    arguments = [str(tmp_path / "capture"), "-o", str(model), "--report", str(report)]
    arguments += ["--iterations", "10", "--start-gaussians", "500"]
    assert load_script("bench/gsplat/reconstruct").main(arguments) == 0
    line = json.loads(capsys.readouterr().out)
    assert line["iterations"] == 10 and line["psnr"] > 5.0
    assert gf.load(model).count == line["gaussians"] > 100
    assert (report / "reconstruct.png").is_file()


def test_fill_and_simulate_scripts(
    ball: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    solid = tmp_path / "solid.ply"
    load_script("stages/fill").main(str(ball), str(solid))
    assert gf.load(solid).color is not None
    load_script("stages/simulate").main(str(solid), "bread", "0.3", "2.0")
    lines = capsys.readouterr().out.splitlines()
    assert sum(line.startswith("t = ") for line in lines) == 30


def test_render_script(ball: Path, tmp_path: Path) -> None:
    load_script("stages/render").main(str(ball), str(tmp_path / "ball.png"))
    low, high = Image.open(tmp_path / "ball.png").convert("L").getextrema()
    assert high - low > 50
