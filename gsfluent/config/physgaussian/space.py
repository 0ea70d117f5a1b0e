"""Where things of PhysGaussian's box are in a scene.

PhysGaussian turns a model, picks ``sim_area``, and brings what it picked into a box: the middle of
its bounds to (1, 1, 1), its longest side to ``scale``. All numbers of a config (E, density, g,
points, speeds, times) hold in that box. Here the box is the scene: one unit of theirs is one metre,
and only the axes are turned so that their upward axis is +z, and the origin moved to (1, 1, 1) or
straight below it onto the floor. So no number is rescaled, and what moves in their box moves here
by as much of the object's size in as many seconds.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsfluent import geometry
from gsfluent.config.physgaussian.keys import (
    INERT,
    MAPPED,
    NEAR,
    UNSUPPORTED,
    Note,
    number,
    numbers,
)
from gsfluent.data import BACKGROUND, SURFACE, Frame, Gaussians
from gsfluent.errors import InputError, short
from gsfluent.io.checked.files import read_json

Array = NDArray[np.float64]
_ORBIT = ("init_azimuthm", "init_elevation", "init_radius")
_STEPS = ("delta_a", "delta_e", "delta_r")
_LEVEL = math.radians(2.0)


@dataclasses.dataclass(frozen=True)
class Space:
    """From their world and their box to the scene."""

    turn: Array  # World to box axes, [3, 3]
    middle: Array  # What goes to (1, 1, 1), in turned world coordinates, [3]
    scale: float  # Box units (metres here) per world unit
    upright: Array  # Box to scene axes, [3, 3]
    floor: float = 0.0  # Height of z = 0 above (1, 1, 1) [m]

    @property
    def aligned(self) -> bool:
        """Whether boxes along their axes are boxes along the scene's."""
        return bool((np.abs(np.abs(self.upright).max(axis=1) - 1.0) < 1e-9).all())

    def place(self, point: Sequence[float] | Array) -> list[float]:
        """Scene coordinates [m] of a point of the box."""
        found = self.upright @ (np.asarray(point, dtype=np.float64) - 1.0)
        return _plain(found - [0.0, 0.0, self.floor])

    def way(self, vector: Sequence[float] | Array) -> list[float]:
        """Scene components of a vector of the box."""
        return _plain(self.upright @ np.asarray(vector, dtype=np.float64))

    def edges(self, half: Sequence[float]) -> list[float]:
        """Edges [m], along the scene's axes if they are aligned, of a box with these half edges."""
        full = 2.0 * np.asarray(half, dtype=np.float64)
        return _plain(np.abs(self.upright) @ full if self.aligned else full)

    def frame(self) -> Frame:
        """World to scene."""
        shift = -self.scale * self.upright @ self.middle - np.array([0.0, 0.0, self.floor])
        return Frame(
            torch.from_numpy(self.upright @ self.turn), torch.from_numpy(shift), self.scale
        )


def _plain(values: Array) -> list[float]:
    return [round(float(v), 9) + 0.0 for v in values]


def model_file(folder: Path) -> Path:
    """The splats of the last iteration in a folder that the INRIA trainer wrote.

    Raises:
        InputError: There are none.
    """
    found = {}
    for path in folder.glob("point_cloud/iteration_*/point_cloud.ply"):
        count = path.parent.name.removeprefix("iteration_")
        if count.isdigit():
            found[int(count)] = path
    if not found:
        raise InputError(
            f"{folder}: no point_cloud/iteration_N/point_cloud.ply in it",
            "give the model folder that the INRIA trainer wrote",
        )
    return found[max(found)]


def rotation(values: Mapping[str, Any]) -> Array:
    """World to box axes: the turns of ``rotation_degree`` about ``rotation_axis``, one by one.

    Raises:
        InputError: Lists of different lengths, or no such axis.
    """
    degrees, axes = values.get("rotation_degree", []), values.get("rotation_axis", [])
    if not isinstance(degrees, list) or not isinstance(axes, list) or len(degrees) != len(axes):
        raise InputError(
            f"rotation_degree {short(degrees)} and rotation_axis {short(axes)} must be lists of "
            "one length",
            "give an axis for every angle",
        )
    turn = np.eye(3)
    for i, axis in enumerate(axes):
        if axis not in (0, 1, 2):
            raise InputError(
                f"rotation_axis[{i}] must be 0, 1 or 2, got {short(axis)}", "name x, y or z"
            )
        angle = math.radians(number({"a": degrees[i]}, "a", 0.0, f"rotation_degree[{i}] "))
        c, s = math.cos(angle), math.sin(angle)
        one = np.eye(3)
        a, b = (axis + 1) % 3, (axis + 2) % 3
        one[a, a], one[a, b], one[b, a], one[b, b] = c, -s, s, c
        turn = one @ turn
    return turn


def space_of(gaussians: Gaussians, values: Mapping[str, Any]) -> tuple[Space, Gaussians]:
    """The box of a config, and the model labelled: what is simulated, and what stands behind.

    Raises:
        InputError: Nothing is left to simulate, or a number that cannot be.
    """
    least = number(values, "opacity_threshold", 0.02)
    gaussians = gaussians.select(gaussians.opacities > least)
    turn = rotation(values)
    turned = gaussians.means.double().numpy() @ turn.T
    inside = np.ones(len(turned), dtype=bool)
    if values.get("sim_area") is not None:
        area = numbers(values, "sim_area", [], count=6)
        for axis in range(3):
            inside &= (turned[:, axis] > area[2 * axis]) & (turned[:, axis] < area[2 * axis + 1])
    if not inside.any():
        raise InputError(
            f"none of {len(turned)} Gaussians is above opacity_threshold and inside sim_area",
            "check both, and rotation_degree",
        )
    low, high = turned[inside].min(axis=0), turned[inside].max(axis=0)
    extent = float((high - low).max())
    size = number(values, "scale", 1.0)
    if not extent > 0.0 or not size > 0.0:
        raise InputError(
            f"the model spans {extent:g} and scale is {size:g}: both must be positive",
            "check the model and scale",
        )
    up = np.array(numbers(values, "mpm_space_vertical_upward_axis", [0.0, 0.0, 1.0]))
    if not up.any():
        raise InputError("mpm_space_vertical_upward_axis must not be zero", "give [0, 0, 1]")
    upright = geometry.rotation_between(
        torch.from_numpy(up / np.linalg.norm(up)), torch.tensor([0.0, 0.0, 1.0]).double()
    )
    labels = torch.from_numpy(np.where(inside, SURFACE, BACKGROUND)).to(torch.int32)
    space = Space(turn, (low + high) / 2.0, size / extent, upright.double().numpy())
    return space, gaussians.replace(labels=labels)


def in_box(space: Space, gaussians: Gaussians) -> Array:
    """Their coordinates of what is simulated, [N, 3]."""
    assert gaussians.labels is not None
    means = gaussians.means[gaussians.labels.eq(SURFACE)].double().numpy()
    return np.asarray(space.scale * (means @ space.turn.T - space.middle) + 1.0)


def camera_path(
    folder: Path, values: Mapping[str, Any], space: Space, frames: int, notes: list[Note]
) -> tuple[dict[str, Any] | None, list[int] | None]:
    """The camera of a config as a path file, and the size of its pictures.

    Args:
        folder: The model folder, with ``cameras.json``.
        values: The config.
        space: Its box.
        frames: Frames of the video.
        notes: What became of the camera's keys is added.

    Returns:
        Content of the path file, or None for the usual orbit; width and height, or None.

    Raises:
        InputError: ``cameras.json`` is no list of the INRIA trainer's cameras.
    """
    index = int(number(values, "default_camera_index", 0.0))
    path = folder / "cameras.json"
    used = ["default_camera_index", "mpm_space_viewpoint_center"]
    if not path.is_file():
        for key in (*used, *_ORBIT, *_STEPS, "move_camera"):
            if key in values:
                notes.append(Note(key, UNSUPPORTED, "the model folder has no cameras.json"))
        return None, None
    try:
        cameras = read_json(path)
        raw = cameras[max(index, 0)]
        size = [int(raw["width"]), int(raw["height"])]
        fov = math.degrees(2.0 * math.atan(0.5 * size[1] / float(raw["fy"])))
        position = np.array(raw["position"], dtype=np.float64).reshape(3)
        axes = np.array(raw["rotation"], dtype=np.float64).reshape(3, 3)
        if min(size) < 1 or not (np.isfinite(position).all() and np.isfinite(axes).all()):
            raise ValueError("a size below 1, or a pose that is not finite")
    except (ValueError, LookupError, TypeError, ArithmeticError) as error:
        raise InputError(
            f"{path}: no camera {max(index, 0)} of the INRIA trainer "
            f"({type(error).__name__}: {short(str(error), bare=True)})",
            "check default_camera_index, or train the model again",
        ) from error
    frame = space.frame()
    center = numbers(values, "mpm_space_viewpoint_center", [1.0, 1.0, 1.0])
    even = [side - side % 2 for side in size]
    notes += [Note(key, MAPPED, "output.camera") for key in used if key in values]
    if index >= 0:
        notes += [
            Note(key, INERT, "a photograph's camera stands still (default_camera_index)")
            for key in (*_ORBIT, *_STEPS, "move_camera")
            if key in values
        ]
        eye = frame.apply(torch.from_numpy(position)).numpy()
        ahead = frame.apply_vector(torch.from_numpy(axes[:, 2])).numpy()
        reach = max(float((np.array(space.place(center)) - eye) @ ahead), 1e-3)
        across = frame.apply_vector(torch.from_numpy(axes[:, 0])).numpy()
        if abs(float(across[2])) > math.sin(_LEVEL):
            angle = math.degrees(math.asin(min(1.0, abs(float(across[2])))))
            text = f"its roll of {angle:.0f} degrees is left out: the horizon is level here"
            notes.append(Note("default_camera_index", NEAR, text))
        poses = [{"eye": _plain(eye), "target": _plain(eye + reach * ahead)}]
        return {"fov": fov, "frames": poses}, even
    missing = [key for key in _ORBIT if values.get(key) is None]
    if missing:
        notes += [
            Note(key, UNSUPPORTED, f"{', '.join(missing)} missing: the usual orbit instead")
            for key in (*_ORBIT, *_STEPS, "move_camera")
            if key in values
        ]
        return None, even
    start = [number(values, key, 0.0) for key in _ORBIT]
    move = bool(values.get("move_camera", False))
    steps = [number(values, key, 0.0) if move else 0.0 for key in _STEPS]
    notes += [Note(key, MAPPED, "output.camera") for key in (*_ORBIT, "move_camera")
              if key in values]  # fmt: skip
    for key in _STEPS:
        if key in values:
            notes.append(Note(key, MAPPED, "output.camera") if move
                         else Note(key, INERT, "move_camera is false"))  # fmt: skip
    target = np.array(space.place(center))
    vertical = space.turn.T @ np.linalg.inv(space.upright) @ np.array([0.0, 0.0, 1.0])
    basis = (space.upright @ space.turn) @ _observer(vertical)
    poses = []
    for i in range(frames if move else 1):
        # their first picture is taken after one frame of motion, ours before it
        a, e, radius = (s + max(i - 1, 0) * d for s, d in zip(start, steps, strict=True))
        a, e = math.radians(a), math.radians(e)
        ray = np.array([math.cos(a) * math.cos(e), math.sin(a) * math.cos(e), math.sin(e)])
        eye = target + space.scale * radius * (basis @ ray)
        poses.append({"eye": _plain(eye), "target": _plain(target)})
    return {"fov": fov, "frames": poses}, even


def _observer(vertical: Array) -> Array:
    """World axes (columns) in which their azimuth and elevation are counted."""
    first = np.array([1.0, 1.0, 1.0])
    if abs(float(first @ vertical)) < 0.01:
        first = np.array([0.72, 0.37, -0.67])
    first = first - (first @ vertical) * vertical
    first /= np.linalg.norm(first)
    return np.column_stack([first, np.cross(first, vertical), vertical])


def turn_to(direction: Array) -> list[float]:
    """Rotation vector [degrees] that brings +z to a direction."""
    from scipy.spatial.transform import Rotation

    way = torch.from_numpy(direction / np.linalg.norm(direction))
    matrix = geometry.rotation_between(torch.tensor([0.0, 0.0, 1.0]).double(), way)
    return _plain(Rotation.from_matrix(matrix.double().numpy()).as_rotvec(degrees=True))


def turn_of(matrix: Tensor | Array) -> list[float]:
    """Rotation vector [degrees] of a rotation matrix."""
    from scipy.spatial.transform import Rotation

    return _plain(Rotation.from_matrix(np.asarray(matrix)).as_rotvec(degrees=True))
