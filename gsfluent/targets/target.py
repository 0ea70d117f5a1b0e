"""What a target is: something that was seen, and how far a motion is from it."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsfluent.data import Gaussians
from gsfluent.errors import InputError
from gsfluent.pipeline.carrying import Binding, bind


class Motion(NamedTuple):
    """What a run shows at the times of the frames.

    Attributes:
        position: Points [m], float64 [T, N, 3].
        deformation: Their total deformation, [T, N, 3, 3].
        impulse: Impulse of each collider on the matter so far [N s], [T, K, 3].
        strain: Largest strain of any point in the last frame, [].
    """

    position: Tensor
    deformation: Tensor
    impulse: Tensor
    strain: Tensor


class Setting(NamedTuple):
    """What a target may know of the scene that is fitted to it.

    Attributes:
        rest: Points at time 0 [m], float64 [N, 3].
        solid: Whether points keep their neighbours.
        dx: Grid spacing [m].
        floor: Height of the floor [m], or None.
        splats: The splats of the bodies at time 0.
        colliders: Names of the colliders.
        velocity: Their velocities at time 0 [m/s], [K, 3].
    """

    rest: Tensor
    solid: bool
    dx: float
    floor: float | None
    splats: Gaussians | None
    colliders: list[str]
    velocity: Tensor


class Observer(Protocol):
    """A target bound to the points of a scene."""

    def pair(self, motion: Motion) -> Any:
        """What stays the same within a linearisation about this motion."""

    def residuals(self, motion: Motion, frames: int, pairs: Any) -> tuple[Tensor, Tensor]:
        """Differences in standard deviations [R], and the frame of each, int64 [R]."""


class Target(Protocol):
    """Something that was seen.

    Attributes:
        times: Of its frames [s]; the first is 0, when the scene begins.
        step: Difference of the free coordinates that its Jacobian is taken with.
    """

    times: list[float]
    step: float

    def observe(self, setting: Setting) -> Observer:
        """Bind it to the points of a scene."""


def frame_times(where: str, count: int, fps: float, times: Sequence[float] | None) -> list[float]:
    """Times of frames [s].

    Raises:
        InputError: Not as many ascending ones as frames, or not from 0 on.
    """
    if times is None:
        if not 0.0 < fps <= 1e6:
            raise InputError(f"{where}: fps is {fps:g}", "give frames per second above 0")
        return [k / fps for k in range(count)]
    found = [float(t) for t in times]
    ascending = all(b > a for a, b in itertools.pairwise(found))
    if len(found) != count or not ascending or not np.isfinite(found).all():
        raise InputError(
            f"{where}: {len(found)} times for {count} frames", "give one ascending each"
        )
    return [t - found[0] for t in found]


def positive(where: str, name: str, value: float) -> float:
    """A number above 0.

    Raises:
        InputError: It is not.
    """
    if not (np.isfinite(value) and value > 0.0):
        raise InputError(f"{where}: {name} is {value}", "give a number above 0")
    return float(value)


def cloud(where: str, values: Any) -> NDArray[np.float64]:
    """Points [N, 3].

    Raises:
        InputError: Not such an array.
    """
    points = np.asarray(values, np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or not len(points):
        raise InputError(
            f"{where}: must be points [N, 3], got {list(points.shape)}", "x, y, z each"
        )
    return points


class Followers:
    """Places at rest that follow the points of a scene.

    Args:
        places: At time 0 [m], [M, 3].
        setting: The scene.

    Raises:
        InputError: None of them is near the matter.
    """

    def __init__(self, where: str, places: Tensor, setting: Setting) -> None:
        self.binding: Binding = bind(places, setting.rest)
        self.solid = setting.solid
        away = self.binding.arm.norm(dim=2).amin(dim=1)
        self.near = away <= 3.0 * setting.dx
        if not bool(self.near.any()):
            raise InputError(
                f"{where}: the nearest lies {float(away.min()):.3g} m from the matter",
                "give it in the scene's metres, +z up, where the shot puts the object at time 0",
            )

    def places(self, motion: Motion, frame: int) -> tuple[Tensor, Tensor]:
        """Where they are in a frame [M, 3], and how small vectors have changed [M, 3, 3]."""
        index, now = self.binding.index, motion.position[frame]
        if not self.solid:
            moved = self.binding.move(now)
            return moved.means, moved.map
        maps = motion.deformation[frame][index]
        weight = self.binding.weight[..., None]
        places = now[index] + (maps @ self.binding.arm[..., None])[..., 0]
        return (weight * places).sum(dim=1), (weight[..., None] * maps).sum(dim=1)


def joined(parts: list[Tensor], frames: list[int]) -> tuple[Tensor, Tensor]:
    """Residuals of frames one after the other, and the frame of each."""
    kept = [part.reshape(-1) for part in parts]
    number = [torch.full((len(part),), k) for part, k in zip(kept, frames, strict=True)]
    return torch.cat(kept), torch.cat(number)
