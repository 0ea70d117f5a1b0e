"""Writers of small captures for tests: COLMAP binary and text, transforms.json, images."""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from gsfluent import geometry
from gsfluent.data import Camera, Capture

MODEL_IDS = {
    "SIMPLE_PINHOLE": 0, "PINHOLE": 1, "SIMPLE_RADIAL": 2, "RADIAL": 3, "OPENCV": 4,
    "OPENCV_FISHEYE": 5, "FULL_OPENCV": 6,
}  # fmt: skip
POINTS = [((0.1, 0.2, 0.3), (255, 0, 0)), ((-0.1, 0.0, 0.2), (0, 51, 255))]


def ring(count: int = 4, width: int = 40, height: int = 30) -> list[Camera]:
    """Cameras on a circle looking at the origin."""
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return [
        Camera.look_at(
            (3 * np.cos(a), 3 * np.sin(a), 1.0),
            (0, 0, 0),
            width=width,
            height=height,
            name=f"{i}.png",
        )
        for i, a in enumerate(angles)
    ]


def write_images(
    folder: Path, cameras: Sequence[Camera], names: Sequence[str] | None = None, alpha: bool = False
) -> None:
    from PIL import Image

    folder.mkdir(parents=True, exist_ok=True)
    for index, camera in enumerate(cameras):
        pixels = np.full(
            (camera.height, camera.width, 4 if alpha else 3), 50 * index, dtype=np.uint8
        )
        pixels[:, : camera.width // 2, 0] = 200
        if alpha:
            pixels[..., 3] = 0
            pixels[5:20, 8:30, 3] = 255
        file = folder / (names[index] if names else camera.name)
        file.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(pixels).save(file)


def pose_of(camera: Camera) -> tuple[list[float], list[float]]:
    quat = geometry.matrix_to_quaternion(camera.viewmat[:3, :3])
    return quat.tolist(), camera.viewmat[:3, 3].tolist()


def write_colmap(
    folder: Path, cameras: Sequence[Camera], model: str, params: Sequence[float], text: bool = False
) -> None:
    """Write one shared camera, the images and two points."""
    folder.mkdir(parents=True, exist_ok=True)
    width, height = cameras[0].width, cameras[0].height
    if text:
        numbers = " ".join(map(repr, params))
        (folder / "cameras.txt").write_text(f"# comment\n1 {model} {width} {height} {numbers}\n")
        lines = ["# two lines each"]
        for index, camera in enumerate(cameras):
            quat, shift = pose_of(camera)
            lines += [
                f"{index + 1} {' '.join(map(repr, quat + shift))} 1 {camera.name}",
                "1.0 2.0 -1" if index else "",
            ]
        (folder / "images.txt").write_text("\n".join(lines) + "\n")
        rows = [
            f"{i} {' '.join(map(str, (*xyz, *rgb)))} 0.5 1 2" for i, (xyz, rgb) in enumerate(POINTS)
        ]
        (folder / "points3D.txt").write_text("\n".join(rows) + "\n")
        return
    data = struct.pack("<QiiQQ", 1, 1, MODEL_IDS[model], width, height) + struct.pack(
        f"<{len(params)}d", *params
    )
    (folder / "cameras.bin").write_bytes(data)
    data = struct.pack("<Q", len(cameras))
    for index, camera in enumerate(cameras):
        quat, shift = pose_of(camera)
        data += struct.pack("<I7dI", index + 1, *quat, *shift, 1) + camera.name.encode() + b"\0"
        data += struct.pack("<Q", index) + index * struct.pack("<ddq", 1.0, 2.0, -1)
    (folder / "images.bin").write_bytes(data)
    data = struct.pack("<Q", len(POINTS))
    for index, (xyz, rgb) in enumerate(POINTS):
        data += struct.pack("<Q3d3Bd", index, *xyz, *rgb, 0.5) + struct.pack("<QII", 1, 1, 0)
    (folder / "points3D.bin").write_bytes(data)


def opengl_matrix(camera: Camera) -> list[list[float]]:
    """Camera-to-world with OpenGL axes."""
    matrix = torch.linalg.inv(camera.viewmat)
    matrix[:3, 1:3] *= -1
    return matrix.tolist()


def write_transforms(
    path: Path, cameras: Sequence[Camera], shared: dict, frames: Sequence[dict] | None = None
) -> None:  # type: ignore[type-arg]
    rows = []
    for index, camera in enumerate(cameras):
        rows.append(
            {"file_path": f"images/{camera.name}", "transform_matrix": opengl_matrix(camera)}
        )
        if frames:
            rows[-1].update(frames[index])
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({**shared, "frames": rows}))


def assert_same_poses(capture: Capture, cameras: list[Camera]) -> None:
    assert len(capture) == len(cameras)
    for loaded, expected in zip(capture.cameras, cameras, strict=True):
        torch.testing.assert_close(loaded.viewmat, expected.viewmat, atol=1e-9, rtol=0)
