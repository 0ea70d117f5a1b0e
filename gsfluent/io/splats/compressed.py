"""SuperSplat's compressed ``.ply``: 16 bytes per splat, quantised within chunks of 256.

Position and log scale: 11 + 10 + 11 bits between the chunk's limits; rotation: which of ``w, x, y,
z`` is largest (2 bits) and the other three in 10 bits each; colour and opacity: 8 bits each; SH
rest: one byte per coefficient over -4..4. Layout: PlayCanvas "compressed PLY" description.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gsfluent import geometry
from gsfluent.data.gaussians import Gaussians
from gsfluent.errors import InputError
from gsfluent.io.splats.morton import morton_order

_CHUNK = 256
_LIMITS = ("x", "y", "z", "scale_x", "scale_y", "scale_z")
_PLACES = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])  # what is kept of wxyz
_LOG_SCALE_LIMIT = 20.0


def is_compressed(data: dict[str, NDArray[Any]]) -> bool:
    """Tell whether PLY elements hold SuperSplat's compressed layout."""
    vertex = data.get("vertex")
    return (
        "chunk" in data and vertex is not None and "packed_position" in (vertex.dtype.names or ())
    )


def decode_compressed(path: Path, data: dict[str, NDArray[Any]]) -> Gaussians:
    """Decode the elements ``chunk``, ``vertex`` and, if present, ``sh``.

    Raises:
        InputError: Properties or rows are missing.
    """
    chunk, vertex, rest = data["chunk"], data["vertex"], data.get("sh")
    count = len(vertex)
    needed = [f"{side}_{name}" for side in ("min", "max") for name in _LIMITS]
    absent = [name for name in needed if name not in (chunk.dtype.names or ())]
    packed = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
    absent += [name for name in packed if name not in (vertex.dtype.names or ())]
    if absent or len(chunk) * _CHUNK < count or (rest is not None and len(rest) != count):
        got = (
            f"missing {', '.join(absent)}" if absent else f"{len(chunk)} chunks for {count} splats"
        )
        raise InputError(f"{path}: the compressed splat is incomplete ({got})", "export it again")
    wrong = [name for name in packed if vertex.dtype[name] != np.uint32]
    if wrong:
        raise InputError(
            f"{path}: {wrong[0]} must be uint, got {vertex.dtype[wrong[0]]}", "export it again"
        )
    limits = chunk[np.arange(count) // _CHUNK]
    position = _unpack_111011(vertex["packed_position"])
    scale = _unpack_111011(vertex["packed_scale"])
    color = np.stack(
        [(vertex["packed_color"] >> shift & 255) / 255.0 for shift in (24, 16, 8, 0)], axis=1
    )
    rgb = color[:, :3]
    if {f"{side}_{name}" for side in ("min", "max") for name in "rgb"} <= set(
        chunk.dtype.names or ()
    ):
        rgb = _between(limits, ("r", "g", "b"), rgb)
    sh = ((rgb - 0.5) / geometry.SH0)[:, None]
    if rest is not None:
        sh = np.concatenate([sh, _rest(path, rest)], axis=1)
    return Gaussians(
        means=float_tensor(_between(limits, ("x", "y", "z"), position)),
        quats=float_tensor(_unpack_rotation(vertex["packed_rotation"])),
        scales=float_tensor(np.exp(_between(limits, ("scale_x", "scale_y", "scale_z"), scale))),
        opacities=float_tensor(color[:, 3]),
        sh=float_tensor(sh),
    )


def float_tensor(values: NDArray[Any]) -> torch.Tensor:
    """As a tensor, float32."""
    return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32))


def _between(limits: NDArray[Any], names: tuple[str, ...], fraction: NDArray[Any]) -> NDArray[Any]:
    """Map fractions 0..1 [N, 3] between each row's limits."""
    low = np.stack([limits[f"min_{name}"].astype(np.float64) for name in names], axis=1)
    high = np.stack([limits[f"max_{name}"].astype(np.float64) for name in names], axis=1)
    return low + fraction * (high - low)


def _unpack_111011(packed: NDArray[Any]) -> NDArray[Any]:
    return np.stack(
        [(packed >> 21) / 2047.0, (packed >> 11 & 1023) / 1023.0, (packed & 2047) / 2047.0], axis=1
    )


def _unpack_rotation(packed: NDArray[Any]) -> NDArray[Any]:
    """Quaternions ``wxyz`` whose largest component was left out."""
    small = np.stack([(packed >> shift & 1023) / 1023.0 for shift in (20, 10, 0)], axis=1)
    small = (small - 0.5) * np.sqrt(2.0)
    largest = (packed >> 30).astype(np.int64)
    quats = np.zeros((len(packed), 4))
    places = _PLACES[largest]
    np.put_along_axis(quats, places, small, axis=1)
    missing = np.sqrt(np.clip(1.0 - (small**2).sum(axis=1), 0.0, None))
    np.put_along_axis(quats, largest[:, None], missing[:, None], axis=1)
    return quats


def _rest(path: Path, rows: NDArray[Any]) -> NDArray[Any]:
    """SH rest [N, K - 1, 3]; 0 and 255 are the ends of the range, others the middle of a step."""
    count = sum(1 for name in rows.dtype.names or () if name.startswith("f_rest_"))
    if count not in (9, 24, 45):
        raise InputError(
            f"{path}: element sh must have 9, 24 or 45 properties, got {count}", "export it again"
        )
    absent = [i for i in range(count) if f"f_rest_{i}" not in (rows.dtype.names or ())]
    if absent:
        raise InputError(f"{path}: element sh has no f_rest_{absent[0]}", "export it again")
    level = np.stack([rows[f"f_rest_{index}"].astype(np.float64) for index in range(count)], axis=1)
    fraction = np.where(level == 0, 0.0, np.where(level == 255, 1.0, (level + 0.5) / 256))
    values = (fraction - 0.5) * 8
    return values.reshape(len(rows), 3, count // 3).transpose(0, 2, 1)


def encode_compressed(gaussians: Gaussians, *, keep_order: bool = False) -> dict[str, NDArray[Any]]:
    """Encode splats as the elements ``chunk``, ``vertex`` and, above SH degree 0, ``sh``.

    A chunk's limits span 256 rows, so neighbours in the file should be neighbours in space.

    Args:
        gaussians: What to encode.
        keep_order: Leave the rows as they are; otherwise they are put along a Z-order curve.

    Returns:
        Elements for :func:`gsfluent.io.write_ply`, in the order that readers expect.
    """
    host = gaussians.to("cpu", torch.float64)
    if not keep_order:
        host = host.select(torch.from_numpy(morton_order(host.means.numpy())))
    count = host.count
    first = np.arange(0, count, _CHUNK)
    log_scale = host.scales.log().clamp(-_LOG_SCALE_LIMIT, _LOG_SCALE_LIMIT).numpy()
    values = {
        ("x", "y", "z"): host.means.numpy(),
        ("scale_x", "scale_y", "scale_z"): log_scale,
        ("r", "g", "b"): host.sh[:, 0].numpy() * geometry.SH0 + 0.5,
    }
    chunk = np.zeros(
        len(first),
        dtype=[
            (f"{side}_{n}", "<f4") for names in values for side in ("min", "max") for n in names
        ],
    )
    fractions = []
    for names, value in values.items():
        low, high = np.minimum.reduceat(value, first), np.maximum.reduceat(value, first)
        for axis, name in enumerate(names):
            chunk[f"min_{name}"], chunk[f"max_{name}"] = low[:, axis], high[:, axis]
        span = np.where(high > low, high - low, 1.0)
        rows = np.arange(count) // _CHUNK
        fractions.append((value - low[rows]) / span[rows])
    quats = geometry.normalize_quaternions(host.quats).numpy()
    opacity = host.opacities.numpy()[:, None]
    vertex = np.zeros(
        count,
        dtype=[(f"packed_{n}", "<u4") for n in ("position", "rotation", "scale", "color")],
    )
    vertex["packed_position"] = _pack(fractions[0], (11, 10, 11))
    vertex["packed_rotation"] = _pack_rotation(quats)
    vertex["packed_scale"] = _pack(fractions[1], (11, 10, 11))
    vertex["packed_color"] = _pack(np.concatenate([fractions[2], opacity], axis=1), (8, 8, 8, 8))
    data = {"chunk": chunk, "vertex": vertex}
    if host.sh.shape[1] > 1:
        rest = host.sh[:, 1:].transpose(1, 2).reshape(count, -1).numpy()
        columns = [(f"f_rest_{index}", "u1") for index in range(rest.shape[1])]
        level = np.ascontiguousarray(np.clip(np.trunc((rest / 8 + 0.5) * 256), 0, 255), np.uint8)
        data["sh"] = level.view(columns)[:, 0]
    return data


def _pack(fractions: NDArray[Any], bits: tuple[int, ...]) -> NDArray[np.uint32]:
    """Fractions 0..1 [N, C] as whole numbers of so many bits, the first one highest."""
    packed = np.zeros(len(fractions), dtype=np.uint32)
    for column, width in enumerate(bits):
        level = np.floor(fractions[:, column] * ((1 << width) - 1) + 0.5)
        packed = (packed << np.uint32(width)) | np.clip(level, 0, (1 << width) - 1).astype(
            np.uint32
        )
    return packed


def _pack_rotation(quats: NDArray[Any]) -> NDArray[np.uint32]:
    """Unit quaternions ``wxyz`` without their largest component, which is made positive."""
    largest = np.abs(quats).argmax(axis=1)
    rows = np.arange(len(quats))
    quats = quats * np.where(quats[rows, largest] < 0, -1.0, 1.0)[:, None]
    small = np.take_along_axis(quats, _PLACES[largest], axis=1)
    packed = _pack(small / np.sqrt(2.0) + 0.5, (10, 10, 10))
    return packed | (largest.astype(np.uint32) << np.uint32(30))
