"""`gsfluent inspect SHOT`: the parts of a shot before it is run, in the folder of the run."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from ball_shot import write_shot
from PIL import Image

from gsfluent.cli import main


def test_a_shot_shows_its_parts_and_the_run_goes_on(
    ball: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    picture = np.full((10, 20), 1, np.uint8)
    picture[:, 10:] = 2
    Image.fromarray(picture).save(tmp_path / "side.png")
    parts = [
        {"name": "right", "where": {"label_image": {"y": "side.png"}, "label": 2}, "cohesion": 2.0},
        {"name": "crust", "where": {"depth_below": 0.1}, "material": "wood"},
    ]
    shot = write_shot(
        tmp_path / "shot.yaml", ball, objects={"ball": {"material": "bread", "parts": parts}}
    )
    out = tmp_path / "parts.png"
    words = ["inspect", str(shot), "-o", str(out), "--json"]
    assert main(words) == 2  # where?
    assert "--run" in json.loads(capsys.readouterr().out)["error"]["hint"]
    assert main([*words, "--run", str(tmp_path / "run")]) == 0
    report = json.loads(capsys.readouterr().out)["objects"]["ball"]
    rest, right, crust = report["parts"]
    assert rest["share"] == pytest.approx(right["share"], abs=0.05)
    assert crust["mean_depth"] < right["mean_depth"] and crust["particles"] > 0
    assert Image.open(out).size[0] > 1000
    assert Image.open(report["labels_picture"]).size[0] > 1000
    assert main(["run", str(shot), "-o", str(tmp_path / "run"), "--json"]) == 0
    run = json.loads(capsys.readouterr().out)
    done = {stage["name"]: stage["resumed"] for stage in run["stages"]}
    assert done["fill"] and done["texture"] and done["regions"] and not done["simulate"]
