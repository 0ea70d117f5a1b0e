"""A mesh through the whole command line, in its colours and with its own volume."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import trimesh
import yaml
from ball_shot import write_shot

from gsfluent.cli import main
from gsfluent.data import SURFACE
from gsfluent.io import load_solid


@pytest.fixture
def vase(tmp_path: Path) -> Path:
    """A red box as GLB, 1 m along y, which glTF has upright."""
    box = trimesh.creation.box((0.4, 1.0, 0.5))
    box.visual.vertex_colors = [147, 2, 2, 255]  # linear, as glTF has them: 200, 20, 20 as shown
    box.export(tmp_path / "vase.glb")
    return tmp_path / "vase.glb"


def test_a_mesh_runs_and_its_solid_is_not_filled_again(vase: Path) -> None:
    shot = write_shot(vase.parent / "shot.yaml", vase, output={"fps": 20, "seconds": 0.2,
                      "size": [64, 48]})  # fmt: skip
    values = yaml.safe_load(shot.read_text())
    values["mesh"] = values.pop("splats")
    for key in ("up", "scale"):
        del values[key]
    shot.write_text(yaml.safe_dump(values))
    out = vase.parent / "out"
    assert main(["run", str(shot), "-o", str(out)]) == 0
    record = json.loads((out / "run.json").read_text())
    assert record["isolation"]["up"] == [0.0, 1.0, 0.0]
    assert record["isolation"]["up_from"] == "file format" and record["isolation"]["scale"] == 1.0
    assert record["fill"]["volume_m3"] == pytest.approx(0.2, rel=0.01)
    solid = load_solid(out / "stages" / "texture" / "ball.ply")
    splats = solid.gaussians
    assert splats.labels is not None
    skin = splats.select(splats.labels == SURFACE)
    assert skin.colors().mean(0).tolist() == pytest.approx(
        [200 / 255, 20 / 255, 20 / 255], abs=0.02
    )
    # the solid that a run or `gsfluent fill` leaves goes into another shot as it is
    del values["mesh"], values["fill"]
    values["splats"] = str(out / "stages" / "texture" / "ball.ply")
    shot.write_text(yaml.safe_dump(values | {"up": "+y", "scale": 1.0}))
    assert main(["run", str(shot), "-o", str(vase.parent / "again")]) == 0
    again = json.loads((vase.parent / "again" / "run.json").read_text())
    assert again["fill"]["volume_m3"] == pytest.approx(record["fill"]["volume_m3"], rel=1e-9)
    assert again["fill"]["method"] == "filled before"


@pytest.mark.parametrize("key", ["splats", "capture"])
def test_the_right_key_is_named(vase: Path, key: str, capsys: pytest.CaptureFixture[str]) -> None:
    shot = vase.parent / "shot.yaml"
    shot.write_text(f"{key}: vase.glb\n")
    assert main(["run", str(shot), "-o", str(vase.parent / "out")]) == 2
    said = capsys.readouterr().err
    assert "is a mesh" in said and "write mesh: vase.glb" in said


def test_a_mesh_is_planned_as_it_would_run(vase: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = sorted(vase.parent.iterdir())
    assert main(["plan", str(vase), "--no-probe", "--json", "--material", "glass"]) == 0
    said = capsys.readouterr()
    plan = json.loads(said.out)
    assert plan["particles"] > 0 and plan["breaking"][0]["material"] == "glass"
    assert "event: " in said.err and sorted(vase.parent.iterdir()) == before
    assert main(["plan", str(vase.with_suffix(".txt"))]) == 2
    assert "does not exist" in capsys.readouterr().err


def test_a_mesh_where_a_shot_is_wanted(vase: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["chart", str(vase), "--error", "5%"]) == 2
    assert "write mesh: vase.glb" in capsys.readouterr().err


def test_material_belongs_to_a_run_without_a_shot(
    shot: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", str(shot), "-o", str(shot.parent / "o"), "--material", "glass"]) == 2
    assert "objects: NAME: material" in capsys.readouterr().err
