"""Writer of ``.gsd``; :mod:`gsfluent.io.splats.delta` describes the format and reads it."""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsfluent.errors import InputError
from gsfluent.io.atomic import atomic_path
from gsfluent.io.axes import nearest_axes
from gsfluent.io.splats.delta import (
    BLOCK,
    DELTA,
    END,
    INDEX,
    KEY,
    MAGIC,
    PLACES,
    QUATERNION_LEVELS,
    ROSTER,
    TRAILER,
    VERSION,
    DeltaFrame,
    Floats,
    Ints,
    State,
    decode,
    multiply,
    predict,
)
from gsfluent.io.splats.morton import morton_order

_SH0 = 0.28209479177387814
_SMALL_GROUP = 24  # fewer splats than this share one shift only
ROTATION_STEP, LOG_SCALE_STEP = 1.0 / 128.0, 1.0 / 32.0


def steps(position_error: float) -> dict[str, float]:
    """Steps of the numbers in a file whose centres are at most ``position_error`` [m] off."""
    return {
        "position": 2.0 * position_error,
        "rotation": ROTATION_STEP,
        "log_scale": LOG_SCALE_STEP,
        "opacity": 1.0 / 255.0,
        "f_dc": 1.0 / (255.0 * _SH0),
    }


def bounds(step: dict[str, float]) -> dict[str, float]:
    """Largest errors for these steps.

    Per coordinate [m]; of a covariance, as a share of its largest eigenvalue (half a step of the
    scales' logarithms, counted twice, and what a rotation may be off); opacity; ``f_dc``.
    """
    turned = max(step["log_scale"], float(np.sqrt(3.0)) * step["rotation"] / 2.0)
    return {
        "position": step["position"] / 2.0,
        "covariance": float(np.expm1(step["log_scale"])) + turned,
        "opacity": step["opacity"] / 2.0,
        "f_dc": step["f_dc"] / 2.0,
    }


class Roster:
    """Every splat that ever lives, in an order that keeps neighbours together.

    Fill it with all frames (:meth:`meet`) before writing.
    """

    def __init__(self) -> None:
        self._ids: list[NDArray[np.int64]] = []
        self._frames: list[tuple[NDArray[Any], ...]] = []
        self._known = np.zeros(0, np.int64)

    def meet(self, frame: DeltaFrame) -> None:
        """Note down the splats of a frame that are new.

        Raises:
            InputError: Two splats have the same id.
        """
        if len(np.unique(frame.ids)) != len(frame.ids):
            raise InputError(
                f"delta: frame {frame.index} has two splats of one id", "run the shot again"
            )
        new = ~np.isin(frame.ids, self._known)
        if new.any():
            self._known = np.union1d(self._known, frame.ids[new])
            self._ids.append(frame.ids[new])
            values = (frame.means, frame.f_dc, frame.opacities[:, None], frame.scales)
            self._frames.append(tuple(value[new] for value in values))

    def finish(self, step: dict[str, float]) -> tuple[Ints, Ints]:
        """The ids, int64 [M], and what each splat was like when it was born, int64 [M, 7].

        Raises:
            InputError: There is not one splat.
        """
        if not self._ids:
            raise InputError("delta: no splat in any frame", "check the run")
        # births one after the other
        order = [
            _shorter(i, parts[0], step) for i, parts in zip(self._ids, self._frames, strict=True)
        ]
        ids = np.concatenate([i[o] for i, o in zip(self._ids, order, strict=True)])
        f_dc, opacities, scales = (
            np.concatenate([parts[place][o] for parts, o in zip(self._frames, order, strict=True)])
            for place in (1, 2, 3)
        )
        return ids, levels_of(f_dc, opacities, scales, step)


def _shorter(ids: Ints, means: NDArray[Any], step: dict[str, float]) -> Ints:
    """By id, or along a curve through space: what makes ids and places together shorter.

    Splats of a filled solid are in order as they come, trained ones are not.
    """

    def cost(order: Ints) -> int:
        place = np.rint(means[order].astype(np.float64) / step["position"]).astype(np.int64)
        along = np.diff(place, axis=0, prepend=np.zeros((1, 3), np.int64))
        return len(zlib.compress(pack_arrays([ids[order][:, None], along]), 6))

    return min(np.argsort(ids, kind="stable"), morton_order(means), key=cost)


def levels_of(
    f_dc: NDArray[Any], opacities: NDArray[Any], scales: NDArray[Any], step: dict[str, float]
) -> Ints:
    """Colour (3), opacity and log scale (3) in whole steps, [N, 7]."""
    parts = [
        f_dc.astype(np.float64) / step["f_dc"],
        opacities.astype(np.float64).reshape(-1, 1) / step["opacity"],
        np.log(scales.astype(np.float64)) / step["log_scale"],
    ]
    return np.rint(np.concatenate(parts, axis=1)).astype(np.int64)


def write_delta(
    path: str | Path,
    frames: Iterable[DeltaFrame],
    roster: Roster,
    *,
    times: Sequence[float],
    fps: float,
    step: dict[str, float],
    key_every: int = 30,
    up: str = "z",
) -> dict[str, int]:
    """Write a sequence, atomically.

    Args:
        path: ``.gsd``.
        frames: In order; consumed one at a time.
        roster: Has met every one of these frames.
        times: Simulated time of each frame [s].
        fps: Frames per second.
        step: From :func:`steps`.
        key_every: Every so many frames one stands alone, so that a player may jump to it.
        up: Axis that points up, noted down.

    Returns:
        Bytes of the ``header`` (with roster and index), of ``key`` frames and of ``delta`` frames,
        and the number of ``splat_frames`` that delta frames hold.

    Raises:
        InputError: No splats, or not as many frames as times.
        RunError: The disk is full.
    """
    if key_every < 1:
        raise InputError(f"--key-every {key_every}", "give 1 or more")
    ids, born = roster.finish(step)
    header = {
        "format": "gsfluent delta sequence",
        "frames": len(times),
        "times": [float(time) for time in times],
        "fps": fps,
        "up": up,
        "unit": "m",
        "key_every": key_every,
        "splats": len(ids),
        "step": step,
        "error": bounds(step),
    }
    text = json.dumps(header).encode()
    spent = {"header": 0, "key": 0, "delta": 0, "splat_frames": 0}
    with atomic_path(path) as part, part.open("wb") as stream:
        stream.write(MAGIC + struct.pack("<II", VERSION, len(text)) + text)
        offsets = [stream.tell()]
        _block(stream, ROSTER, 0, [ids[:, None], born[:, :3], born[:, 3:4], born[:, 4:]])
        spent["header"] = stream.tell()
        coder = _Coder(ids, born, step)
        count = 0
        for count, frame in enumerate(frames, start=1):
            offsets.append(stream.tell())
            key = (count - 1) % key_every == 0
            _block(stream, KEY if key else DELTA, count - 1, coder.encode(frame, key))
            spent["key" if key else "delta"] += stream.tell() - offsets[-1]
            spent["splat_frames"] += 0 if key else len(frame.ids)
        if count != len(times):
            raise InputError(f"delta: {count} frames for {len(times)} times", "give one each")
        at = stream.tell()
        words = np.array([[offset & 0xFFFFFFFF, offset >> 32] for offset in offsets])
        _block(stream, INDEX, 0, [words])
        stream.write(TRAILER.pack(at, END))
        spent["header"] += stream.tell() - at
    return spent


def _block(stream: Any, kind: bytes, frame: int, arrays: list[Ints]) -> None:
    data = zlib.compress(pack_arrays(arrays), 9)
    stream.write(BLOCK.pack(kind, frame, len(data), zlib.crc32(data)) + data)


def pack_arrays(arrays: Iterable[NDArray[Any]]) -> bytes:
    """Whole numbers [rows, columns] as bytes, the fewest per number that hold the largest."""
    out = bytearray()
    for array in arrays:
        values = array.astype(np.int64)
        coded = np.where(values < 0, -2 * values - 1, 2 * values).astype(np.uint64)
        top = int(coded.max()) if coded.size else 0
        width = (top.bit_length() + 7) // 8
        out += struct.pack("<IBB", *coded.shape, width)
        planes = [(coded.T >> np.uint64(8 * place)).astype(np.uint8) for place in range(width)]
        if planes:
            out += np.stack(planes, axis=1).tobytes()
    return bytes(out)


class _Coder:
    """Runs the decoder along with the writing, so that errors do not add up."""

    def __init__(self, ids: Ints, born: Ints, step: dict[str, float]) -> None:
        count = len(ids)
        self.order = np.argsort(ids, kind="stable")
        self.sorted, self.born, self.step = ids[self.order], born, step
        self.state = State(
            np.zeros(count, bool), np.full(count, -1, np.int64), np.zeros((count, 3)),
            np.zeros((count, 3)), np.zeros((count, 4)), np.zeros((count, 7), np.int64),
        )  # fmt: skip

    def encode(self, frame: DeltaFrame, key: bool) -> list[Ints]:
        """The arrays of a frame's block."""
        rows = self.order[np.searchsorted(self.sorted, frame.ids)]
        place = np.argsort(rows)  # frame rows in the roster's order
        rows = rows[place]
        alive = np.zeros(len(self.born), bool)
        alive[rows] = True
        means = frame.means[place].astype(np.float64)
        quats = frame.quats[place].astype(np.float64)
        quats /= np.linalg.norm(quats, axis=1, keepdims=True)
        fragment = frame.fragment[place].astype(np.int64)
        scales = frame.scales[place].astype(np.float64)
        f_dc, opacities = frame.f_dc[place], frame.opacities[place]
        before = self.state
        if key:
            levels = levels_of(f_dc, opacities, scales, self.step)
            arrays = [_bits(alive), *self._alone(rows, means, quats, fragment, levels)]
        else:
            stays = before.alive[rows]
            old, new = rows[stays], ~stays
            number = before.fragment.copy()
            number[old] = fragment[stays]
            fits = _predictors(before, number, old, means[stays])
            expected, turned = predict(before, number, old, fits)
            quats[stays], scales[stays] = nearest_axes(quats[stays], scales[stays], turned)
            levels = levels_of(f_dc, opacities, scales, self.step)
            angle = _rotation(quats[stays], turned)
            angle[_looks_the_same(angle, scales[stays])] = 0.0
            arrays = [
                _bits(alive ^ before.alive),
                (fragment[stays] - before.fragment[old])[:, None],
                _words(fits),
                np.rint((means[stays] - expected) / self.step["position"]).astype(np.int64),
                np.rint(angle / self.step["rotation"]).astype(np.int64),
                levels[stays] - before.levels[old],
                *self._alone(rows[new], means[new], quats[new], fragment[new], levels[new]),
            ]
        self.state = decode(arrays, before, self.born, self.step, key)
        return arrays

    def _alone(
        self, rows: Ints, means: Floats, quats: Floats, fragment: Ints, levels: Ints
    ) -> list[Ints]:
        """Splats whose values stand alone."""
        position = np.rint(means / self.step["position"]).astype(np.int64)
        largest = np.abs(quats).argmax(axis=1)
        sign = np.where(quats[np.arange(len(quats)), largest] < 0, -1.0, 1.0)
        small = np.take_along_axis(quats * sign[:, None], PLACES[largest], axis=1)
        scaled = np.rint(small * np.sqrt(2.0) * QUATERNION_LEVELS).astype(np.int64)
        along = np.diff(position, axis=0, prepend=np.zeros((1, 3), np.int64))
        return [fragment[:, None], along, largest[:, None], scaled, levels - self.born[rows]]


def _bits(mask: NDArray[np.bool_]) -> Ints:
    return np.packbits(mask).astype(np.int64)[:, None]


def _words(fits: dict[int, Floats]) -> Ints:
    """Number and 21 float32 as int32 of each predictor, [G, 22]."""
    rows = [
        np.concatenate([[number], matrix.astype(np.float32).reshape(-1).view(np.int32)])
        for number, matrix in fits.items()
    ]
    return np.array(rows, np.int64).reshape(len(rows), 22)


def _predictors(before: State, fragment: Ints, rows: Ints, means: Floats) -> dict[int, Floats]:
    """Per fragment the least-squares fit of ``[x, v, 1] @ P`` to where its splats are now."""
    fits: dict[int, Floats] = {}
    of = fragment[rows]
    for number in np.unique(of).tolist():
        mine = of == number
        x, v, y = before.means[rows[mine]], before.moved[rows[mine]], means[mine]
        if np.array_equal(x, y):
            continue
        matrix = np.zeros((7, 3))
        matrix[:3] = np.eye(3)
        if mine.sum() >= _SMALL_GROUP:
            known = np.concatenate([x, v], axis=1)
            center, target = known.mean(axis=0), y.mean(axis=0)
            free, wanted = known - center, y - target
            # around "stays": where nothing tells a direction, the fit leaves it alone
            change = wanted - free[:, :3]
            matrix[:6] += np.linalg.pinv(free.T @ free, rcond=1e-9) @ (free.T @ change)
            matrix[6] = target - center @ matrix[:6]
        else:
            matrix[6] = (y - x).mean(axis=0)
        # as the file will hold them
        fits[number] = matrix.astype(np.float32).astype(np.float64)
    return fits


def _looks_the_same(angle: Floats, scales: Floats) -> NDArray[np.bool_]:
    """Whether a rotation by ``angle`` [n, 3] changes covariances by less than their scales' steps.

    It changes one by at most ``min(1, angle) (largest^2 - smallest^2)``: nearly round splats, whose
    axes are anything, need no rotation at all.
    """
    part = 1.0 - (scales.min(axis=1) / scales.max(axis=1)) ** 2
    return np.minimum(1.0, np.linalg.norm(angle, axis=1)) * part < LOG_SCALE_STEP


def _rotation(quats: Floats, turned: Floats) -> Floats:
    """Rotation vectors [rad] from ``turned`` to ``quats``."""
    back = turned * np.array([1.0, -1.0, -1.0, -1.0])
    rest = multiply(quats, back)
    rest *= np.where(rest[:, :1] < 0, -1.0, 1.0)
    length = np.linalg.norm(rest[:, 1:], axis=1, keepdims=True)
    angle = 2.0 * np.arctan2(length, rest[:, :1])
    return rest[:, 1:] * np.divide(
        angle, length, out=np.full_like(length, 2.0), where=length > 1e-12
    )
