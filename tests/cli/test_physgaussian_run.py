"""`gsfluent run MODEL --config config.json`: a PhysGaussian model folder end to end."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from physgaussian_model import CENTER, config, write_model

from gsfluent.cli import main
from gsfluent.data import Frame
from gsfluent.results.frames import load_frame


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_model(tmp_path_factory.mktemp("model"))


def test_a_model_folder_runs_and_says_what_became_of_its_config(
    model: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    held = {
        "type": "enforce_particle_translation", "point": [1, 1, 1], "size": [1, 1, 1],
        "velocity": [0, 0, 0], "start_time": 0.0, "end_time": 0.04,
    }  # fmt: skip
    file = config(
        tmp_path / "ball.json", frame_dt=0.02, frame_num=5, n_grid=30, rpic_damping=0.5, gg=1,
        boundary_conditions=[held],
    )  # fmt: skip
    out = tmp_path / "out"
    with caplog.at_level("WARNING", logger="gsfluent"):
        assert main(["run", str(model), "--config", str(file), "-o", str(out)]) == 0
    record = json.loads((out / "run.json").read_text())
    assert record["verdict"] == "clean"
    found = record["physgaussian"]
    assert "rpic_damping" in found["unsupported"] and "did you mean 'g'" in found["unknown"]["gg"]
    assert (out / "video.mp4").is_file()
    # held for 0.04 s, then it falls; in the world as far as their box shrinks it more
    frames = [load_frame(out / "stages" / "simulate", i) for i in range(5)]
    z = [float(f.positions[:, 2].double().mean()) for f in frames]
    assert [f.time for f in frames] == pytest.approx([0.0, 0.02, 0.04, 0.06, 0.08])
    assert z[2] == pytest.approx(z[0], abs=1e-6)
    assert z[2] - z[4] == pytest.approx(0.5 * 9.8 * 0.04**2, rel=0.02)
    world = Frame.from_dict(found["world_to_scene"]).inverse()
    middle = world.apply(frames[0].positions.double().mean(dim=0))
    assert middle.numpy() == pytest.approx(CENTER, abs=0.05)
    fallen = world.apply(frames[4].positions.double().mean(dim=0)) - middle
    assert float(fallen[2]) == pytest.approx((z[4] - z[0]) * 3.0, rel=1e-4)
    assert float(torch.hypot(fallen[0], fallen[1])) < 1e-3 * abs(float(fallen[2])) + 1e-4


def test_the_shot_alone(model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = config(tmp_path / "ball.json", substep_dt=1e-4)
    words = ["run", str(model), "--config", str(file), "-o", str(tmp_path / "out"), "--write-shot"]
    assert main([*words, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert Path(told["shot"]).is_file() and "substep_dt" in told["inert"]
    assert not (tmp_path / "out" / "run.json").exists()


def test_arguments_that_do_not_fit(model: Path, tmp_path: Path) -> None:
    out = ["-o", str(tmp_path / "out")]
    assert main(["run", str(model), *out, "--write-shot"]) == 2
    shot = tmp_path / "shot.yaml"
    shot.write_text("splats: none.ply\n")
    assert main(["run", str(shot), *out, "--write-shot"]) == 2
    assert main(["run", str(shot), *out, "--config", str(config(tmp_path / "c.json"))]) == 2
