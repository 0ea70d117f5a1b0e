"""Photographs and masks."""

from __future__ import annotations

from pathlib import Path

import capture_files as files
import pytest
import torch

from gsfluent.data import Camera, Capture
from gsfluent.errors import InputError
from gsfluent.io import load_capture, save_image
from gsfluent.io.images import image_size, load_image, load_view, undistorted


@pytest.fixture
def cameras() -> list[Camera]:
    return files.ring()


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
    assert caught.value.hint
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
    """Dots drawn with the lens model are found, undistorted, where the pinhole projects them."""
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
    capture = Capture([camera], torch.zeros(0, 3), torch.zeros(0, 3), tmp_path, load_view)
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
