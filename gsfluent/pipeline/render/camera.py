"""Cameras of a video: an orbit that follows the action, a photograph's pose, or a path."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from gsfluent.data import Camera, Capture, Frame
from gsfluent.errors import InputError
from gsfluent.geometry import quantiles
from gsfluent.io.checked.files import read_json
from gsfluent.pipeline.render.path import dolly, holds_poses, through, turntable

PATHS = ("orbit", "turntable", "dolly")
"""Camera paths that go by a name."""

# degrees over the shorter side: a short telephoto, little perspective distortion
_FIELD_OF_VIEW = 32.0
_ELEVATION = 20.0
_FRONT = -90.0  # azimuth from which the front is seen
# degrees of azimuth in one video: enough parallax to read the shape, slow enough to watch
_SWEEP = 70.0
_SMOOTH_FRAMES = 5.0
_AHEAD = 6  # frames that the camera steps back before the matter does
_HELD = 30  # frames that it stays back before it comes nearer again
_SHARE, _SPRAY = 0.98, 0.995  # of the matter that is in the picture, and where it need not go far
_ROOM = 1.15  # free space around the matter, as a factor on the distance
_LEAST = 1.2  # distance, as a factor on that at which the object at first fits
FARTHEST = 4.5
"""The same at most, for the share; a spray beyond it shrinks the subject by :data:`_SPRAYED`."""
_SPRAYED = 2.0
_LAG = 0.6  # share of the free space that a fall may run ahead of the camera
_WHOLE = 1.12  # free space around the whole object, however tall, as a factor on the distance


@dataclass(frozen=True)
class Action:
    """Where the matter is over time, as far as a camera operator cares.

    Attributes:
        center: Robust centre of the matter per frame [m], shape [F, 3].
        radius: Distance from the centre that holds nine tenths of it, per frame [m], shape [F].
        reach: Distance from the first centre that holds all of the objects [m].
        extent: Horizontal distance from the centre, and height above or below it, that hold 98 %
            of it each, per frame [m], shape [F, 2]; ``radius`` twice when absent.
        spray: The same for 99.5 % of it; ``extent`` when absent.
    """

    center: Tensor
    radius: Tensor
    reach: float = 0.0
    extent: Tensor | None = None
    spray: Tensor | None = None

    @classmethod
    def of(cls, positions: Sequence[Tensor], objects: Tensor | None = None) -> Action:
        """Measure the action.

        Args:
            positions: All matter of each frame [m], [N, 3].
            objects: Which of the first frame's is of the objects, not of bullets or liquids, bool
                [N]; all of it when absent.
        """
        # the middle of what the picture shall hold: a median follows the largest heap, and a hand
        # that rolls away on one side leaves the picture
        centers, radius, extent, spray = [], [], [], []
        for matter in positions:
            points = _thin(matter.double().cpu())
            center = quantiles(points, (1.0 - _SHARE, _SHARE)).mean(dim=0)
            away = points - center
            centers.append(center)
            radius.append(quantiles(away.norm(dim=-1), (0.9,))[0])
            apart = torch.stack([away[:, :2].norm(dim=-1), away[:, 2].abs()], dim=-1)
            held, most = quantiles(apart, (_SHARE, _SPRAY))
            extent.append(held)
            spray.append(most)
        center = torch.stack(centers)
        first = positions[0].double().cpu()
        first = first if objects is None else first[objects.cpu()]
        reach = float((first - center[0]).norm(dim=-1).amax()) if len(first) else 0.0
        return cls(center, torch.stack(radius), reach, torch.stack(extent), torch.stack(spray))


def _thin(values: Tensor) -> Tensor:
    """Every n-th row: a quantile needs thousands (and torch.quantile refuses 2^24)."""
    return values[:: max(1, values.shape[0] // 20_000)]


def look_at(
    target: Tensor, distance: float, azimuth: float, elevation: float, size: tuple[int, int]
) -> Camera:
    """A camera on a sphere around ``target`` [3] that looks at it; angles in degrees, +z up."""
    a, e = math.radians(azimuth), math.radians(elevation)
    outward = torch.tensor(
        [math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)], dtype=torch.float64
    )
    eye = target.double() + distance * outward
    return Camera.look_at(eye, target, width=size[0], height=size[1], fov=_vertical_fov(size))


def _vertical_fov(size: tuple[int, int]) -> float:
    """Vertical angle [degrees] at which the shorter side spans the field of view."""
    width, height = size
    half = math.tan(math.radians(_FIELD_OF_VIEW) / 2.0)
    return math.degrees(2.0 * math.atan(half * height / min(width, height)))


def orbit(action: Action, size: tuple[int, int], *, sweep: float = _SWEEP) -> list[Camera]:
    """One camera per frame: circles slowly, follows the matter softly, steps back for a burst.

    It passes the front in the middle of the film. The distance shows 98 % of the matter, but the
    whole object at least, however tall, and from 4.5 times as far at most: debris must not shrink
    the subject to a dot. It shows 99.5 % where twice as far is enough.

    Args:
        action: Where the matter is.
        size: (width, height) [px].
        sweep: Degrees of azimuth from the first frame to the last.
    """
    count = action.center.shape[0]
    distance = _distance(action, size)
    centers = _follow(action, distance)
    steps = [i / max(1, count - 1) for i in range(count)]
    return [
        look_at(centers[i], float(distance[i]), _FRONT + sweep * (step - 0.5), _ELEVATION, size)
        for i, step in enumerate(steps)
    ]


def _fits(wide: Tensor, tall: Tensor, size: tuple[int, int]) -> Tensor:
    """Distance from which an upright cylinder is just in the picture [m], shape [F].

    Args:
        wide: Its radius [m], shape [F].
        tall: Half its height [m], shape [F].
        size: (width, height) of the picture [px].
    """
    up = math.tan(math.radians(_vertical_fov(size)) / 2.0)
    side = up * size[0] / size[1]
    sin, cos = math.sin(math.radians(_ELEVATION)), math.cos(math.radians(_ELEVATION))
    # the rims at the sides, at the bottom in front, at the top behind and in front
    sides = wide * math.sqrt(1.0 / side**2 + cos**2) + tall * sin
    low = (tall * cos + wide * sin) / up + wide * cos - tall * sin
    far = (tall * cos + wide * sin) / up - wide * cos + tall * sin
    near = (tall * cos - wide * sin) / up + wide * cos + tall * sin
    return torch.stack([sides, low, far, near]).amax(dim=0)


def _distance(action: Action, size: tuple[int, int]) -> Tensor:
    """Of the camera per frame [m], shape [F]: it steps back ahead of the burst."""
    extent = action.radius[:, None].expand(-1, 2) if action.extent is None else action.extent
    spray = extent if action.spray is None else action.spray
    fits, all_of_it = (_fits(each[:, 0], each[:, 1], size) for each in (extent, spray))
    whole = action.reach / math.sin(math.radians(_FIELD_OF_VIEW) / 2.0)
    wanted = torch.maximum(
        fits.clamp(min=_LEAST * float(fits[0]), max=FARTHEST * float(fits[0])),
        all_of_it.clamp(max=_SPRAYED * float(fits[0])),
    )
    # the widest of the frames around: it steps back ahead of a burst, and stays back for a while
    early, late = wanted[:1].expand(_HELD), wanted[-1:].expand(_AHEAD)
    windows = torch.cat([early, wanted, late]).unfold(0, _HELD + _AHEAD + 1, 1)
    smooth = _smooth(windows.amax(dim=1)[:, None], 0.8 * _SMOOTH_FRAMES)[:, 0]
    return (_ROOM * smooth).clamp(min=_WHOLE * whole)


def _follow(action: Action, distance: Tensor) -> Tensor:
    """Where to look, shape [F, 3]: smooth, but never so late that the object leaves the picture."""
    shown = distance * math.sin(math.radians(_FIELD_OF_VIEW) / 2.0)
    # what is still whole has its farthest point beyond the nine tenths
    least = torch.where(action.radius <= 1.02 * action.radius[0], action.reach, 0.0)
    room = _LAG * torch.maximum(shown - torch.maximum(1.5 * action.radius, least), 0.05 * shown)

    def held(track: Tensor) -> Tensor:
        lag = track - action.center
        length = lag.norm(dim=1).clamp(min=1e-12)
        return action.center + lag * torch.minimum(room / length, torch.ones_like(length))[:, None]

    # smoothing moves what is fast by more than the room
    return held(_smooth(held(_smooth(action.center, _SMOOTH_FRAMES)), 0.5))


def _smooth(track: Tensor, sigma: float) -> Tensor:
    """Gaussian smoothing over ``sigma`` frames with the ends held, shape [F, 3]."""
    frames = torch.arange(track.shape[0], dtype=track.dtype)
    weight = torch.exp(-0.5 * ((frames[:, None] - frames[None, :]) / sigma) ** 2)
    return (weight @ track) / weight.sum(dim=1, keepdim=True)


def framed(camera: Camera, size: tuple[int, int]) -> Camera:
    """The whole view of ``camera``, centred in a picture of another size and aspect."""
    width, height = size
    factor = min(width / camera.width, height / camera.height)
    intrinsics = camera.K.clone()
    intrinsics[:2] *= factor
    intrinsics[0, 2] += (width - factor * camera.width) / 2.0
    intrinsics[1, 2] += (height - factor * camera.height) / 2.0
    return camera.replace(K=intrinsics, width=width, height=height)


def cameras_for(
    choice: str | int,
    action: Action,
    size: tuple[int, int],
    *,
    capture: Capture | None = None,
    frame: Frame | None = None,
) -> list[Camera]:
    """One camera per frame for ``output.camera``.

    Args:
        choice: One of :data:`PATHS`, the index of a photograph, a JSON file (see
            :func:`read_path`), or a ``transforms.json`` or COLMAP folder whose poses are followed.
        action: Where the matter is; its length is the number of frames.
        size: (width, height) [px].
        capture: The photographs, needed for an index.
        frame: World to scene, needed for an index and for poses.

    Raises:
        InputError: No such photograph, or an unreadable file.
    """
    count = action.center.shape[0]
    if str(choice) in PATHS:
        return _named_path(str(choice), action, size)
    try:
        index = int(str(choice))
    except ValueError:
        path = Path(str(choice))
        if holds_poses(path):
            return [framed(camera, size) for camera in through(path, count, frame)]
        return read_path(path, count, size)
    if capture is None or frame is None:
        raise InputError(
            f"output.camera: {index}",
            "a photograph's index needs a `capture:`; use `orbit` or a file",
        )
    if not -len(capture.cameras) <= index < len(capture.cameras):
        raise InputError(
            f"output.camera: {index}",
            f"the capture has photographs 0 to {len(capture.cameras) - 1}",
        )
    photograph = capture.view(index).camera  # undistorted
    return [framed(photograph.transformed(frame), size)] * count


def _named_path(name: str, action: Action, size: tuple[int, int]) -> list[Camera]:
    if name == "orbit":
        return orbit(action, size)
    still = orbit(action, size, sweep=0.0)
    centers = _follow(action, _distance(action, size))
    return turntable(still, centers) if name == "turntable" else dolly(still, centers)


def read_path(path: Path, count: int, size: tuple[int, int]) -> list[Camera]:
    """Cameras from JSON: ``{"fov": 32, "frames": [{"eye": [x,y,z], "target": [x,y,z]}, ...]}``.

    Scene frame, metres; ``fov`` is vertical, in degrees. One entry is a still camera; otherwise
    eyes and targets are interpolated over the video.

    Raises:
        InputError: The file is missing, is not such JSON, or an eye sits on its target.
    """
    hint = 'give {"fov": 32, "frames": [{"eye": [x, y, z], "target": [x, y, z]}, ...]} in metres'
    try:
        data = read_json(path)
        keys = torch.tensor(
            [[*f["eye"], *f["target"]] for f in data["frames"]], dtype=torch.float64
        )
        field = float(data.get("fov", _FIELD_OF_VIEW))
    except InputError as error:
        raise InputError(
            f"output.camera: {error.what}", f"give {', '.join(PATHS)}, an index, or a file"
        ) from error
    except (ValueError, LookupError, TypeError, AttributeError, OverflowError) as error:
        raise InputError(f"output.camera: {path}: {error!r}", hint) from error
    fine = keys.ndim == 2 and keys.shape[1] == 6 and bool(keys.isfinite().all())
    if not fine or not 1.0 <= field <= 150.0:
        raise InputError(f"output.camera: {path}: fov {field}, frames {tuple(keys.shape)}", hint)
    if bool(((keys[:, :3] - keys[:, 3:]).norm(dim=-1) == 0).any()):
        raise InputError(f"output.camera: {path}: an eye equals its target", hint)
    time = torch.linspace(0, keys.shape[0] - 1, count, dtype=torch.float64)
    low = time.floor().long().clamp(max=max(0, keys.shape[0] - 2))
    high = (low + 1).clamp(max=keys.shape[0] - 1)
    part = (time - low)[:, None]
    path_keys = keys[low] * (1.0 - part) + keys[high] * part
    return [
        Camera.look_at(k[:3], k[3:], width=size[0], height=size[1], fov=field) for k in path_keys
    ]
