"""``transforms.json`` as nerfstudio, instant-ngp and the NeRF synthetic scenes write it.

Poses there are camera-to-world with OpenGL axes (+y up, looking along -z); they are turned to
OpenCV here and nowhere else.
"""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsfluent.data.camera import Camera
from gsfluent.data.capture import Capture
from gsfluent.errors import InputError, short
from gsfluent.io.checked.files import is_file, read_json
from gsfluent.io.checked.inside import inside
from gsfluent.io.checked.pictures import check_pixels
from gsfluent.io.colmap import find_mask, is_lens
from gsfluent.io.images import IMAGE_SUFFIXES, image_size, load_view
from gsfluent.io.splats.ply import read_ply

_LENSES = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
_LARGE = 1e30
"""No number of a capture is beyond; a float32 still holds it, and its square a float64."""
_RIGID_TOLERANCE = 1e-3
"""How far a rotation may be from orthonormal: files round to a few digits."""


def read_transforms(path: Path) -> Capture:
    """Read a ``transforms.json``.

    Understood: intrinsics for the whole file or per frame (``fl_x``/``fl_y``,
    ``camera_angle_x``/``_y``, ``cx``, ``cy``, ``w``, ``h``, ``k1``..``k3``, ``p1``, ``p2``), image
    paths without extension, ``mask_path``, ``masks/``, ``ply_file_path``.

    Raises:
        InputError: Not JSON, no frames, a frame without pose or image, an unsupported lens.
    """
    return capture_of(path, _read_json(path), path.parent)


def capture_of(path: Path, data: dict[str, Any], folder: Path) -> Capture:
    """The capture that the values of a ``transforms.json`` say.

    Args:
        path: Where they come from, for messages.
        data: The values.
        folder: That the names in them start from.

    Raises:
        InputError: As :func:`read_transforms`.
    """
    frames = _frames(path, data)
    cameras = [_camera(path, data, frame, index, folder) for index, frame in enumerate(frames)]
    cameras.sort(key=lambda camera: camera.name)
    missing = [
        camera for camera in cameras if camera.image_path is None or not is_file(camera.image_path)
    ]
    if missing:
        first = missing[0].name
        raise InputError(
            f"{path}: {len(missing)} of {len(cameras)} images are missing, first {first}",
            "restore the images, or delete these frames from the file",
        )
    points, colors = _points(path, data, folder)
    return Capture(cameras, points, colors, folder, load_view)


def read_poses(path: Path) -> list[Camera]:
    """Read the cameras of a ``transforms.json`` in its order; the images need not be there.

    Raises:
        InputError: Not JSON, no frames, a frame without pose or size, an unsupported lens.
    """
    data = _read_json(path)
    frames = [
        {"file_path": str(index)} | frame if isinstance(frame, dict) else frame
        for index, frame in enumerate(_frames(path, data))
    ]
    return [_camera(path, data, frame, index, path.parent) for index, frame in enumerate(frames)]


def _frames(path: Path, data: dict[str, Any]) -> list[Any]:
    frames = data.get("frames")
    if not isinstance(frames, list) or not frames:
        raise InputError(
            f"{path}: 'frames' must be a list with at least one frame", "export the capture again"
        )
    return frames


def _read_json(path: Path) -> dict[str, Any]:
    data = read_json(path, "export the capture again")
    if not isinstance(data, dict):
        raise InputError(
            f"{path}: must hold a JSON object, got {type(data).__name__}",
            "export the capture again",
        )
    return data


def _camera(path: Path, shared: dict[str, Any], frame: Any, index: int, folder: Path) -> Camera:
    where = f"{path}: frames[{index}]"
    if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
        raise InputError(f"{where} has no file_path", "name the image of every frame")
    where += f" ({short(frame['file_path'], bare=True)})"
    settings = {**shared, **frame}
    model = settings.get("camera_model", "OPENCV")
    model = model.upper() if isinstance(model, str) else short(model)
    if model not in _LENSES or settings.get("is_fisheye"):
        lens = "fisheye" if settings.get("is_fisheye") else short(model, bare=True)
        raise InputError(
            f"{where}: camera model {lens} is not supported",
            f"undistort, or use one of {', '.join(_LENSES)}",
        )
    viewmat = _viewmat(where, frame)
    named = inside(folder, frame["file_path"], where)
    image = _find_image(named)
    width, height = _number(where, settings, "w", 0), _number(where, settings, "h", 0)
    if (width < 1 or height < 1) and image is not None:
        width, height = image_size(image)
    if width < 1 or height < 1:
        raise InputError(
            f"{where}: neither 'w', 'h' nor the image tell the size",
            "restore the image or add w and h",
        )
    check_pixels(int(width), int(height), where)
    name = os.path.normpath(frame["file_path"])
    return Camera(
        viewmat,
        _intrinsics(where, settings, width, height),
        int(width),
        int(height),
        _distortion(where, settings),
        name,
        image if image is not None else named,
        _mask(folder, frame, name, where),
    )


def _number(where: str, settings: dict[str, Any], key: str, default: float) -> float:
    value = settings.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < _LARGE:
        raise InputError(
            f"{where}: {key} must be a finite number, got {short(value)}", "correct the file"
        )
    return float(value)


def _viewmat(where: str, frame: dict[str, Any]) -> torch.Tensor:
    """World-to-camera matrix with OpenCV axes from the OpenGL camera-to-world matrix of a frame."""
    if "transform_matrix" not in frame:
        raise InputError(
            f"{where} has no pose (transform_matrix)", "pose this image, or delete its frame"
        )
    try:
        matrix = torch.tensor(frame["transform_matrix"], dtype=torch.float64)
    except (TypeError, ValueError, OverflowError, RuntimeError) as error:
        raise InputError(
            f"{where}: transform_matrix must be 4 x 4 numbers", "correct the file"
        ) from error
    if tuple(matrix.shape) not in ((4, 4), (3, 4)) or not bool((matrix.abs() < _LARGE).all()):
        got = short(frame["transform_matrix"])
        raise InputError(
            f"{where}: transform_matrix must be 4 x 4 finite numbers, got {got}",
            "correct the pose",
        )
    rotation = matrix[:3, :3] * torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
    error_size = float((rotation.T @ rotation - torch.eye(3, dtype=torch.float64)).abs().max())
    if error_size > _RIGID_TOLERANCE or float(torch.linalg.det(rotation)) < 0:
        raise InputError(
            f"{where}: transform_matrix must hold a rotation, it is off by {error_size:.2g}",
            "correct the pose",
        )
    left, _, right = torch.linalg.svd(rotation)
    rotation = left @ right  # nearest exact rotation to the rounded one
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = rotation.T
    viewmat[:3, 3] = -rotation.T @ matrix[:3, 3]
    return viewmat


def _intrinsics(where: str, settings: dict[str, Any], width: float, height: float) -> torch.Tensor:
    focal_x, focal_y = _number(where, settings, "fl_x", 0), _number(where, settings, "fl_y", 0)
    if focal_x <= 0 and "camera_angle_x" in settings:
        focal_x = 0.5 * width / math.tan(0.5 * _angle(where, settings, "camera_angle_x"))
    if focal_y <= 0 and "camera_angle_y" in settings:
        focal_y = 0.5 * height / math.tan(0.5 * _angle(where, settings, "camera_angle_y"))
    focal_x, focal_y = focal_x or focal_y, focal_y or focal_x
    if focal_x == 0:
        raise InputError(f"{where}: no focal length (fl_x or camera_angle_x)", "add one of them")
    if min(focal_x, focal_y) <= 0:
        raise InputError(
            f"{where}: focal lengths must be positive, got {focal_x:g} and {focal_y:g}",
            "correct fl_x and fl_y",
        )
    cx, cy = _number(where, settings, "cx", width / 2), _number(where, settings, "cy", height / 2)
    if not is_lens((focal_x, focal_y), (cx, cy), ()):
        raise InputError(
            f"{where}: no lens has focal lengths of {focal_x:g} and {focal_y:g} pixels and its "
            f"middle at {cx:g}, {cy:g}",
            "correct the file",
        )
    return torch.tensor(
        [[focal_x, 0.0, cx], [0.0, focal_y, cy], [0.0, 0.0, 1.0]], dtype=torch.float64
    )


def _angle(where: str, settings: dict[str, Any], key: str) -> float:
    angle = _number(where, settings, key, 0)
    if not 0 < angle < math.pi:
        raise InputError(
            f"{where}: {key} must lie between 0 and pi (radians), got {angle}", "correct the file"
        )
    return angle


def _distortion(where: str, settings: dict[str, Any]) -> tuple[float, ...]:
    if _number(where, settings, "k4", 0):
        raise InputError(
            f"{where}: k4 is not supported", "undistort the images, or use k1, k2, k3, p1, p2"
        )
    values = tuple(_number(where, settings, key, 0) for key in ("k1", "k2", "p1", "p2", "k3"))
    if not any(values):
        return ()
    if not is_lens((), (), values):
        raise InputError(
            f"{where}: k1, k2, p1, p2, k3 are {list(values)}, which no lens has", "correct the file"
        )
    return values if values[4] else values[:4]


def _find_image(plain: Path) -> Path | None:
    """Return the image a frame names, trying the usual extensions; None when there is none."""
    if is_file(plain):
        return plain
    if not plain.name:
        return None
    for suffix in IMAGE_SUFFIXES:
        for spelling in (suffix, suffix.upper()):
            candidate = plain.with_name(plain.name + spelling)
            if is_file(candidate):
                return candidate
    return None


def _mask(folder: Path, frame: dict[str, Any], name: str, where: str) -> Path | None:
    named = frame.get("mask_path")
    if named is None:
        return find_mask(folder, name)
    if not isinstance(named, str):
        raise InputError(f"{where}: mask_path must be text, got {short(named)}", "correct the file")
    mask = _find_image(inside(folder, named, where))
    if mask is None:
        raise InputError(
            f"{where}: mask {short(named, bare=True)} is missing",
            "restore the mask, or remove mask_path",
        )
    return mask


def _points(path: Path, data: dict[str, Any], folder: Path) -> tuple[torch.Tensor, torch.Tensor]:
    """Read the sparse points that ``ply_file_path`` names; none is fine."""
    empty = torch.zeros(0, 3, dtype=torch.float64), torch.zeros(0, 3)
    named = data.get("ply_file_path")
    if not named:
        return empty
    if not isinstance(named, str):
        raise InputError(
            f"{path}: ply_file_path must be text, got {short(named)}", "correct the file"
        )
    file = inside(folder, named, path)
    rows = read_ply(file).get("vertex")
    if rows is None or not {"x", "y", "z"} <= set(rows.dtype.names or ()):
        raise InputError(
            f"{file}: no vertices with x, y, z",
            "export the point cloud again, or remove ply_file_path",
        )
    points = np.stack([rows[name].astype(np.float64) for name in ("x", "y", "z")], axis=1)
    colors = np.full(points.shape, 0.5, dtype=np.float32)
    if {"red", "green", "blue"} <= set(rows.dtype.names or ()):
        colors = np.stack(
            [rows[name].astype(np.float32) for name in ("red", "green", "blue")], axis=1
        )
        if rows["red"].dtype.kind == "u":
            colors /= np.float32(np.iinfo(rows["red"].dtype).max)
    good = np.isfinite(points).all(axis=1) & np.isfinite(colors).all(axis=1)
    return torch.from_numpy(points[good]), torch.from_numpy(np.ascontiguousarray(colors[good]))
