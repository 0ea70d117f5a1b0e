"""Camera paths beyond the orbit: turntable, dolly, frozen time, and the poses of a capture.

A path is one camera per frame of the simulation, except frozen time, which shows one frame from
many sides; :class:`Cut` pairs a camera with the frame it shows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from gsfluent import geometry
from gsfluent.data import Camera, Frame
from gsfluent.errors import InputError
from gsfluent.io.capture import load_poses
from gsfluent.io.checked.files import read_json
from gsfluent.io.images import undistorted

FREEZE_SECONDS = 4.0
_DOLLY = (2.2, 0.85)  # distance at the start and at the end, as a factor on the orbit's


class Cut(NamedTuple):
    """One picture of a film."""

    frame: int
    camera: Camera


def turned(camera: Camera, pivot: Tensor, degrees: float) -> Camera:
    """The camera moved on a circle around the vertical axis (+z) through ``pivot`` [3]."""
    a = math.radians(degrees)
    turn = [[math.cos(a), -math.sin(a), 0.0], [math.sin(a), math.cos(a), 0.0], [0.0, 0.0, 1.0]]
    rotation = torch.tensor(turn, dtype=torch.float64)
    pivot = pivot.double()
    return camera.transformed(Frame(rotation, pivot - rotation @ pivot, 1.0))


def turntable(cameras: Sequence[Camera], centers: Tensor) -> list[Camera]:
    """The first view all the way around the matter once in the film, following it.

    Args:
        cameras: The views to turn, one per frame, all from the same side.
        centers: Pivot of each frame [m], [F, 3].
    """
    count = len(cameras)
    return [
        turned(camera, center, 360.0 * index / count)
        for index, (camera, center) in enumerate(zip(cameras, centers, strict=True))
    ]


def dolly(cameras: Sequence[Camera], centers: Tensor) -> list[Camera]:
    """The views moved along the line of sight, from far to near, starting and ending softly."""
    count = len(cameras)
    moved = []
    for index, (camera, center) in enumerate(zip(cameras, centers, strict=True)):
        step = index / max(1, count - 1)
        ease = step * step * (3.0 - 2.0 * step)
        factor = _DOLLY[0] * (1.0 - ease) + _DOLLY[1] * ease
        eye = camera.center()
        shift = (factor - 1.0) * (eye - center.double())
        moved.append(camera.transformed(Frame(torch.eye(3).double(), shift, 1.0)))
    return moved


def freeze(
    cameras: Sequence[Camera], centers: Tensor, frame: int, fps: float, seconds: float
) -> list[Cut]:
    """Play up to ``frame``, walk once around it while time stands still, play on.

    Args:
        cameras: One per frame.
        centers: Pivot of each frame [m], [F, 3].
        frame: Where time stands still.
        fps: Pictures per second.
        seconds: How long the walk takes.

    Raises:
        InputError: There is no such frame.
    """
    count = len(cameras)
    if not 0 <= frame < count:
        raise InputError(f"--camera freeze:{frame}", f"the run has frames 0 to {count - 1}")
    pictures = max(2, round(seconds * fps))
    cuts = [Cut(index, cameras[index]) for index in range(frame + 1)]
    for step in range(1, pictures):
        part = step / pictures
        ease = part * part * (3.0 - 2.0 * part)
        cuts.append(Cut(frame, turned(cameras[frame], centers[frame], 360.0 * ease)))
    return cuts + [Cut(index, cameras[index]) for index in range(frame, count)]


def holds_poses(path: Path) -> bool:
    """Whether a path names poses of a capture: a COLMAP folder or a ``transforms.json``."""
    if path.is_dir():
        return True
    try:
        frames = read_json(path)["frames"]
        return isinstance(frames, list) and any("transform_matrix" in frame for frame in frames)
    except (ValueError, LookupError, TypeError):
        return False


def through(path: Path, count: int, frame: Frame | None) -> list[Camera]:
    """A smooth path through the poses of a capture, resampled to ``count`` pictures.

    Places are interpolated linearly, orientations by nlerp of neighbours, focal lengths linearly.

    Args:
        path: Folder with a COLMAP model, or ``transforms.json``; the photographs need not be there.
        count: Number of pictures.
        frame: From the capture's world to the scene; none where they are the same.

    Raises:
        InputError: No readable poses.
    """
    poses = [
        undistorted(camera) if any(camera.distortion) else camera for camera in load_poses(path)
    ]
    size = (poses[0].width, poses[0].height)
    eyes = torch.stack([camera.center() for camera in poses])
    quats = geometry.matrix_to_quaternion(torch.stack([c.viewmat[:3, :3] for c in poses]))
    inner = torch.stack([camera.resized(*size).K for camera in poses])
    cameras = []
    for time in torch.linspace(0, len(poses) - 1, count, dtype=torch.float64).tolist():
        low = min(int(time), max(0, len(poses) - 2))
        high, part = min(low + 1, len(poses) - 1), time - low
        other = quats[high] * (-1.0 if float((quats[low] * quats[high]).sum()) < 0 else 1.0)
        quat = torch.nn.functional.normalize((1 - part) * quats[low] + part * other, dim=0)
        rotation = geometry.quaternion_to_matrix(quat[None])[0]
        eye = (1 - part) * eyes[low] + part * eyes[high]
        viewmat = torch.eye(4, dtype=torch.float64)
        viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ eye
        camera = Camera(viewmat, (1 - part) * inner[low] + part * inner[high], *size)
        cameras.append(camera if frame is None else camera.transformed(frame))
    return cameras
