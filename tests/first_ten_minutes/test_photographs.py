"""Photographs to a film by one command: without poses, and as a folder of COLMAP."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
from first_film import first_film
from papered_box import eyes, papers, photograph
from PIL import Image

import gsfluent.run.from_input as from_input
from gsfluent.cli import main

VIEWS = 14


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("in") / "brick"
    folder.mkdir()
    papered = papers()
    for number, eye in enumerate(eyes(VIEWS)):
        Image.fromarray(photograph(eye, papered)).save(folder / f"{number:02d}.png")
    return folder


def test_without_poses_and_with_those_of_colmap(
    photographs: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    pytest.importorskip("pycolmap")
    learn = {"iterations": 150, "max_gaussians": 1500, "image_size": 160}
    monkeypatch.setitem(from_input.SETTINGS, "reconstruct", learn)
    out = tmp_path / "out"
    said = first_film(photographs, out, capsys)
    assert "has none; they are found first" in said
    assert f"{VIEWS} of {VIEWS} photographs have poses" in said
    assert "material: concrete, a guess from the name 'brick'" in said
    record = json.loads((out / "run.json").read_text())
    assert record["stages"][0]["name"] == "reconstruct"
    # the poses are kept, and what they lie in is a COLMAP folder for a run of its own
    poses = out / "capture" / "sparse" / "0"
    found = {path: path.stat().st_mtime_ns for path in poses.iterdir()}
    assert main(["run", str(photographs), "-o", str(out)]) == 0
    assert "poses: of an earlier run" in capsys.readouterr().err
    assert {path: path.stat().st_mtime_ns for path in poses.iterdir()} == found
    said = first_film(out / "capture", tmp_path / "again", capsys)
    assert "poses:" not in said


def test_what_is_missing_is_said(
    photographs: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["plan", str(photographs)]) == 2  # which only looks
    said = capsys.readouterr().err
    assert "photographs without poses" in said and f"gsfluent run {photographs}" in said
    monkeypatch.setitem(sys.modules, "pycolmap", None)  # not installed
    assert main(["run", str(photographs), "-o", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert "finding the poses of photographs needs pycolmap" in said
    assert 'pip install "gsfluent[poses]"' in said
