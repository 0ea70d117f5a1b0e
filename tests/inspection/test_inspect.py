"""Up axis, floor, scale, pieces, floaters, thin parts, the picture."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from gsfluent import geometry
from gsfluent.config import Select, Shot
from gsfluent.data import Camera, Capture, Frame, Gaussians
from gsfluent.errors import InputError
from gsfluent.inspection.capture import inspect
from gsfluent.io import load_capture, load_image, load_splats, save_image, save_splats
from gsfluent.pipeline.capture.orient import (
    camera_up,
    look_at_point,
    make_frame,
    orient,
    support_plane,
)
from gsfluent.spatial.shape import cluster, lone_points, robust_box, thin_parts
from gsfluent.stages.select import select_mask


def ball(
    count: int, radius: float, center: tuple[float, ...] = (0, 0, 0), seed: int = 0
) -> np.ndarray:
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(count, 3))
    return radius * directions / np.linalg.norm(directions, axis=1, keepdims=True) + center


def splats(points: np.ndarray, size: float = 0.05) -> Gaussians:
    means = torch.from_numpy(points.astype(np.float32))
    return Gaussians.from_colors(means, torch.full((len(means),), size), torch.rand(len(means), 3))


def table_scene(tilt: torch.Tensor) -> Capture:
    """A ball on a table seen from a ring of cameras above, the world turned by ``tilt``."""
    rng = np.random.default_rng(1)
    table = np.concatenate([rng.uniform(-2, 2, (1500, 2)), rng.normal(0, 0.003, (1500, 1))], axis=1)
    thing = ball(500, 0.5, (0, 0, 0.5))
    points = torch.from_numpy(np.concatenate([table, thing]))
    cameras = [
        Camera.look_at(
            (4 * math.cos(a), 4 * math.sin(a), 2.5),
            (0, 0, 0.4),
            width=64,
            height=48,
            name=f"{a:.2f}",
        )
        for a in np.linspace(0, 5, 12)
    ]
    capture = Capture(cameras, points, torch.rand(2000, 3), Path("."))
    return capture.transformed(Frame(tilt, torch.tensor([0.3, -2.0, 5.0]), 3.0))


@pytest.fixture(params=range(4))
def tilt(request: pytest.FixtureRequest) -> torch.Tensor:
    generator = torch.Generator().manual_seed(request.param)
    return geometry.quaternion_to_matrix(torch.randn(4, generator=generator, dtype=torch.float64))


def test_level_cameras_tell_up(tilt: torch.Tensor) -> None:
    found = camera_up(table_scene(tilt).cameras)
    assert float(torch.from_numpy(found) @ tilt[:, 2]) > math.cos(math.radians(0.1))


def test_cameras_look_at_the_target(tilt: torch.Tensor) -> None:
    target = Frame(tilt, torch.tensor([0.3, -2.0, 5.0]), 3.0).apply(
        torch.tensor([0.0, 0.0, 0.4]).double()
    )
    np.testing.assert_allclose(look_at_point(table_scene(tilt).cameras), target.numpy(), atol=1e-6)


def test_support_plane_is_found_even_when_cameras_lean(tilt: torch.Tensor) -> None:
    capture = table_scene(tilt)
    leaning = torch.from_numpy(camera_up(capture.cameras)) + 0.2 * tilt[:, 0]
    axis = (leaning / leaning.norm()).numpy()
    plane = support_plane(capture, axis, look_at_point(capture.cameras))
    assert plane is not None
    assert plane[0] @ tilt[:, 2].numpy() > math.cos(math.radians(0.5))
    expected = float(tilt[:, 2] @ torch.tensor([0.3, -2.0, 5.0]).double())
    assert plane[1] == pytest.approx(expected, abs=0.02)


def test_no_plane_among_the_points_of_a_ball(tilt: torch.Tensor) -> None:
    capture = table_scene(tilt)
    stance = orient(
        None,
        capture.replace(points=capture.points[1500:], point_colors=capture.point_colors[1500:]),
    )
    assert stance.up_from == "cameras" and stance.floor_from == "lowest point"


def test_frame_of_a_capture_is_upright_metric_and_on_the_floor(tilt: torch.Tensor) -> None:
    capture = table_scene(tilt)
    thing = splats(capture.points[1500:].numpy())
    shot = Shot.from_dict({"splats": ".", "size": 0.08})
    frame = make_frame(thing, capture, shot)
    moved = frame.apply(thing.means.double())
    assert float((moved.amax(0) - moved.amin(0)).max()) == pytest.approx(0.08, rel=0.02)
    assert float(moved[:, 2].min()) == pytest.approx(0.0, abs=0.001)
    assert float(moved[:, :2].mean(0).abs().max()) < 0.003
    np.testing.assert_allclose((frame.rotation @ tilt[:, 2]).numpy(), [0, 0, 1], atol=0.01)
    ahead = frame.apply_vector(capture.cameras[0].forward())
    assert float(ahead[0]) == pytest.approx(0.0, abs=1e-6) and float(ahead[1]) > 0


def test_shot_settings_win(tilt: torch.Tensor) -> None:
    thing = splats(ball(500, 1.0))
    shot = Shot.from_dict({"splats": ".", "scale": 0.5, "up": [0, 1, 0], "floor": -2.0})
    frame = make_frame(thing, None, shot)
    np.testing.assert_allclose(
        (frame.rotation @ torch.tensor([0.0, 1.0, 0.0]).double()).numpy(), [0, 0, 1], atol=1e-12
    )
    assert frame.scale == 0.5
    # The floor lies at y * scale = -2, that is y = -4.
    assert float(frame.apply(torch.tensor([0.0, -4.0, 0.0]).double())[2]) == pytest.approx(
        0.0, abs=1e-9
    )


def test_bare_splats_stand_on_minus_y_and_floaters_do_not_lift_them() -> None:
    points = np.concatenate([ball(2000, 1.0), [[0.0, 9.0, 0.0], [5.0, 0.0, 0.0], [5.2, 0.0, 0.0]]])
    frame = make_frame(splats(points))
    moved = frame.apply(torch.tensor([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]]).double())
    assert float(moved[0, 2]) == pytest.approx(0.0, abs=0.002) and float(
        moved[1, 2]
    ) == pytest.approx(0.2, abs=0.004)


def test_frame_refuses_a_point_and_nan() -> None:
    with pytest.raises(InputError, match="all splats lie in one point"):
        make_frame(splats(np.zeros((20, 3))))
    with pytest.raises(InputError, match="means must be finite"):
        make_frame(splats(np.full((20, 3), np.nan)))
    with pytest.raises(InputError, match="neither splats nor sparse points"):
        orient(None, None)


def test_clusters_separate_pieces_from_floaters() -> None:
    points = np.concatenate(
        [ball(2000, 1.0), ball(300, 0.3, (2.5, 0, 0)), ball(5, 0.05, (0, 4, 0))]
    )
    groups = cluster(points)
    assert groups.pieces == 2
    assert np.bincount(groups.index)[:2].tolist() == [2000, 300]
    assert groups.floaters.sum() == 5 and groups.floaters[-5:].all()


def test_lone_points_are_those_off_the_cloud() -> None:
    points = np.concatenate(
        [np.random.default_rng(0).normal(size=(500, 3)) * 0.1, [[3.0, 0, 0], [0, 3.0, 0]]]
    )
    lone = lone_points(points)
    assert lone[-2:].all() and lone[:500].mean() < 0.1
    assert not lone_points(points[:4]).any()


def test_robust_box_forgets_one_floater() -> None:
    points = np.concatenate([ball(3000, 1.0), [[50.0, 0, 0]]])
    low, high = robust_box(points)
    assert high.max() < 1.01 and low.min() > -1.01


def test_a_plate_is_thin_and_a_ball_is_not() -> None:
    rng = np.random.default_rng(0)
    plate = rng.uniform([-1, -1, -0.02], [1, 1, 0.02], size=(30000, 3))
    spike = rng.uniform([-0.03, -0.03, 1], [0.03, 0.03, 2], size=(3000, 3))
    solid_ball = thin_parts(ball(20000, 1.0), np.full(20000, 0.05))
    spiked = thin_parts(np.concatenate([ball(20000, 1.0), spike]), np.full(23000, 0.03))
    assert thin_parts(plate, np.full(30000, 0.02))["share"] > 0.9
    assert solid_ball["share"] < 0.02 and solid_ball["parts"] == []
    assert len(spiked["parts"]) == 1 and spiked["parts"][0]["center"][2] > 1.0


def test_select_by_place_color_and_label(tmp_path: Path) -> None:
    gaussians, frame = splats(ball(200, 1.0)), Frame(torch.eye(3), torch.zeros(3), 0.1)
    everything = select_mask(gaussians, Select(), frame)
    assert bool(everything.all())
    upper = select_mask(gaussians, Select(box=((-1, -1, 0), (1, 1, 1))), frame)
    assert torch.equal(upper, gaussians.means[:, 2] >= 0)
    cap = select_mask(gaussians, Select(sphere=(0, 0, 0.1, 0.05)), frame)
    assert torch.equal(cap, (0.1 * gaussians.means - torch.tensor([0, 0, 0.1])).norm(dim=1) <= 0.05)
    red = select_mask(gaussians, Select(color_near=(1, 0, 0), tolerance=0.5), frame)
    assert torch.equal(red, (gaussians.colors() - torch.tensor([1.0, 0, 0])).norm(dim=1) <= 0.5)
    np.save(tmp_path / "labels.npy", np.arange(200) % 3)
    third = select_mask(gaussians, Select(labels=tmp_path / "labels.npy", label=2), frame)
    assert int(third.sum()) == 66
    with pytest.raises(InputError, match="no splat is selected"):
        select_mask(gaussians, Select(sphere=(9, 9, 9, 0.1)), frame)
    np.save(tmp_path / "short.npy", np.arange(5))
    with pytest.raises(InputError, match=r"whole numbers \[200\], got int64 \[5\]"):
        select_mask(gaussians, Select(labels=tmp_path / "short.npy"), frame)
    (tmp_path / "bad.npy").write_bytes(b"no")
    with pytest.raises(InputError, match="the NumPy file is damaged"):
        select_mask(gaussians, Select(labels=tmp_path / "bad.npy"), frame)


def test_inspect_splats_reports_and_draws(tmp_path: Path) -> None:
    points = np.concatenate([ball(3000, 1.0), ball(4, 0.05, (0, -4, 0))])
    save_splats(splats(points), tmp_path / "a.ply")
    report = inspect(tmp_path / "a.ply", tmp_path / "a.png", size=0.5)
    assert report["kind"] == "splats" and report["gaussians"] == 3004
    assert report["box"]["size"] == pytest.approx([0.5, 0.5, 0.5], rel=0.02)
    assert report["box"]["low"][2] == pytest.approx(0.0, abs=1e-9)
    assert report["scale"]["metres_per_unit"] == pytest.approx(0.25, rel=0.02)
    assert report["floaters"]["count"] == 4 and report["pieces"] == [
        pytest.approx(3000 / 3004, abs=1e-3)
    ]
    assert report["up"] == {"axis": [0.0, -1.0, 0.0], "from": "convention"}
    assert any("-y is assumed" in warning for warning in report["warnings"])
    picture = load_image(tmp_path / "a.png")
    assert picture.shape[1] == 880 and float(picture.std()) > 0.05
    magenta = torch.tensor([230.0, 0.0, 160.0]) / 255
    assert int(((picture - magenta).abs().amax(dim=2) < 0.02).sum()) > 20


def masked_capture(folder: Path) -> None:
    """Photographs of a red ball of radius 0.5 round (0, 0, 0.5), with alpha, no sparse points."""
    cameras = []
    (folder / "images").mkdir(parents=True)
    y, x = torch.meshgrid(torch.arange(64) + 0.5, torch.arange(64) + 0.5, indexing="ij")
    for index, angle in enumerate(np.linspace(0, 2 * math.pi, 10, endpoint=False)):
        eye = (3 * math.cos(angle), 3 * math.sin(angle), 0.5 + 1.5 * (index % 2))
        camera = Camera.look_at(eye, (0, 0, 0.5), width=64, height=64, name=f"{index}.png")
        # A ray meets the ball when its angle to the axis is below asin(radius / distance).
        focal = float(camera.K[0, 0])
        tangent = torch.hypot(x - 32, y - 32) / focal
        distance = float((camera.center() - torch.tensor([0, 0, 0.5]).double()).norm())
        hit = (torch.atan(tangent) < math.asin(0.5 / distance)).float()
        save_image(
            torch.stack([hit, 0 * hit, 0 * hit, hit], dim=-1), folder / "images" / camera.name
        )
        matrix = torch.linalg.inv(camera.viewmat)
        matrix[:3, 1:3] *= -1
        cameras.append({"file_path": f"images/{camera.name}", "transform_matrix": matrix.tolist()})
    data = {"w": 64, "h": 64, "fl_x": focal, "frames": cameras}
    (folder / "transforms.json").write_text(json.dumps(data))


def test_masks_tell_the_object_where_there_are_no_points(tmp_path: Path) -> None:
    masked_capture(tmp_path / "capture")
    report = inspect(tmp_path / "capture", tmp_path / "a.png")
    assert report["points"] == 0 and report["points_from"] == "masks"
    assert report["world_extent"] == pytest.approx(1.0, abs=0.1)
    assert report["up"]["axis"] == pytest.approx([0, 0, 1], abs=1e-3)
    assert report["floor"]["world"] == pytest.approx(0.0, abs=0.06)
    picture = load_image(tmp_path / "a.png")
    assert int(((picture[..., 0] > 0.9) & (picture[..., 1] < 0.1)).sum()) > 5000


def test_neither_points_nor_masks_is_said(tmp_path: Path) -> None:
    masked_capture(tmp_path)
    for file in (tmp_path / "images").iterdir():
        save_image(load_image(file), file)
    with pytest.raises(InputError, match="neither sparse points nor masks"):
        inspect(tmp_path)


def test_inspect_refuses_bad_input(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="size must be above 0"):
        inspect(tmp_path, size=0.0)
    with pytest.raises(InputError, match="no such capture"):
        inspect(tmp_path / "none")
    with pytest.raises(InputError, match="folder is empty"):
        inspect(tmp_path)


@pytest.mark.data
def test_apple_stands_on_its_table(data_root: Path, tmp_path: Path) -> None:
    report = inspect(data_root / "captures/apple", tmp_path / "a.png", size=0.08)
    assert report["up"]["from"] == "support plane" and report["floor"]["from"] == "support plane"
    wide, deep, tall = report["box"]["size"]
    assert (
        0.8 < wide / deep < 1.25 and 0.8 < tall / max(wide, deep) < 1.15
    )  # an apple is about as tall as wide
    assert (tmp_path / "a.png").is_file()


@pytest.mark.data
def test_skull_is_upright(data_root: Path) -> None:
    """Its own axes have y down already, so up must be close to -y."""
    stance = orient(None, load_capture(data_root / "captures/skull"))
    assert stance.up @ np.array([0.0, -1.0, 0.0]) > math.cos(math.radians(6))


@pytest.mark.data
def test_playbot_has_three_pieces_and_thin_hands(data_root: Path) -> None:
    report = inspect(data_root / "splats/playbot/playbot_robot_lod1_sh3.ply")
    assert len(report["pieces"]) == 3 and report["thin"]["parts"]
    frame = make_frame(load_splats(data_root / "splats/playbot/playbot_robot_lod1_sh3.ply"))
    assert frame.scale == pytest.approx(report["scale"]["metres_per_unit"], rel=0.01)
