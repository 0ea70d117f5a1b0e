"""`gsfluent fit`: from a shot and tracks to fitted.yaml, resumed, and what it refuses."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml

from gsfluent.choose.shot import shot_scene
from gsfluent.cli import main
from gsfluent.config import load_shot
from gsfluent.pipeline.fit.forward import Forward
from gsfluent.progress import LineReporter

TIMES = [k / 24 for k in range(7)]


@pytest.fixture(scope="module")
def thrown(ball: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a shot of rubber and the tracks of a stiffer one."""
    folder = tmp_path_factory.mktemp("fit")
    shot: dict[str, Any] = {
        "splats": str(ball), "size": 0.3, "up": "+z", "floor": "auto",
        "fill": {"resolution": 24}, "texture": {"method": "color_copy"},
        "objects": {"it": {"material": "rubber", "law": "elastic", "young_modulus": 5e4,
                           "poisson_ratio": 0.3}},
        "events": [{"type": "drop", "height": 0.05},
                   {"type": "throw", "object": "it", "velocity": [0.1, 0.0, -1.5]}],
        "output": {"seconds": 0.3},
    }  # fmt: skip
    path = folder / "shot.yaml"
    path.write_text(yaml.safe_dump(shot))
    reporter = LineReporter()
    scene, _ = shot_scene(
        load_shot(path), folder / "out", device=torch.device("cpu"), reporter=reporter, make=True
    )
    truth = Forward(scene, TIMES, 0.3 / 5)
    values = {"it.young_modulus": 1.2e5}
    motion = truth.run(values, len(TIMES), truth.step(values))
    np.savez(folder / "track.npz", positions=motion.position[:, ::5].numpy(), times=TIMES)
    return folder


def test_tracks_become_a_shot_that_runs_on(
    thrown: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = thrown / "out"
    words = ["fit", str(thrown / "shot.yaml"), "--points", str(thrown / "track.npz")]
    words += ["--learn", "it.young_modulus", "--starts", "1", "--grids", "1", "--cells", "5"]
    words += ["--jobs", "1", "-o", str(out), "--json"]
    assert main(words) == 0
    found = json.loads(capsys.readouterr().out)
    number = found["parameters"]["it.young_modulus"]
    assert abs(np.log10(number["value"] / 1.2e5)) < 0.05 and found["unidentified"] == {}
    assert json.loads((out / "fit.json").read_text()) == found
    assert "it.young_modulus" in (out / "fit.html").read_text()
    fitted = load_shot(out / "fitted.yaml")
    assert fitted.objects["it"].overrides["young_modulus"] == pytest.approx(number["value"])
    assert [e["type"] for e in yaml.safe_load((out / "fitted.yaml").read_text())["events"]] == [
        "drop",
        "throw",
    ]
    done = list((out / "search").rglob("*"))
    assert main(words) == 0  # nothing is searched again
    assert json.loads(capsys.readouterr().out) == found
    assert sorted(done) == sorted((out / "search").rglob("*"))


@pytest.mark.parametrize(
    ("more", "what"),
    [([], "needs one of"), (["--points", "track.npz", "--force", "track.npz"], "needs one of")],
)
def test_one_target_it_is(
    more: list[str], what: str, thrown: Path, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(thrown)
    words = ["fit", "shot.yaml", "--learn", "it.young_modulus", "-o", "other", *more]
    assert main(words) == 2
    assert what in capsys.readouterr().err
