"""A run without a shot: what was pointed at becomes one."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from gsfluent import materials
from gsfluent.config import Shot, load_shot
from gsfluent.errors import InputError
from gsfluent.io import save_image
from gsfluent.pipeline.capture.front import front_side
from gsfluent.pipeline.capture.orient import make_frame
from gsfluent.pipeline.fill.mesh_skin import mesh_gaussians
from gsfluent.run.from_input import _fall, find_input, guess_front, made_shot
from gsfluent.stages.breaking import breaks_from


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


def test_a_guess_says_that_it_is_one_and_what_is_near(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level("INFO"):
        made_shot(mesh(tmp_path / "in" / "mango-v1.stl"), tmp_path / "out")
    assert "fruit.apple, a guess from the name 'mango-v1': mango has no preset" in caplog.text
    assert "fruit.orange" in caplog.text and "--material" in caplog.text


@pytest.mark.parametrize("material", ["plaster", "ceramic", "fruit.apple", "rubber"])
def test_the_fall_breaks_what_can_break(tmp_path: Path, material: str) -> None:
    shot = load_shot(made_shot(mesh(tmp_path / "x.stl"), tmp_path / "out", material))
    drop = shot.events[0]
    thrown = sum(-event.velocity[2] for event in shot.events[1:])  # type: ignore[union-attr]
    speed = math.hypot(thrown, math.sqrt(2 * 9.81 * drop.height))  # type: ignore[union-attr]
    limit = breaks_from(materials.get(material), 0.2, 0.2 / 20)  # a mesh of no unit is 0.2 m long
    assert drop.height <= 3.0  # type: ignore[union-attr]
    assert speed >= 1.2 * limit or not math.isfinite(limit)
    fall = (math.sqrt(thrown**2 + 19.62 * drop.height) - thrown) / 9.81  # type: ignore[union-attr]
    slow = shot.output.slow
    assert shot.output.seconds > fall + 1.0 / slow
    # what is fast for its size is shown slower, in as many frames a second of film
    assert shot.output.fps == pytest.approx(30.0 * slow)
    assert (slow > 1.0) == (0.06 * speed / 0.2 > 1.5)


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


@pytest.mark.parametrize("name", ["", "meta.json"])
def test_an_unpacked_sog_is_told_to_be_packed(tmp_path: Path, name: str) -> None:
    for file in ("meta.json", "means_l.webp"):
        (tmp_path / file).write_bytes(b"{}")
    with pytest.raises(InputError, match=r"unpacked.*\n.*zip -0") as caught:
        find_input(tmp_path / name)
    assert f"{tmp_path.name}.sog" in str(caught.value)


def front_of(path: Path) -> list[float] | None:
    """The front that the shot for a mesh names."""
    made = load_shot(made_shot(path, path.parent / path.stem)).front
    return None if isinstance(made, str) else list(made)


def painted(path: Path, side: tuple[float, float, float]) -> Path:
    """A grey ball with squares on the side that looks along ``side``."""
    ball = trimesh.creation.icosphere(4)
    facing = ball.vertices @ side > 0.6
    squares = (np.floor(ball.vertices * 4.0).sum(axis=1) % 2).astype(bool)
    colors = np.full((len(ball.vertices), 4), [120, 120, 120, 255], dtype=np.uint8)
    colors[facing & squares] = [240, 20, 20, 255]
    ball.visual.vertex_colors = colors
    ball.export(path)
    return path


def test_the_painted_side_is_the_front(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    side = np.array([math.cos(0.5), 0.0, -math.sin(0.5)])  # beside the custom of +z
    with caplog.at_level("INFO"):
        found = front_of(painted(tmp_path / "a.glb", tuple(side)))
    assert found is not None and np.dot(found, side) > math.cos(math.radians(20.0))
    assert "the side with the most to see" in caplog.text


def test_a_written_shot_guesses_when_it_is_asked(tmp_path: Path) -> None:
    side = np.array([math.cos(0.5), 0.0, -math.sin(0.5)])
    source = painted(tmp_path / "a.glb", tuple(side))
    skin = mesh_gaussians(source)
    turns = {}
    for word in ("auto", "guess"):
        shot = Shot.from_dict({"mesh": str(source), "front": word})
        turns[word] = make_frame(skin, None, shot).rotation @ torch.from_numpy(side)
    # films begin at -y of the scene
    assert float(turns["guess"][1]) < -math.cos(math.radians(20.0)) < float(turns["auto"][1])


def test_what_looks_alike_from_all_sides_keeps_the_custom(tmp_path: Path) -> None:
    assert front_of(mesh(tmp_path / "b.glb", (120, 75, 40))) is None
    assert front_of(painted(tmp_path / "c.glb", (0.0, 0.0, 1.0))) is None


@pytest.mark.parametrize("turn", [0.0, 1.0, 2.5])
def test_a_face_is_looked_at_along_the_plane_of_symmetry(turn: float) -> None:
    """Cheeks are busier than the face, and the back is bare."""
    ball = trimesh.creation.icosphere(5).vertices * [1.0, 1.2, 0.8]
    cheek = (np.abs(ball[:, 0]) > 0.4) & (np.floor(9.0 * np.abs(ball)).sum(axis=1) % 2 == 0)
    face = (ball[:, 2] > 0.4) & (np.abs(ball[:, 0]) < 0.2) & (np.abs(ball[:, 1]) < 0.2)
    colors = np.where((cheek | face)[:, None], [0.9, 0.1, 0.1], [0.5, 0.5, 0.5])
    nose = np.where(face[:, None], [0.0, 0.0, 0.3], [0.0, 0.0, 0.0])
    cos, sin = math.cos(turn), math.sin(turn)
    about = np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])
    up, usual = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
    found, _ = front_side((ball + nose) @ about.T, colors, up, usual)
    assert found @ about[:, 2] > math.cos(math.radians(10.0))


def test_what_is_seen_end_on_is_not_the_front() -> None:
    """A bar is alike left and right along itself, too, and its near end is painted."""
    bar = trimesh.sample.sample_surface(trimesh.creation.box((2.0, 0.4, 0.5)), 4000, seed=0)[0]
    end = (bar[:, 0] > 0.99) & (np.floor(20.0 * bar).sum(axis=1) % 2 == 0)
    colors = np.where(end[:, None], [0.9, 0.1, 0.1], [0.5, 0.5, 0.5])
    up, usual = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
    found, why = front_side(bar, colors, up, usual)
    assert abs(found @ usual) > 0.99, why


@pytest.mark.parametrize("around", [False, True])
def test_photographers_stand_before_the_front(tmp_path: Path, around: bool) -> None:
    turns = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
    turns = turns if around else np.linspace(0.3, 1.5, 12)
    frames = []
    for number, turn in enumerate(turns):
        eye = np.array([3.0 * math.cos(turn), 3.0 * math.sin(turn), 1.0])
        back = eye / np.linalg.norm(eye)
        right = np.cross([0.0, 0.0, 1.0], back)
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3] = np.stack([right, np.cross(back, right), back, eye], axis=1)
        name = f"{number}.png"
        save_image(torch.zeros(12, 16, 3), tmp_path / name)
        frames.append({"file_path": name, "transform_matrix": pose.tolist()})
    values = {"fl_x": 16.0, "fl_y": 16.0, "cx": 8.0, "cy": 6.0, "w": 16, "h": 12, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(values))
    found, _ = guess_front("capture", tmp_path, None)
    if around:
        assert found is None
    else:
        middle = [math.cos(0.9), math.sin(0.9), 0.0]
        assert found is not None and np.dot(found, middle) > 0.99


def test_what_is_slender_falls_from_less(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """A rod of plaster breaks at a walk, and from a metre its parts would be crushed."""
    heights = {}
    for name, sides in (("rod", (0.1, 0.1, 1.0)), ("block", (1.0, 1.0, 1.0))):
        source = tmp_path / f"{name}.stl"
        trimesh.creation.box(sides).export(source)
        with caplog.at_level("INFO"):
            made = load_shot(made_shot(source, tmp_path / name, material="plaster"))
        heights[name] = made.events[0].height
    assert heights["rod"] == 0.5 < heights["block"]
    assert "a drop from 0.5 m (plaster is estimated to break from" in caplog.text


@pytest.mark.parametrize("slender", [False, True])
@pytest.mark.parametrize("size", [0.05, 0.2, 1.0])
def test_nothing_is_thrown_faster_than_an_arm_throws(size: float, slender: bool) -> None:
    whole = 0
    for name in materials.names():
        events, shown, why = _fall(materials.get(name), size, slender)
        drop, *throws = events
        down = sum(-throw["velocity"][2] for throw in throws)
        assert math.hypot(down, math.sqrt(2 * 9.81 * drop["height"])) < 25.3, name
        assert shown["seconds"] > 0.0
        if "faster than one throws" in why:
            whole += 1
            assert not throws and drop["height"] == 1.0, name
    assert slender or whole >= 2  # wood and foam
