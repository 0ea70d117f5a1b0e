"""Simulated frames on disk: what rendering and exporting need, without the solver's state.

One uncompressed ``.npz`` per frame, about 50 bytes a Gaussian plus 6 a colour coefficient. Centres
and sizes keep full precision, since pictures and exports hang on them; what only tints a picture is
stored in half precision. What has not changed since an earlier frame is not stored again: the head
says which frame's file holds it (:class:`FrameWriter`).
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsfluent.data import Gaussians
from gsfluent.errors import RunError, short
from gsfluent.io import atomic_path
from gsfluent.io.checked.arrays import read_npz

_HALF = ("quats", "opacities", "sh", "damage", "velocity")
_HALF_MOST = 65504.0
_SPLATS = ("groups", "ids", "anchor")
_POINTS = ("positions", "volumes", "damage", "fragments", "velocity", "body", "material")
_DAMAGE = (LookupError, TypeError, ValueError, AttributeError, RecursionError, OverflowError)
_LED = ("led_rows", "led_positions")
_DUST = "dust_rows"
_KEPT = "kept"
DUST = 1 << 60
"""Numbers of the splats of dust begin here, beyond all others."""


@dataclass(frozen=True, eq=False)
class SavedFrame:
    """One moment of a finished simulation."""

    index: int  # Number of the frame, from 0
    time: float  # Simulated time [s]
    gaussians: Gaussians  # Scene frame, repaired
    groups: Tensor  # Siblings for nearest-only compositing, int32 [N], -1 for none
    # How many of them came from the solids; the rest, at the end, are transition splats of the
    # repair.
    carried: int
    # Number of each splat that it keeps from frame to frame as long as it lives, int64 [N]: 0 and
    # up for those of the solids and the repair, negative for those of bullets, liquids and rigid
    # things.
    ids: Tensor
    anchor: Tensor  # Material point each splat follows, int32 [N], -1 for splats of rigid things
    positions: Tensor  # Material points [m], [P, 3]
    volumes: Tensor  # Their volumes [m^3], [P]
    damage: Tensor  # 0 intact to 1 broken, [P]
    fragments: Tensor  # Fragment number per point, int32 [P]
    velocity: Tensor  # Velocity of each point [m/s], [P, 3]
    body: Tensor  # Number of each point's body in the scene, int32 [P]
    material: Tensor  # Row of each point in the scene's table of materials, int32 [P]
    facts: dict[str, Any]  # Plain figures of the frame (energies, counts)
    # Points that are drawn elsewhere than they are, with their chunk: rows int32 [K], [m] [K, 3].
    led: tuple[Tensor, Tensor] | None = None
    # Points that are drawn as dust, which is no body that one could see through: int32 [D].
    dust: Tensor | None = None

    @property
    def shown(self) -> Tensor:
        """Where the material points are drawn [m], [P, 3]; nan for dust."""
        places = self.positions
        if self.led is not None:
            rows, there = self.led
            places = places.index_copy(0, rows.long(), there.to(places))
        if self.dust is not None:
            places = places.index_fill(0, self.dust.long(), torch.nan)
        return places

    def to(self, device: torch.device) -> SavedFrame:
        """The same frame on another device."""
        moved = {name: getattr(self, name).to(device) for name in (*_SPLATS, *_POINTS)}
        led = None if self.led is None else (self.led[0].to(device), self.led[1].to(device))
        dust = None if self.dust is None else self.dust.to(device)
        return replace(self, gaussians=self.gaussians.to(device), led=led, dust=dust, **moved)


def frame_path(folder: Path, index: int) -> Path:
    """File of frame ``index``; numbers on disk start at 1 as in every frame sequence."""
    return folder / f"frame_{index + 1:04d}.npz"


def save_frame(folder: Path, frame: SavedFrame) -> Path:
    """Write one frame atomically.

    Raises:
        RunError: The disk is full.
    """
    return _write(folder, frame.index, packed_frame(frame))


def packed_frame(frame: SavedFrame) -> dict[str, np.ndarray]:
    """The arrays of a frame's file; they are its own, whatever becomes of the tensors."""
    arrays: dict[str, np.ndarray] = {}
    for name in ("means", "quats", "scales", "opacities", "sh"):
        arrays[name] = _packed(name, getattr(frame.gaussians, name))
    if frame.gaussians.labels is not None:
        arrays["labels"] = frame.gaussians.labels.to(torch.int8).cpu().numpy()
    for name in (*_SPLATS, *_POINTS):
        arrays[name] = _packed(name, getattr(frame, name))
    if frame.led is not None:
        arrays |= {name: _packed(name, value) for name, value in zip(_LED, frame.led, strict=True)}
    if frame.dust is not None:
        arrays[_DUST] = _packed(_DUST, frame.dust)
    head = {
        "index": frame.index,
        "time": frame.time,
        "carried": frame.carried,
        "facts": frame.facts,
    }
    arrays["head"] = np.array(json.dumps(head))
    return arrays


class FrameWriter:
    """Writes the frames of one folder, one after the other, each array once while it stays.

    Args:
        folder: Where.
        begun: Frames that are there; the next ones go on from them, file by file the same as if
            nothing had come between.

    Raises:
        RunError: The last of them is damaged.
    """

    def __init__(self, folder: Path, begun: int = 0) -> None:
        self._folder = folder
        self._stored: dict[str, tuple[int, np.ndarray]] = {}
        if begun == 0:
            return
        last = begun - 1
        try:
            arrays = _arrays(folder, last)
            where = _kept(_head(arrays), last)
        except _DAMAGE as error:
            raise _unreadable(frame_path(folder, last), error) from error
        for name, array in arrays.items():
            if name != "head":
                self._stored[name] = where.get(name, last), array

    def write(self, index: int, arrays: dict[str, np.ndarray]) -> Path:
        """Write what :func:`packed_frame` made, atomically.

        Raises:
            RunError: The disk is full.
        """
        new, stored, kept = dict[str, np.ndarray](), dict(self._stored), dict[str, int]()
        for name, array in arrays.items():
            if name == "head":
                continue
            if name in stored and stored[name][0] < index and _same(stored[name][1], array):
                kept[name] = stored[name][0]
            else:
                new[name], stored[name] = array, (index, array)
        head = json.loads(str(arrays["head"])) | ({_KEPT: kept} if kept else {})
        path = _write(self._folder, index, new | {"head": np.array(json.dumps(head))})
        self._stored = stored
        return path


def _same(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether two arrays hold the same bits."""
    alike = one.dtype == other.dtype and one.shape == other.shape
    return alike and np.array_equal(_bits(one), _bits(other))


def _bits(array: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(array).reshape(-1).view(np.uint8)


def _write(folder: Path, index: int, arrays: dict[str, np.ndarray]) -> Path:
    path = frame_path(folder, index)
    with atomic_path(path, synced=False) as part, part.open("wb") as stream:
        np.savez(stream, **arrays)  # type: ignore[arg-type]
    return path


def load_frame(folder: Path, index: int) -> SavedFrame:
    """Read one frame.

    Raises:
        RunError: It is missing or damaged.
    """
    path = frame_path(folder, index)
    try:
        arrays = _finite(_arrays(folder, index))
        head = _head(arrays)
        return SavedFrame(
            index=head["index"],
            time=head["time"],
            carried=head["carried"],
            facts=head["facts"],
            gaussians=_gaussians(arrays),
            led=(_tensor(arrays[_LED[0]]), _tensor(arrays[_LED[1]])) if _LED[0] in arrays else None,
            dust=_tensor(arrays[_DUST]) if _DUST in arrays else None,
            **{name: _tensor(arrays[name]) for name in (*_SPLATS, *_POINTS)},
        )
    except _DAMAGE as error:
        raise _unreadable(path, error) from error


def frame_positions(folder: Path, index: int) -> Tensor:
    """The material points of a frame [m], [P, 3], without reading the rest of it.

    Raises:
        RunError: It is missing or damaged.
    """
    path = frame_path(folder, index)
    try:
        return _tensor(_finite(_arrays(folder, index, "positions"))["positions"])
    except _DAMAGE as error:
        raise _unreadable(path, error) from error


def _arrays(folder: Path, index: int, *names: str) -> dict[str, np.ndarray]:
    """The arrays of a frame, or those of ``names`` only, also such as earlier frames' files hold.

    Raises:
        ValueError: A file is missing or damaged; also an :class:`InputError`.
        LookupError: A name is in none.
    """
    path = frame_path(folder, index)
    arrays = read_npz(path, ("head",) if names else None)
    elsewhere = _kept(_head(arrays), index)
    if names:
        arrays = read_npz(path, [name for name in names if name not in elsewhere])
    earlier: dict[int, list[str]] = {}
    for name in names or elsewhere:
        if name in elsewhere:
            earlier.setdefault(elsewhere[name], []).append(name)
    for number, there in earlier.items():
        arrays |= _arrays(folder, number, *there)
    return arrays


def _kept(head: dict[str, Any], index: int) -> dict[str, int]:
    """Arrays that are in the files of earlier frames, with their numbers."""
    kept = head.get(_KEPT, {})
    if not all(type(n) is int and 0 <= n < index for n in dict(kept).values()):
        raise ValueError(f"its head has arrays in frames {short(kept)}")
    return dict(kept)


def _finite(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    for name, array in arrays.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise ValueError(f"{name} holds NaN or infinity")
    return arrays


def count_frames(folder: Path) -> int:
    """Number of consecutive frames on disk, from the first."""
    count = 0
    while frame_path(folder, count).is_file():
        count += 1
    return count


def frame_head(path: Path) -> dict[str, Any]:
    """The plain values of a frame's file: ``index``, ``time`` [s], ``carried``, ``facts``.

    Raises:
        ValueError: It is missing or damaged; also an :class:`InputError`.
        LookupError: A value is missing.
    """
    return _head(read_npz(path, ("head",)))


def _head(arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    head: dict[str, Any] = json.loads(str(arrays["head"]))
    numbers = (head["index"], head["time"], head["carried"])
    if not all(isinstance(n, int | float) and math.isfinite(n) for n in numbers):
        raise ValueError(f"its head has index, time and carried {short(numbers)}")
    if not isinstance(head["facts"], dict):
        raise ValueError("its facts are no mapping")
    return head


def frame_time(folder: Path, index: int) -> float:
    """Simulated time [s] of a frame, without reading the rest of it.

    Raises:
        RunError: The frame is missing or damaged.
    """
    path = frame_path(folder, index)
    try:
        return float(frame_head(path)["time"])
    except _DAMAGE as error:
        raise _unreadable(path, error) from error


def frame_rate(folder: Path, default: float = 30.0) -> float:
    """Frames per second of simulated time; ``default`` where there are not two frames."""
    if count_frames(folder) < 2:
        return default
    step = frame_time(folder, 1) - frame_time(folder, 0)
    return round(1.0 / step, 6) if step > 0 else default


def _unreadable(path: Path, error: Exception) -> RunError:
    hint = "run the shot again; only this stage is redone (use --force if it is not)"
    return RunError(f"{path}: no readable frame ({error})", "the other frames", hint)


def _packed(name: str, value: Tensor) -> np.ndarray:
    value = value.detach()
    if name in _HALF:  # what is larger, a speed beyond all sense, would be infinite
        value = value.clamp(-_HALF_MOST, _HALF_MOST).half()
    elif value.dtype == torch.float64:
        value = value.float()
    array = value.cpu().numpy()
    return array.copy() if array.base is not None and not value.is_cuda else array


def _tensor(array: np.ndarray) -> Tensor:
    value = torch.from_numpy(array)
    return value.float() if value.dtype == torch.float16 else value


def _gaussians(arrays: dict[str, np.ndarray]) -> Gaussians:
    labels = arrays.get("labels")
    return Gaussians(
        means=_tensor(arrays["means"]),
        quats=_tensor(arrays["quats"]),
        scales=_tensor(arrays["scales"]),
        opacities=_tensor(arrays["opacities"]),
        sh=_tensor(arrays["sh"]),
        labels=None if labels is None else torch.from_numpy(labels.astype(np.int32)),
    )
