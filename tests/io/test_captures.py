"""COLMAP models, transforms.json, masks, images."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Callable
from pathlib import Path

import capture_files as files
import numpy as np
import pytest
import torch

from gsfluent.data import Camera, Capture
from gsfluent.errors import InputError
from gsfluent.io import load_capture, save_image
from gsfluent.io.images import image_size, load_image, undistorted

COLMAP_MODELS = [
    ("SIMPLE_PINHOLE", [35.0, 19.0, 16.0], (35.0, 35.0, 19.0, 16.0), ()),
    ("PINHOLE", [35.0, 36.0, 19.0, 16.0], (35.0, 36.0, 19.0, 16.0), ()),
    ("SIMPLE_RADIAL", [35.0, 19.0, 16.0, 0.05], (35.0, 35.0, 19.0, 16.0), (0.05, 0, 0, 0)),
    ("RADIAL", [35.0, 19.0, 16.0, 0.05, -0.02], (35.0, 35.0, 19.0, 16.0), (0.05, -0.02, 0, 0)),
    ("OPENCV", [35.0, 36.0, 19.0, 16.0, 0.05, -0.02, 0.001, 0.002], (35.0, 36.0, 19.0, 16.0), (0.05, -0.02, 0.001, 0.002)),
    ("OPENCV", [35.0, 36.0, 19.0, 16.0, 0, 0, 0, 0], (35.0, 36.0, 19.0, 16.0), ()),
    ("FULL_OPENCV", [35.0, 36.0, 19.0, 16.0, *[0.01] * 8], (35.0, 36.0, 19.0, 16.0), (0.01,) * 8),
]  # fmt: skip


@pytest.fixture
def cameras() -> list[Camera]:
    return files.ring()


def assert_same_poses(capture: Capture, cameras: list[Camera]) -> None:
    assert len(capture) == len(cameras)
    for loaded, expected in zip(capture.cameras, cameras, strict=True):
        torch.testing.assert_close(loaded.viewmat, expected.viewmat, atol=1e-9, rtol=0)


# COLMAP --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("text", [False, True], ids=["binary", "text"])
@pytest.mark.parametrize(("model", "params", "focal", "distortion"), COLMAP_MODELS)
def test_colmap_models(
    tmp_path: Path, cameras: list[Camera], text: bool, model: str, params: list[float], focal: tuple[float, ...],
    distortion: tuple[float, ...],
) -> None:  # fmt: skip
    files.write_images(tmp_path / "images", cameras)
    files.write_colmap(tmp_path / "sparse/0", cameras, model, params, text)
    capture = load_capture(tmp_path)
    assert_same_poses(capture, cameras)
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
    assert "SIMPLE_RADIAL" in caught.value.mend and "cameras.bin" in caught.value.what


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


# transforms.json -----------------------------------------------------------------------------------------------------


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
    assert_same_poses(capture, cameras)
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
    assert_same_poses(capture, cameras)
    torch.testing.assert_close(
        capture.cameras[0].K, torch.tensor([[35.0, 0, 20], [0, 35, 15], [0, 0, 1]]).double()
    )
    assert capture.cameras[3].image_path == tmp_path / "images/3.png"


def test_sparse_points_of_transforms(tmp_path: Path, cameras: list[Camera]) -> None:
    files.write_images(tmp_path / "images", cameras)
    body = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n"
    body += "property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n1 2 3 255 0 51\nnan 0 0 0 0 0\n"
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
    assert caught.value.mend and str(tmp_path) in caught.value.what


def test_json_that_is_none_is_said(tmp_path: Path) -> None:
    (tmp_path / "transforms.json").write_text('{"frames": [')
    with pytest.raises(InputError, match="not readable as JSON"):
        load_capture(tmp_path)
    (tmp_path / "transforms.json").write_text("[1]")
    with pytest.raises(InputError, match="must hold a JSON object"):
        load_capture(tmp_path)


# Folders without a capture -------------------------------------------------------------------------------------------


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
    assert "colmap" in caught.value.mend


# Images and masks ----------------------------------------------------------------------------------------------------


def write_simple(
    folder: Path, cameras: list[Camera], alpha: bool = False, **shared: object
) -> Capture:
    files.write_images(folder / "images", cameras, alpha=alpha)
    files.write_transforms(
        folder / "transforms.json", cameras, {"fl_x": 35.0, "w": 40, "h": 30, **shared}
    )
    return load_capture(folder)


def test_image_is_resized_with_its_intrinsics(tmp_path: Path, cameras: list[Camera]) -> None:
    image, mask, camera = write_simple(tmp_path, cameras).image(1, max_size=20)
    assert image.shape == (15, 20, 3) and image.dtype == torch.float32 and mask is None
    assert float(image[0, 0, 0]) == pytest.approx(200 / 255, abs=1e-3)
    assert float(image[0, -1, 0]) == pytest.approx(50 / 255, abs=1e-3)
    torch.testing.assert_close(
        camera.K, torch.tensor([[17.5, 0, 10], [0, 17.5, 7.5], [0, 0, 1]]).double()
    )


def test_image_smaller_than_its_camera_scales_the_camera(
    tmp_path: Path, cameras: list[Camera]
) -> None:
    _, _, camera = write_simple(tmp_path, cameras, w=80, h=60, fl_x=70.0).image(0)
    assert (camera.width, camera.height) == (40, 30) and float(camera.K[0, 0]) == 35.0


def test_cropped_image_is_refused(tmp_path: Path, cameras: list[Camera]) -> None:
    capture = write_simple(tmp_path, cameras, w=40, h=40)
    with pytest.raises(InputError, match="the image is 40 x 30, but its camera describes 40 x 40"):
        capture.image(0)


def test_alpha_channel_is_the_mask(tmp_path: Path, cameras: list[Camera]) -> None:
    image, mask, _ = write_simple(tmp_path, cameras, alpha=True).image(0)
    assert image.shape == (30, 40, 3) and mask is not None
    assert float(mask[10, 20]) == 1.0 and float(mask[0, 0]) == 0.0 and float(mask.sum()) == 15 * 22


@pytest.mark.parametrize("name", ["0.png", "0.png.png", "0.jpg"])
def test_masks_folder_in_its_spellings(tmp_path: Path, cameras: list[Camera], name: str) -> None:
    white = torch.zeros(30, 40)
    white[:10] = 1.0
    (tmp_path / "masks").mkdir()
    save_image(white, tmp_path / "masks" / name)
    capture = write_simple(tmp_path, cameras)
    assert capture.has_masks and capture.cameras[1].mask_path is None
    _, mask, _ = capture.image(0)
    assert mask is not None and float(mask.mean()) == pytest.approx(1 / 3, abs=0.01)


def test_mask_path_of_a_frame(tmp_path: Path, cameras: list[Camera]) -> None:
    files.write_images(tmp_path / "images", cameras)
    save_image(torch.ones(30, 40), tmp_path / "m.png")
    frames = [{"mask_path": "m.png"}] * 4
    files.write_transforms(
        tmp_path / "transforms.json", cameras, {"fl_x": 35.0, "w": 40, "h": 30}, frames
    )
    _, mask, _ = load_capture(tmp_path).image(2)
    assert mask is not None and float(mask.min()) == 1.0


def test_truncated_image_names_the_file(tmp_path: Path, cameras: list[Camera]) -> None:
    capture = write_simple(tmp_path, cameras)
    path = tmp_path / "images/1.png"
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match=r"1\.png: the image is damaged") as caught:
        capture.image(1)
    assert caught.value.mend
    path.write_bytes(b"not an image")
    with pytest.raises(InputError, match="not an image that Pillow can read"):
        capture.image(1)
    with pytest.raises(InputError, match="not an image that Pillow can read"):
        image_size(path)
    path.unlink()
    with pytest.raises(InputError, match="no such image"):
        capture.image(1)


def test_view_refuses_nonsense_sizes_and_cameras(tmp_path: Path, cameras: list[Camera]) -> None:
    capture = write_simple(tmp_path, cameras)
    with pytest.raises(ValueError, match="max_size must be at least 1"):
        capture.image(0, max_size=0)
    with pytest.raises(ValueError, match="has no image"):
        capture.replace(cameras=[cameras[0]]).image(0)


@pytest.mark.parametrize("mode", ["L", "RGB", "RGBA", "P", "1", "I;16", "CMYK"])
def test_every_pillow_mode_reads_as_rgb(tmp_path: Path, mode: str) -> None:
    from PIL import Image

    white = 65535 if mode == "I;16" else 255
    image = (
        Image.new(mode, (6, 4), white)
        if mode in ("L", "1", "I;16")
        else Image.new("RGB", (6, 4), (255,) * 3).convert(mode)
    )
    image.save(tmp_path / ("a.tif" if mode == "CMYK" else "a.png"))
    pixels = load_image(tmp_path / ("a.tif" if mode == "CMYK" else "a.png"))
    assert pixels.shape == (4, 6, 3) and float(pixels.min()) > 0.99


def test_save_image_round_trip_and_shape(tmp_path: Path) -> None:
    image = torch.rand(5, 7, 3)
    save_image(image, tmp_path / "a.png")
    torch.testing.assert_close(load_image(tmp_path / "a.png"), image, atol=0.5 / 255 + 1e-6, rtol=0)
    with pytest.raises(ValueError, match="must have shape"):
        save_image(torch.rand(3, 5, 7), tmp_path / "b.png")


@pytest.mark.parametrize("k1", [-0.2, 0.1, 0.3])
def test_undistortion_puts_features_where_the_pinhole_says(tmp_path: Path, k1: float) -> None:
    """Draw dots with the lens model, undistort, find them where the pinhole camera projects the same points."""
    camera = Camera.look_at(
        (0.0, 0.0, -2.0), (0.0, 0.0, 0.0), width=200, height=160, fov=50, up=(0.0, -1.0, 0.0)
    )
    camera = camera.replace(
        distortion=(k1, 0.02, 0.003, -0.002), image_path=tmp_path / "a.png", name="a.png"
    )
    axis = torch.linspace(-0.6, 0.6, 5, dtype=torch.float64)
    across, down = torch.meshgrid(axis, axis, indexing="xy")
    points = torch.stack(
        [across.flatten(), down.flatten(), torch.zeros(25, dtype=torch.float64)], dim=1
    )
    pixels, _ = camera.project(points)
    y, x = torch.meshgrid(torch.arange(160) + 0.5, torch.arange(200) + 0.5, indexing="ij")
    image = torch.zeros(160, 200)
    for column, row in pixels:
        image += torch.exp(-((x - column) ** 2 + (y - row) ** 2) / (2 * 2.0**2)).float()
    save_image(image.clamp(0, 1), tmp_path / "a.png")
    capture = Capture([camera], torch.zeros(0, 3), torch.zeros(0, 3), tmp_path)
    view = capture.view(0)
    assert view.valid is None and view.camera.distortion == ()
    expected, _ = view.camera.project(points)
    inside = (expected > 8).all(dim=1) & (expected[:, 0] < 192) & (expected[:, 1] < 152)
    assert int(inside.sum()) >= 9
    for column, row in expected[inside]:
        near = ((x - column).abs() < 6) & ((y - row).abs() < 6)
        weight = view.image[..., 0] * near
        found = torch.stack([(weight * x).sum(), (weight * y).sum()]) / weight.sum()
        assert float((found - torch.stack([column, row])).abs().max()) < 0.1


def test_undistorted_camera_covers_only_what_was_photographed() -> None:
    camera = files.ring(1, 200, 160)[0].replace(distortion=(0.4, 0.0, 0.0, 0.0))
    assert float(undistorted(camera).K[0, 0]) > float(camera.K[0, 0])
    barrel = camera.replace(distortion=(-0.1, 0.0, 0.0, 0.0))
    torch.testing.assert_close(undistorted(barrel).K, camera.K)


# Real captures -------------------------------------------------------------------------------------------------------


@pytest.mark.data
@pytest.mark.parametrize(("name", "count", "points"), [
    ("apple", 17, 8422), ("skull", 58, 7999), ("plush_dog", 73, 29008), ("fox", 44, 14972),
])  # fmt: skip
def test_real_captures_load(data_root: Path, name: str, count: int, points: int) -> None:
    capture = load_capture(data_root / "captures" / name)
    assert len(capture) == count and len(capture.points) == points
    image, _, camera = capture.image(0, max_size=200)
    assert image.shape == (camera.height, camera.width, 3) and max(image.shape[:2]) == 200


def observations(folder: Path) -> dict[str, tuple[torch.Tensor, torch.Tensor, torch.Tensor]]:
    """Read who saw what: image name -> (points [M, 3], their colours [M, 3], where they were seen [M, 2])."""
    points, data, offset = {}, (folder / "sparse/0/points3D.bin").read_bytes(), 8
    for _ in range(struct.unpack_from("<Q", data)[0]):
        number, *values = struct.unpack_from("<Q3d3B", data, offset)
        points[number] = values
        offset += 43 + 8 + 8 * struct.unpack_from("<Q", data, offset + 43)[0]
    found, data, offset = {}, (folder / "sparse/0/images.bin").read_bytes(), 8
    for _ in range(struct.unpack_from("<Q", data)[0]):
        offset += 64
        end = data.index(b"\0", offset)
        (count,) = struct.unpack_from("<Q", data, end + 1)
        kind = [("xy", "<f8", 2), ("point", "<i8")]
        rows = np.frombuffer(data, dtype=kind, count=count, offset=end + 9)
        rows = rows[[number in points for number in rows["point"]]]
        table = torch.tensor([points[number] for number in rows["point"]], dtype=torch.float64)
        seen = torch.from_numpy(rows["xy"].copy())
        found[data[offset:end].decode()] = (table[:, :3], table[:, 3:].float() / 255, seen)
        offset = end + 9 + 24 * count
    return found


@pytest.mark.data
@pytest.mark.parametrize("name", ["apple", "skull"])
def test_colmap_and_transforms_of_one_capture_agree(data_root: Path, name: str) -> None:
    folder = data_root / "captures" / name
    first, second = load_capture(folder), load_capture(folder / "transforms.json")
    for left, right in zip(first.cameras, second.cameras, strict=True):
        torch.testing.assert_close(left.viewmat, right.viewmat, atol=1e-6, rtol=0)
        torch.testing.assert_close(left.K, right.K, atol=1e-3, rtol=0)
        assert left.distortion == pytest.approx(right.distortion, abs=1e-9)
    left, right = (np.sort(c.points[:, 0].numpy()) for c in (first, second))
    assert np.abs(left - right).max() < 1e-5  # the two files list the points in another order


@pytest.mark.data
@pytest.mark.parametrize("name", ["apple", "skull"])
def test_reprojection_error_is_that_of_the_measurement(data_root: Path, name: str) -> None:
    """Project each 3D point into the images that saw it: the mean must be what check.json says."""
    folder = data_root / "captures" / name
    capture = load_capture(folder)
    wanted = json.loads((folder / "check.json").read_text())["mean_reproj_px_800"]
    place = {camera.name: camera for camera in capture.cameras}
    errors = []
    for image, (points, _, seen) in observations(folder).items():
        pixels, depth = place[image].project(points)
        assert float(depth.min()) > 0
        errors.append((pixels - seen).norm(dim=1))
    assert float(torch.cat(errors).mean()) == pytest.approx(wanted, rel=0.25)


@pytest.mark.data
@pytest.mark.parametrize("name", ["apple", "skull"])
def test_points_land_on_pixels_of_their_color(data_root: Path, name: str) -> None:
    """In undistorted views points match their pixels, and far better than 25 pixels off."""
    folder = data_root / "captures" / name
    capture, seen = load_capture(folder), observations(folder)
    near, shifted = [], []
    for index in range(0, len(capture), 8):
        points, colors, _ = seen[capture.cameras[index].name]
        image, _, camera = capture.image(index)
        pixels, _ = camera.project(points)
        for shift, errors in ((0, near), (25, shifted)):
            place = (pixels + shift).floor().long()
            inside = ((place >= 0) & (place < torch.tensor([camera.width, camera.height]))).all(1)
            found = image[place[inside, 1], place[inside, 0]]
            errors.append((found - colors[inside]).abs().mean(dim=1))
    assert float(torch.cat(near).mean()) < 0.5 * float(torch.cat(shifted).mean())
