"""Reader of ``.gsd``: a splat sequence as key frames and small differences, with births and deaths.

Only numpy and the standard library are used, and nothing else of gsfluent's is but its errors.

Layout (little-endian; docs/guide/export.md has the reasons)::

    "GSFDELTA", version u32, size of header u32, header (JSON, UTF-8)
    block of the roster, then one block per frame in order, then the index
    offset of the index u64, "GSFD-END"

    block: kind (4 letters), frame u32, size u32, CRC-32 of the payload u32, payload (zlib)

A payload is a row of integer arrays, each: rows u32, columns u8, bytes per number u8, then the
numbers, zigzag-coded (0, -1, 1, -2, ...), column by column, each as planes of bytes, lowest first.

* ``ROST``: every splat that ever lives: id, colour (3 levels of ``f_dc``), opacity, log scale (3).
* ``KEYF``: alive (bits, packed to bytes), then for those alive: fragment, position (differences
  along the rows), quaternion (number of the largest of wxyz; the other three), and colour, opacity
  and log scale minus the roster's.
* ``DELT``: alive XOR before; for splats that stay alive, fragment minus before; per fragment a
  predictor: its number, then 21 float32 as int32; for those that stay: position minus prediction,
  rotation vector after the predicted rotation, and colour, opacity and log scale minus before; for
  those born now: what a key frame holds.
* ``INDX``: offset of every frame's block, as u32 pairs.

Prediction of a splat at ``x`` that moved by ``v`` since the frame before (0 after a birth or a key
frame): ``[x, v, 1] @ P`` with its fragment's ``P`` [7, 3], and the rotation of the polar
decomposition of ``P[:3]``. Values differ from what was written by at most the header's ``error``.
"""

from __future__ import annotations

import json
import struct
import zlib
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsfluent.errors import InputError
from gsfluent.io.checked.files import regular_file
from gsfluent.io.checked.limits import unpacked_limit, within

MAGIC, END = b"GSFDELTA", b"GSFD-END"
VERSION = 1
BLOCK = struct.Struct("<4sIII")
TRAILER = struct.Struct("<Q8s")
ROSTER, KEY, DELTA, INDEX = b"ROST", b"KEYF", b"DELT", b"INDX"
_LEVELS = [3, 1, 3]  # columns: colour, opacity, log scale
_BORN = [1, 3, 1, 3, 7]  # fragment, position, largest, small, levels
_STAYS = [1, 22, 3, 3, 7]  # fragment, predictor, position, rotation, levels
_ARRAYS = 11  # of a difference
_FLOAT32 = 3e38
_LOG_SCALE = 80.0  # exp of it is a float32
QUATERNION_LEVELS = 2047  # per component of a key frame, over 1/sqrt(2)
PLACES = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]


@dataclass(frozen=True)
class DeltaFrame:
    """The splats that live in one frame, sorted by id.

    Attributes:
        index: Number of the frame in the file, from 0.
        time: Simulated time [s].
        ids: Number of each splat that it keeps while it lives, int64 [N].
        fragment: Fragment it belongs to, int32 [N], -1 for none.
        means: Centres [m], float32 [N, 3].
        quats: Unit quaternions ``wxyz``, float32 [N, 4].
        scales: Standard deviations [m], float32 [N, 3].
        opacities: 0..1, float32 [N].
        f_dc: SH coefficients of degree 0, float32 [N, 3].
    """

    index: int
    time: float
    ids: NDArray[np.int64]
    fragment: NDArray[np.int32]
    means: NDArray[np.float32]
    quats: NDArray[np.float32]
    scales: NDArray[np.float32]
    opacities: NDArray[np.float32]
    f_dc: NDArray[np.float32]


@dataclass(frozen=True)
class State:
    """What a decoder knows after a frame; one row per splat of the roster."""

    alive: NDArray[np.bool_]  # bool [M]
    fragment: Ints  # int64 [M]
    means: Floats  # [M, 3]
    moved: Floats  # change of ``means`` since the frame before, [M, 3]
    quats: Floats  # ``wxyz`` [M, 4]
    levels: Ints  # colour (3), opacity, log scale (3) in steps, int64 [M, 7]


class DeltaReader:
    """A ``.gsd`` file; frames may be read in any order, in order is fastest.

    Args:
        path: The file.

    Attributes:
        header: ``frames``, ``times`` [s], ``fps``, ``up``, ``step``, ``error``, ``key_every``.

    Raises:
        InputError: Not such a file, of a later version, cut short or damaged.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        try:
            self._size = regular_file(self.path)
            with self.path.open("rb") as stream:
                self.header = self._read_header(stream.read(16), stream)
        except OSError as error:
            raise InputError(
                f"{path}: cannot be read ({error.strerror})", "check the path"
            ) from error
        offsets = self._offsets()
        self._start, self._frames = offsets[0], offsets[1:]
        self.step: dict[str, float] = self.header["step"]
        roster = self._payload(self._start, ROSTER, 0)
        if [array.shape[1] for array in roster] != [1, *_LEVELS] or len(
            {len(array) for array in roster}
        ) != 1:
            raise self._damaged("the roster")
        self.ids: Ints = roster[0][:, 0]
        self._born: Ints = np.concatenate(roster[1:4], axis=1)
        self._at, self._state = -1, self._nothing()

    def __len__(self) -> int:
        """Number of frames."""
        return len(self._frames)

    def frame(self, index: int) -> DeltaFrame:
        """Decode one frame.

        Raises:
            IndexError: There is no such frame.
            InputError: The file is damaged between its last key frame and this one.
        """
        if not 0 <= index < len(self):
            raise IndexError(f"frame {index} of {len(self)}")
        every = self.header["key_every"]
        key = index - index % every
        start = self._at + 1 if key <= self._at <= index else key
        for place in range(start, index + 1):
            kind = KEY if place % every == 0 else DELTA
            arrays = self._payload(self._frames[place], kind, place)
            try:
                self._state = decode(arrays, self._state, self._born, self.step, kind == KEY)
                _check_finite(self._state, self.step)
            except (ValueError, IndexError, KeyError, np.linalg.LinAlgError) as error:
                self._at = -1
                raise self._damaged(f"frame {place} does not fit its roster ({error})") from error
            self._at = place
        return self._shown(index)

    def _shown(self, index: int) -> DeltaFrame:
        state, step = self._state, self.step
        rows = np.flatnonzero(state.alive)
        rows = rows[np.argsort(self.ids[rows], kind="stable")]
        level = state.levels[rows]
        return DeltaFrame(
            index,
            float(self.header["times"][index]),
            self.ids[rows],
            state.fragment[rows].astype(np.int32),
            state.means[rows].astype(np.float32),
            state.quats[rows].astype(np.float32),
            np.exp(level[:, 4:] * step["log_scale"]).astype(np.float32),
            np.clip(level[:, 3] * step["opacity"], 0.0, 1.0).astype(np.float32),
            (level[:, :3] * step["f_dc"]).astype(np.float32),
        )

    def _nothing(self) -> State:
        count = len(self.ids)
        return State(
            np.zeros(count, bool), np.full(count, -1, np.int64), np.zeros((count, 3)),
            np.zeros((count, 3)), np.zeros((count, 4)), np.zeros((count, 7), np.int64),
        )  # fmt: skip

    def _read_header(self, head: bytes, stream: Any) -> dict[str, Any]:
        if head[:8] != MAGIC:
            raise InputError(f"{self.path}: not a delta sequence", "pass a .gsd file of gsfluent")
        if len(head) < 16:
            raise self._short("in its first bytes")
        version, size = struct.unpack("<II", head[8:])
        if version != VERSION:
            raise InputError(
                f"{self.path}: version {version}, this gsfluent reads {VERSION}", "update gsfluent"
            )
        if 16 + size > self._size:  # read() would allocate what is said, not what is there
            raise self._short("inside the header")
        text = stream.read(size)
        self._body = 16 + size
        try:
            header: dict[str, Any] = json.loads(text)
            _check_header(header)
        except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
            raise self._damaged(f"the header ({error!r})") from error
        return header

    def _offsets(self) -> list[int]:
        """Offsets of the roster and of every frame."""
        with self.path.open("rb") as stream:
            stream.seek(max(0, self._size - TRAILER.size))
            tail = stream.read()
        if len(tail) < TRAILER.size or tail[8:] != END:
            raise self._short("before its index")
        at = TRAILER.unpack(tail)[0]
        words = self._payload(at, INDEX, 0)
        if len(words) != 1 or words[0].shape[1] != 2 or (words[0] < 0).any():
            raise self._damaged("the index")
        low, high = words[0].T
        offsets: list[int] = (low + (high << 32)).tolist()
        if len(offsets) != self.header["frames"] + 1:
            raise self._damaged("the index")
        return offsets

    def _payload(self, at: int, kind: bytes, frame: int) -> list[Ints]:
        """The arrays of one block, checked."""
        name = f"the block {kind.decode()} of frame {frame} at byte {at}"
        with self.path.open("rb") as stream:
            if not self._body <= at <= self._size:
                raise self._damaged(f"{name} lies outside the file")
            stream.seek(at)
            head = stream.read(BLOCK.size)
            if len(head) < BLOCK.size:
                raise self._short(f"inside {name}")
            found, number, size, check = BLOCK.unpack(head)
            if (found, number) != (kind, frame):
                raise self._damaged(name)
            if at + BLOCK.size + size > self._size:
                raise self._short(f"inside {name}")
            data = stream.read(size)
        if zlib.crc32(data) != check:
            raise self._damaged(f"{name} fails its check sum")
        try:
            return self._unpacked(data, kind, name)
        except InputError:
            raise
        except (zlib.error, struct.error, ValueError) as error:
            raise self._damaged(f"{name} ({error})") from error

    def _unpacked(self, data: bytes, kind: bytes, name: str) -> list[Ints]:
        """The arrays of a payload, which neither zlib nor their sizes make larger than allowed."""
        most = unpacked_limit(self._size)
        packed = zlib.decompressobj()
        plain = packed.decompress(data, most + 1)
        within("unpacked_bytes", len(plain), f"{self.path}: {name}", most)
        if not packed.eof:
            raise ValueError("incomplete")
        if kind in (ROSTER, INDEX):
            return unpack_arrays(plain, len(plain), most, _ARRAYS)
        return unpack_arrays(plain, max(len(self.ids), len(plain)), most, _ARRAYS)

    def _short(self, where: str) -> InputError:
        return InputError(
            f"{self.path}: the file ends {where}", "it is truncated; copy or export it again"
        )

    def _damaged(self, what: str) -> InputError:
        return InputError(f"{self.path}: damaged: {what}", "copy or export it again")


def _check_header(header: dict[str, Any]) -> None:
    """Raise ValueError, KeyError or TypeError for what is no header."""
    times, steps = header["times"], header["step"]
    if not isinstance(times, list) or len(times) != header["frames"]:
        raise ValueError("times")
    every = header["key_every"]
    if isinstance(every, bool) or not isinstance(every, int) or every < 1:
        raise ValueError("key_every")
    named = ("position", "rotation", "log_scale", "opacity", "f_dc")
    for number in (*times, *(steps[name] for name in named)):
        # the same bound keeps whole numbers of hundreds of digits out
        if isinstance(number, bool) or not isinstance(number, int | float):
            raise ValueError(f"{number!r:.60} is no number")
        if not -1e300 < number < 1e300:
            raise ValueError("a time or step that is not finite")
    if any(later < earlier for earlier, later in pairwise(times)):
        raise ValueError("times that go back")


def _check_finite(state: State, step: dict[str, float]) -> None:
    """Raise ValueError where a living splat has a value that no splat has."""
    alive = state.alive
    log_scale = state.levels[alive, 4:] * step["log_scale"]
    if not (
        np.isfinite(state.means[alive]).all()
        and np.isfinite(state.quats[alive]).all()
        and (np.abs(state.means[alive]) < _FLOAT32).all()
        and (np.abs(log_scale) < _LOG_SCALE).all()
        and (np.abs(state.levels[alive, :3] * step["f_dc"]) < _FLOAT32).all()
    ):
        raise ValueError("a splat without a finite place, turn, size or colour")


def unpack_arrays(
    data: bytes, most_rows: int = 1 << 32, most_bytes: int = 1 << 40, most_arrays: int = 1 << 20
) -> list[Ints]:
    """Inverse of :func:`gsfluent.io.splats.delta_write.pack_arrays`.

    Args:
        data: The payload.
        most_rows: Rows that an array may have: numbers of no bytes (all zero) cost nothing.
        most_bytes: Bytes that all arrays may take.
        most_arrays: How many there may be; an empty one takes six bytes.

    Returns:
        Arrays, each int64 [rows, columns].

    Raises:
        ValueError: The payload is none, or larger than that.
    """
    arrays: list[Ints] = []
    at, total = 0, 0
    while at < len(data):
        rows, columns, width = struct.unpack_from("<IBB", data, at)
        at += 6
        total += 8 * rows * columns
        if rows > most_rows or total > most_bytes or width > 8 or len(arrays) >= most_arrays:
            raise ValueError(f"{rows} rows of {columns} numbers of {width} bytes")
        planes = np.frombuffer(data, np.uint8, rows * columns * width, at)
        at += len(planes)
        coded = np.zeros((columns, rows), np.uint64)
        for place, plane in enumerate(planes.reshape(columns, width, rows).transpose(1, 0, 2)):
            coded |= plane.astype(np.uint64) << np.uint64(8 * place)
        half = (coded >> np.uint64(1)).astype(np.int64)
        arrays.append(np.where(coded & np.uint64(1), -half - 1, half).T)
    return arrays


def decode(
    arrays: list[Ints], before: State, born: Ints, step: dict[str, float], key: bool
) -> State:
    """Advance a decoder by one block.

    Args:
        arrays: Of the block.
        before: State after the frame before (of any, for a key frame).
        born: Levels of the roster, int64 [M, 7].
        step: Of the header.
        key: A key frame.

    Returns:
        The next state.

    Raises:
        ValueError: The arrays do not fit the roster.
    """
    count = len(born)
    mask = np.unpackbits((arrays[0][:, 0] & 255).astype(np.uint8), count=count).astype(bool)
    if key:
        empty = replace(before, alive=np.zeros(count, bool), moved=np.zeros((count, 3)))
        return _with_born(arrays[1:], np.flatnonzero(mask), empty, born, step)
    if [array.shape[1] for array in arrays[1:6]] != _STAYS or len(arrays) != _ARRAYS:
        raise ValueError("columns")
    alive = before.alive ^ mask
    stay, new = np.flatnonzero(before.alive & alive), np.flatnonzero(alive & ~before.alive)
    fragment = before.fragment.copy()
    fragment[stay] += arrays[1][:, 0]
    predictors = {int(row[0]): _coefficients(row[1:]) for row in arrays[2]}
    means, quats = predict(before, fragment, stay, predictors)
    means = means + arrays[3] * step["position"]
    turn: Floats = arrays[4] * np.float64(step["rotation"])
    quats = multiply(rotation_to_quaternion(turn), quats)
    state = replace(
        before,
        alive=before.alive & alive,
        fragment=fragment,
        means=_put(before.means, stay, means),
        moved=_put(np.zeros((count, 3)), stay, means - before.means[stay]),
        quats=_put(before.quats, stay, quats),
        levels=_put(before.levels, stay, before.levels[stay] + arrays[5]),
    )
    return _with_born(arrays[6:], new, state, born, step)


def _with_born(
    arrays: list[Ints], rows: Ints, state: State, born: Ints, step: dict[str, float]
) -> State:
    """Add splats whose values stand alone."""
    fragment, position, largest, small, levels = arrays
    if [array.shape[1] for array in arrays] != _BORN:
        raise ValueError("columns")
    if any(len(array) != len(rows) for array in arrays):
        raise ValueError("rows")
    if ((largest < 0) | (largest > 3)).any():
        raise ValueError("a quaternion has four components")
    fragments = state.fragment.copy()
    fragments[rows] = fragment[:, 0]
    means = np.cumsum(position, axis=0) * step["position"]
    alive = state.alive.copy()
    alive[rows] = True
    return replace(
        state,
        alive=alive,
        fragment=fragments,
        means=_put(state.means, rows, means),
        quats=_put(state.quats, rows, _quaternions(largest[:, 0], small)),
        levels=_put(state.levels, rows, born[rows] + levels),
    )


def _put(values: NDArray[Any], rows: Ints, new: NDArray[Any]) -> NDArray[Any]:
    values = values.copy()
    values[rows] = new
    return values


def _coefficients(words: Ints) -> Floats:
    """Predictor [7, 3] from 21 float32 as int32."""
    return words.astype(np.int32).view(np.float32).astype(np.float64).reshape(7, 3)


def _quaternions(largest: Ints, small: Ints) -> Floats:
    """Unit ``wxyz`` from the number of the largest component and levels of the others."""
    rest = small / (QUATERNION_LEVELS * np.sqrt(2.0))
    quats = np.zeros((len(rest), 4))
    np.put_along_axis(quats, PLACES[largest], rest, axis=1)
    left = np.sqrt(np.clip(1.0 - (rest**2).sum(axis=1), 0.0, None))
    np.put_along_axis(quats, largest[:, None], left[:, None], axis=1)
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)


def predict(
    before: State, fragment: Ints, rows: Ints, predictors: dict[int, Floats]
) -> tuple[Floats, Floats]:
    """Where rows that stay alive are expected, [n, 3], and how turned, ``wxyz`` [n, 4]."""
    means, quats = before.means[rows].copy(), before.quats[rows].copy()
    moved = before.moved[rows]
    of = fragment[rows]
    for number, matrix in predictors.items():
        mine = of == number
        means[mine] = means[mine] @ matrix[:3] + moved[mine] @ matrix[3:6] + matrix[6]
        left, _, right = np.linalg.svd(matrix[:3].T)
        if np.linalg.det(left @ right) < 0:
            left[:, 2] *= -1.0
        quats[mine] = multiply(matrix_to_quaternion(left @ right)[None], quats[mine])
    return means, quats


def multiply(a: Floats, b: Floats) -> Floats:
    """Hamilton product of quaternions ``wxyz``, normalised."""
    product = hamilton(a, b)
    return product / np.linalg.norm(product, axis=1, keepdims=True)


def hamilton(a: Floats, b: Floats) -> Floats:
    """Hamilton product of quaternions ``wxyz``."""
    w, x, y, z = a.T
    q, r, s, t = b.T
    return np.stack(
        [
            w * q - x * r - y * s - z * t,
            w * r + x * q + y * t - z * s,
            w * s - x * t + y * q + z * r,
            w * t + x * s - y * r + z * q,
        ],
        axis=1,
    )


def rotation_to_quaternion(vectors: Floats) -> Floats:
    """Rotation vectors [rad] [n, 3] to quaternions ``wxyz``."""
    angle = np.linalg.norm(vectors, axis=1, keepdims=True)
    half = np.sinc(angle / (2.0 * np.pi)) / 2.0  # sin(angle / 2) / angle
    quats: Floats = np.concatenate([np.cos(angle / 2.0), half * vectors], axis=1)
    return quats


def matrix_to_quaternion(matrix: Floats) -> Floats:
    """A rotation matrix to ``wxyz``: the eigenvector of Bar-Itzhack's matrix (2000)."""
    m = matrix
    k = np.array(
        [
            [m[0, 0] + m[1, 1] + m[2, 2], 0.0, 0.0, 0.0],
            [m[2, 1] - m[1, 2], m[0, 0] - m[1, 1] - m[2, 2], 0.0, 0.0],
            [m[0, 2] - m[2, 0], m[0, 1] + m[1, 0], m[1, 1] - m[0, 0] - m[2, 2], 0.0],
            [m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], m[2, 2] - m[0, 0] - m[1, 1]],
        ]
    )
    vector: Floats = np.linalg.eigh(k)[1][:, -1]  # the lower triangle is what eigh reads
    return vector if vector[0] >= 0 else -vector
