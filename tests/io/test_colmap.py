"""COLMAP models, binary and text."""

from __future__ import annotations

import struct
from pathlib import Path

import capture_files as files
import pytest
import torch

from gsfluent.data import Camera
from gsfluent.errors import InputError
from gsfluent.io import load_capture

COLMAP_MODELS = [
    ("SIMPLE_PINHOLE", [35.0, 19.0, 16.0], (35.0, 35.0, 19.0, 16.0), ()),
    ("PINHOLE", [35.0, 36.0, 19.0, 16.0], (35.0, 36.0, 19.0, 16.0), ()),
    ("SIMPLE_RADIAL", [35.0, 19.0, 16.0, 0.05], (35.0, 35.0, 19.0, 16.0), (0.05, 0, 0, 0)),
    ("RADIAL", [35.0, 19.0, 16.0, 0.05, -0.02], (35.0, 35.0, 19.0, 16.0), (0.05, -0.02, 0, 0)),
    (
        "OPENCV",
        [35.0, 36.0, 19.0, 16.0, 0.05, -0.02, 0.001, 0.002],
        (35.0, 36.0, 19.0, 16.0),
        (0.05, -0.02, 0.001, 0.002),
    ),
    ("OPENCV", [35.0, 36.0, 19.0, 16.0, 0, 0, 0, 0], (35.0, 36.0, 19.0, 16.0), ()),
    ("FULL_OPENCV", [35.0, 36.0, 19.0, 16.0, *[0.01] * 8], (35.0, 36.0, 19.0, 16.0), (0.01,) * 8),
]


@pytest.fixture
def cameras() -> list[Camera]:
    return files.ring()


@pytest.mark.parametrize("text", [False, True], ids=["binary", "text"])
@pytest.mark.parametrize(("model", "params", "focal", "distortion"), COLMAP_MODELS)
def test_colmap_models(
    tmp_path: Path,
    cameras: list[Camera],
    text: bool,
    model: str,
    params: list[float],
    focal: tuple[float, ...],
    distortion: tuple[float, ...],
) -> None:
    files.write_images(tmp_path / "images", cameras)
    files.write_colmap(tmp_path / "sparse/0", cameras, model, params, text)
    capture = load_capture(tmp_path)
    files.assert_same_poses(capture, cameras)
    first = capture.cameras[0]
    assert (first.K[0, 0], first.K[1, 1], first.K[0, 2], first.K[1, 2]) == focal
    assert first.distortion == distortion and (first.width, first.height) == (40, 30)
    assert first.image_path == tmp_path / "images/0.png"
    torch.testing.assert_close(
        capture.points[0], torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)
    )
    assert capture.point_colors[1].tolist() == pytest.approx([0.0, 0.2, 1.0])


@pytest.mark.parametrize("place", ["sparse", "colmap/sparse/0", "."])
def test_colmap_model_is_found_in_the_usual_places(
    tmp_path: Path, cameras: list[Camera], place: str
) -> None:
    files.write_images(tmp_path / "images", cameras)
    files.write_colmap(tmp_path / place, cameras, "PINHOLE", [35.0, 36.0, 20.0, 15.0])
    assert len(load_capture(tmp_path)) == 4


def test_passing_the_model_folder_finds_the_images_above(
    tmp_path: Path, cameras: list[Camera]
) -> None:
    files.write_images(tmp_path / "images", cameras)
    files.write_colmap(tmp_path / "sparse/0", cameras, "PINHOLE", [35.0, 36.0, 20.0, 15.0])
    assert load_capture(tmp_path / "sparse/0").cameras[0].image_path == tmp_path / "images/0.png"


def test_fisheye_names_the_supported_models(tmp_path: Path, cameras: list[Camera]) -> None:
    files.write_images(tmp_path / "images", cameras)
    files.write_colmap(
        tmp_path / "sparse/0", cameras, "OPENCV_FISHEYE", [35.0, 36.0, 20.0, 15.0, 0, 0, 0, 0]
    )
    with pytest.raises(InputError, match="camera model OPENCV_FISHEYE is not supported") as caught:
        load_capture(tmp_path)
    assert "SIMPLE_RADIAL" in caught.value.hint and "cameras.bin" in caught.value.what


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
@pytest.mark.parametrize("share", [0.0, 0.3, 0.6, 0.9])
def test_truncated_colmap_files_are_named(
    tmp_path: Path, cameras: list[Camera], name: str, share: float
) -> None:
    files.write_images(tmp_path / "images", cameras)
    files.write_colmap(tmp_path / "sparse/0", cameras, "PINHOLE", [35.0, 36.0, 20.0, 15.0])
    path = tmp_path / "sparse/0" / name
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(InputError, match=name):
        load_capture(tmp_path)


def test_absurd_count_does_not_allocate(tmp_path: Path, cameras: list[Camera]) -> None:
    files.write_images(tmp_path / "images", cameras)
    files.write_colmap(tmp_path / "sparse/0", cameras, "PINHOLE", [35.0, 36.0, 20.0, 15.0])
    (tmp_path / "sparse/0/points3D.bin").write_bytes(struct.pack("<Q", 2**60) + b"\0" * 100)
    with pytest.raises(InputError, match="announces"):
        load_capture(tmp_path)


def test_damaged_text_model_is_said(tmp_path: Path, cameras: list[Camera]) -> None:
    files.write_images(tmp_path / "images", cameras)
    files.write_colmap(
        tmp_path / "sparse/0", cameras, "PINHOLE", [35.0, 36.0, 20.0, 15.0], text=True
    )
    path = tmp_path / "sparse/0/images.txt"
    path.write_text(path.read_text().replace("1 0.png", "one 0.png"))
    with pytest.raises(InputError, match="are not numbers"):
        load_capture(tmp_path)


def test_pose_that_is_no_number_names_the_image(tmp_path: Path, cameras: list[Camera]) -> None:
    files.write_images(tmp_path / "images", cameras)
    files.write_colmap(
        tmp_path / "sparse/0", cameras, "PINHOLE", [35.0, 36.0, 20.0, 15.0], text=True
    )
    path = tmp_path / "sparse/0/images.txt"
    lines = path.read_text().splitlines()
    lines[1] = "1 nan 0 0 0 0 0 0 1 0.png"
    path.write_text("\n".join(lines))
    with pytest.raises(InputError, match=r"pose of 0\.png is not a number"):
        load_capture(tmp_path)


def test_missing_image_is_named(tmp_path: Path, cameras: list[Camera]) -> None:
    files.write_images(tmp_path / "images", cameras)
    files.write_colmap(tmp_path / "sparse/0", cameras, "PINHOLE", [35.0, 36.0, 20.0, 15.0])
    (tmp_path / "images/2.png").unlink()
    with pytest.raises(InputError, match=r"1 of 4 posed images are missing, first 2\.png"):
        load_capture(tmp_path)


def test_image_without_camera_is_said(tmp_path: Path, cameras: list[Camera]) -> None:
    files.write_images(tmp_path / "images", cameras)
    files.write_colmap(
        tmp_path / "sparse/0", cameras, "PINHOLE", [35.0, 36.0, 20.0, 15.0], text=True
    )
    path = tmp_path / "sparse/0/cameras.txt"
    path.write_text(path.read_text().replace("1 PINHOLE", "7 PINHOLE"))
    with pytest.raises(InputError, match="uses camera 1, which"):
        load_capture(tmp_path)
