"""The real captures: counts, reprojection, colours."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest
import torch

from gsfluent.io import load_capture


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
    """Read who saw what: image -> (points [M, 3], colours [M, 3], where seen [M, 2])."""
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
