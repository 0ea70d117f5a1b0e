"""Options for what strangers made: --untrusted and --allow-outside."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from gsfluent.cli import main
from gsfluent.config import Shot, refuse_programs
from gsfluent.errors import InputError


@pytest.mark.parametrize(
    ("texture", "key"),
    [
        ({"method": "inpaint", "inpaint": {"backend": "command", "command": "touch {folder}/x"}},
         "texture.inpaint.command"),
        ({"method": "diffusion", "model": "hub/model", "prompt": "melon"}, "texture.model"),
        ({"method": "diffusion", "model": "m", "prompt": "a", "inpaint": {"controlnet": "c"}},
         "texture"),
    ],
)  # fmt: skip
def test_shots_that_start_programs_are_refused(tmp_path: Path, texture: dict, key: str) -> None:
    (tmp_path / "a.ply").touch()
    shot = Shot.from_dict({"splats": "a.ply", "texture": texture}, tmp_path)
    with pytest.raises(InputError, match=f"shot.yaml: {key}") as caught:
        refuse_programs(shot, "shot.yaml")
    assert "--untrusted" in caught.value.hint
    path = tmp_path / "shot.yaml"
    path.write_text(json.dumps({"splats": "a.ply", "texture": texture}))
    assert main(["run", str(path), "-o", str(tmp_path / "out"), "--untrusted"]) == 2
    assert not (tmp_path / "out").exists()


def test_other_shots_are_not(tmp_path: Path) -> None:
    (tmp_path / "a.ply").touch()
    refuse_programs(Shot.from_dict({"splats": "a.ply", "size": 0.1}, tmp_path), "shot.yaml")


def test_allow_outside_reaches_the_reader(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pose = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]]
    frame = {"file_path": "../a.png", "transform_matrix": pose}
    (tmp_path / "capture").mkdir()
    (tmp_path / "capture" / "transforms.json").write_text(
        json.dumps({"fl_x": 20.0, "w": 24, "h": 18, "frames": [frame]})
    )
    assert main(["inspect", str(tmp_path / "capture")]) == 2
    assert "--allow-outside" in capsys.readouterr().err
    assert main(["inspect", str(tmp_path / "capture"), "--allow-outside"]) == 2
    assert "1 of 1 images are missing" in capsys.readouterr().err
