"""The single-stage verbs from files to files: inspect, reconstruct, fill, texture, demo."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from gsfluent.cli import main
from gsfluent.data import INTERIOR
from gsfluent.demo import make_capture
from gsfluent.io import load_splats
from gsfluent.io.solid import load_solid


def done(words: list[str], capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    """Run a verb with --json and return its one object."""
    capsys.readouterr()
    assert main([*words, "--json"]) == 0
    value: dict[str, Any] = json.loads(capsys.readouterr().out)
    return value


def test_inspect_draws_and_measures(
    ball: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    picture = tmp_path / "look.png"
    report = done(["inspect", str(ball), "-o", str(picture), "--size", "0.5"], capsys)
    assert report["kind"] == "splats"
    assert max(report["box"]["size"]) == pytest.approx(0.5, rel=0.1)
    assert min(Image.open(picture).size) > 100


def test_reconstruct_writes_a_splat_and_its_figures(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make_capture("orange", tmp_path / "capture", views=9, size=64)
    out = tmp_path / "made" / "model.ply"
    words = ["reconstruct", str(tmp_path / "capture"), "-o", str(out), "--iterations", "20"]
    report = done([*words, "--max-gaussians", "900"], capsys)
    assert report["images"] == 9 and report["held_out"] == 1
    assert load_splats(out).count == report["gaussians_saved"] <= 900
    assert json.loads((out.parent / "reconstruct.json").read_text()) == report


def test_fill_then_texture(ball: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    solid, textured = tmp_path / "solid.ply", tmp_path / "textured.ply"
    filled = done(["fill", str(ball), "-o", str(solid), "--resolution", "24"], capsys)
    assert filled["interior_gaussians"] == int((load_splats(solid).labels == INTERIOR).sum()) > 100
    words = ["texture", str(solid), "-o", str(textured), "--method", "color_copy"]
    report = done(words, capsys)
    assert report["method"] == "color_copy"
    color = load_solid(textured).color
    assert color is not None and float(color.std()) > 0.05
    width, height = Image.open(report["cuts"]).size
    assert width > 2 * height > 0


def test_demo_small_tells_the_truth_about_its_inside(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from gsfluent.run import demo as run_demo

    tiny = run_demo.DemoSize(9, 64, 40, 1500, 24, "preview", (64, 48), 0.3, 10.0)
    monkeypatch.setitem(run_demo.SIZES, "preview", tiny)
    record = done(["demo", "--size", "preview", "-o", str(tmp_path)], capsys)
    assert record["verdict"] == "clean"
    error = record["demo"]["interior_error"]
    assert 0 < error["profile"] < error["color_copy"]["profile"]
    assert record["demo"]["psnr"] == record["reconstruction"]["psnr"]
    assert record["stages"][0]["name"] == "photograph"
    # the demo leaves its shot, which runs like any other and redoes nothing
    again = done(["run", str(tmp_path / "shot.yaml"), "-o", str(tmp_path)], capsys)
    assert all(stage["resumed"] for stage in again["stages"])
