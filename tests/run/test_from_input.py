"""A run without a shot: what was pointed at becomes one."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import trimesh

from gsfluent import materials
from gsfluent.config import load_shot
from gsfluent.errors import InputError
from gsfluent.run.from_input import find_input, made_shot


def mesh(path: Path, color: tuple[int, int, int] | None = None) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    ball = trimesh.creation.icosphere(1)
    if color is not None:
        ball.visual.vertex_colors = [*color, 255]
    ball.export(path)
    return path


@pytest.mark.parametrize(
    ("name", "color", "material"),
    [
        ("BlueTeaCup_01.glb", None, "ceramic"),
        ("watermelons.stl", None, "fruit.watermelon"),
        ("a.stl", None, "plaster"),
        ("b.ply", (240, 240, 235), "ceramic"),
        ("c.ply", (120, 75, 40), "wood"),
        ("d.ply", (220, 30, 20), "fruit.apple"),
    ],
)
def test_material_from_name_or_colour(
    tmp_path: Path, name: str, color: tuple[int, int, int] | None, material: str
) -> None:
    source = mesh(tmp_path / "in" / name, color)
    shot = load_shot(made_shot(source, tmp_path / "out"))
    assert shot.mesh == source and shot.objects["object"].material == material


@pytest.mark.parametrize("material", ["plaster", "ceramic", "bone", "rubber"])
def test_the_fall_breaks_what_can_break(tmp_path: Path, material: str) -> None:
    shot = load_shot(made_shot(mesh(tmp_path / "x.stl"), tmp_path / "out", material))
    drop = shot.events[0]
    thrown = sum(-event.velocity[2] for event in shot.events[1:])  # type: ignore[union-attr]
    speed = math.hypot(thrown, math.sqrt(2 * 9.81 * drop.height))  # type: ignore[union-attr]
    limit = materials.get(material).breaking_speed
    assert drop.height <= 3.0  # type: ignore[union-attr]
    assert speed >= 1.45 * limit or not math.isfinite(limit)
    fall = (math.sqrt(thrown**2 + 19.62 * drop.height) - thrown) / 9.81  # type: ignore[union-attr]
    assert shot.output.seconds > fall + 1.0


def test_an_edited_shot_is_not_written_over(tmp_path: Path) -> None:
    source = mesh(tmp_path / "x.stl")
    path = made_shot(source, tmp_path / "out", "glass")
    assert made_shot(source, tmp_path / "out", "ice") == path  # nobody has touched it
    path.write_text(path.read_text().replace("ice", "bread"))
    with pytest.raises(InputError, match="has been edited"):
        made_shot(source, tmp_path / "out", "ice")


def test_folders(tmp_path: Path) -> None:
    one = mesh(tmp_path / "one" / "x.obj")
    assert find_input(one.parent) == ("mesh", one)
    mesh(tmp_path / "one" / "y.obj")
    with pytest.raises(InputError, match="more than one"):
        find_input(one.parent)
    model = tmp_path / "model" / "point_cloud" / "iteration_30" / "point_cloud.ply"
    model.parent.mkdir(parents=True)
    model.write_bytes(b"ply\n")
    assert find_input(tmp_path / "model") == ("splats", model)
    (tmp_path / "photographs").mkdir()
    (tmp_path / "photographs" / "1.jpg").write_bytes(b"")
    with pytest.raises(InputError, match="need poses"):
        find_input(tmp_path / "photographs")
    with pytest.raises(InputError, match="neither a shot"):
        find_input(tmp_path / "photographs" / "1.jpg")
