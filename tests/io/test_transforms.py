"""transforms.json in its flavours, and folders without a capture."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path

import capture_files as files
import numpy as np
import pytest
import torch

from gsfluent.data import Camera
from gsfluent.errors import InputError
from gsfluent.io import load_capture


@pytest.fixture
def cameras() -> list[Camera]:
    return files.ring()


def test_nerfstudio_flavour(tmp_path: Path, cameras: list[Camera]) -> None:
    files.write_images(tmp_path / "images", cameras)
    shared = {
        "camera_model": "OPENCV",
        "w": 40,
        "h": 30,
        "fl_x": 35.0,
        "fl_y": 36.0,
        "cx": 19.0,
        "cy": 16.0,
        "k1": 0.05,
    }
    files.write_transforms(tmp_path / "transforms.json", cameras, shared)
    capture = load_capture(tmp_path / "transforms.json")
    files.assert_same_poses(capture, cameras)
    assert capture.cameras[0].K.tolist() == [[35.0, 0.0, 19.0], [0.0, 36.0, 16.0], [0.0, 0.0, 1.0]]
    assert capture.cameras[0].distortion == (0.05, 0.0, 0.0, 0.0) and len(capture.points) == 0


def test_intrinsics_per_frame_win(tmp_path: Path, cameras: list[Camera]) -> None:
    files.write_images(tmp_path / "images", cameras)
    frames = [{"fl_x": 30.0 + i, "fl_y": 30.0 + i, "w": 40, "h": 30} for i in range(4)]
    files.write_transforms(tmp_path / "transforms.json", cameras, {"fl_x": 99.0}, frames)
    assert [float(camera.K[0, 0]) for camera in load_capture(tmp_path).cameras] == [
        30.0,
        31.0,
        32.0,
        33.0,
    ]


def test_instant_ngp_flavour_without_size_and_extension(
    tmp_path: Path, cameras: list[Camera]
) -> None:
    files.write_images(tmp_path / "images", cameras)
    frames = [{"file_path": f"./images/{i}"} for i in range(4)]
    shared = {
        "camera_angle_x": 2 * math.atan(20 / 35.0),
        "aabb_scale": 4,
        "scale": 0.33,
        "offset": [0.5, 0.5, 0.5],
    }
    files.write_transforms(tmp_path / "transforms.json", cameras, shared, frames)
    capture = load_capture(tmp_path)
    files.assert_same_poses(capture, cameras)
    torch.testing.assert_close(
        capture.cameras[0].K, torch.tensor([[35.0, 0, 20], [0, 35, 15], [0, 0, 1]]).double()
    )
    assert capture.cameras[3].image_path == tmp_path / "images/3.png"


def test_sparse_points_of_transforms(tmp_path: Path, cameras: list[Camera]) -> None:
    files.write_images(tmp_path / "images", cameras)
    body = "ply\nformat ascii 1.0\nelement vertex 2\n"
    body += "property float x\nproperty float y\nproperty float z\n"
    body += "property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n"
    body += "1 2 3 255 0 51\nnan 0 0 0 0 0\n"
    (tmp_path / "points.ply").write_text(body)
    shared = {"fl_x": 35.0, "w": 40, "h": 30, "ply_file_path": "points.ply"}
    files.write_transforms(tmp_path / "transforms.json", cameras, shared)
    capture = load_capture(tmp_path)
    assert capture.points.tolist() == [[1.0, 2.0, 3.0]]
    assert capture.point_colors.tolist()[0] == pytest.approx([1.0, 0.0, 0.2])


def _edit_frame(**change: object) -> Callable[[dict], None]:  # type: ignore[type-arg]
    return lambda data: data["frames"][1].update(change)


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda d: d.pop("frames"), "'frames' must be a list"),
        (lambda d: d["frames"].clear(), "at least one frame"),
        (
            lambda d: d["frames"][1].pop("transform_matrix"),
            r"frames\[1\] \(images/1.png\) has no pose",
        ),
        (lambda d: d["frames"][1].pop("file_path"), r"frames\[1\] has no file_path"),
        (_edit_frame(transform_matrix=[[1, 2], [3, 4]]), "transform_matrix must be 4 x 4"),
        (
            _edit_frame(transform_matrix=[[math.nan] * 4] * 4),
            "transform_matrix must be 4 x 4 finite",
        ),
        (_edit_frame(transform_matrix=[["a"] * 4] * 4), "transform_matrix must be 4 x 4"),
        (_edit_frame(transform_matrix=(2 * np.eye(4)).tolist()), "must hold a rotation"),
        (
            _edit_frame(file_path="images/99.png"),
            r"1 of 4 images are missing, first images/99\.png",
        ),
        (_edit_frame(mask_path="masks/none.png"), "mask masks/none.png is missing"),
        (
            lambda d: d.update(camera_model="EQUIRECTANGULAR"),
            "camera model EQUIRECTANGULAR is not supported",
        ),
        (lambda d: d.update(is_fisheye=True), "camera model fisheye is not supported"),
        (lambda d: d.update(k4=0.1), "k4 is not supported"),
        (lambda d: d.pop("fl_x"), "no focal length"),
        (
            lambda d: (d.pop("fl_x"), d.update(camera_angle_x=9.0)),
            "camera_angle_x must lie between 0 and pi",
        ),
        (lambda d: d.update(fl_x="wide"), "fl_x must be a finite number, got 'wide'"),
        (lambda d: d.update(ply_file_path="none.ply"), r"none\.ply: no such file"),
    ],
)
def test_bad_transforms_are_named(
    tmp_path: Path,
    cameras: list[Camera],
    edit: Callable[[dict], None],
    message: str,  # type: ignore[type-arg]
) -> None:
    files.write_images(tmp_path / "images", cameras)
    path = tmp_path / "transforms.json"
    files.write_transforms(path, cameras, {"fl_x": 35.0, "w": 40, "h": 30})
    data = json.loads(path.read_text())
    edit(data)
    path.write_text(json.dumps(data))
    with pytest.raises(InputError, match=message) as caught:
        load_capture(tmp_path)
    assert caught.value.hint and str(tmp_path) in caught.value.what


def test_json_that_is_none_is_said(tmp_path: Path) -> None:
    (tmp_path / "transforms.json").write_text('{"frames": [')
    with pytest.raises(InputError, match="not readable as JSON"):
        load_capture(tmp_path)
    (tmp_path / "transforms.json").write_text("[1]")
    with pytest.raises(InputError, match="must hold a JSON object"):
        load_capture(tmp_path)


def test_folders_without_poses_say_what_they_hold(tmp_path: Path, cameras: list[Camera]) -> None:
    with pytest.raises(InputError, match="no such capture"):
        load_capture(tmp_path / "nowhere")
    with pytest.raises(InputError, match="capture folder is empty"):
        load_capture(tmp_path)
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(InputError, match="no COLMAP model and no transforms"):
        load_capture(tmp_path)
    with pytest.raises(InputError, match="must be a folder or a transforms"):
        load_capture(tmp_path / "notes.txt")
    files.write_images(tmp_path / "images", cameras)
    with pytest.raises(InputError, match="4 images but no poses") as caught:
        load_capture(tmp_path)
    assert "gsfluent poses" in caught.value.hint
