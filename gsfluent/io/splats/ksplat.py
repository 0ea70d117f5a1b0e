"""Splats in ``.ksplat``, the file of the three.js viewer GaussianSplats3D; read only.

A header of 4096 bytes, a header of 1024 bytes per section, then the sections. A section holds the
lengths of its last buckets, the middles of its buckets (3 float32), and its splats. Level 0 has
float32; levels 1 and 2 have positions in 16 bits around the middle of the splat's bucket, scales
and quaternions ``wxyz`` as float16, and SH rest as float16 or bytes. SH rest lies band by band,
the channel slowest. Layout: ``SplatBuffer`` of mkkellogg/GaussianSplats3D 0.4.7.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gsfluent import geometry
from gsfluent.data.gaussians import Gaussians
from gsfluent.errors import InputError
from gsfluent.io.checked.files import read_bytes
from gsfluent.io.splats.compressed import float_tensor

_HEADER, _SECTION_HEADER = 4096, 1024
_REST = (0, 9, 24)  # numbers of SH rest by degree
_TYPES = (("<f4", "<f4", "<f4"), ("<u2", "<f2", "<f2"), ("<u2", "<f2", "u1"))
"""By level: positions, scales and quaternions, SH rest."""

_SCALE_RANGE = (1, 32767, 32767)
_SH_RANGE = 1.5
_SMALLEST = 6e-8  # a scale that float16 rounded to zero


def load_ksplat(path: str | Path) -> Gaussians:
    """Read a ``.ksplat``, as float32 on the CPU.

    Sections of several SH degrees are read to the lowest one.

    Raises:
        InputError: Missing, damaged, of another version, or values that no splat can have.
    """
    data = read_bytes(path)
    try:
        return _read(path, data).validated(str(path))
    except (struct.error, ValueError, OverflowError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(
            f"{path}: the .ksplat is damaged ({error})", "export the splat again"
        ) from error


def _read(path: str | Path, data: bytes) -> Gaussians:
    major, minor = data[:2] if len(data) >= _HEADER else (0, 0)
    sections, level = struct.unpack_from("<I", data, 4)[0], struct.unpack_from("<H", data, 20)[0]
    if (major, minor) != (0, 1) or level >= len(_TYPES):
        raise InputError(
            f"{path}: is .ksplat version {major}.{minor}, level {level}, not 0.1 of level 0 to 2",
            "convert it to .ply, for example with splat-transform (npm)",
        )
    low, high = struct.unpack_from("<2f", data, 36)
    limits = (low or -_SH_RANGE, high or _SH_RANGE)
    at = _HEADER + sections * _SECTION_HEADER
    if at > len(data):
        raise ValueError(f"it announces {sections} sections")
    parts = []
    for number in range(sections):
        found, at = _section(data, _HEADER + number * _SECTION_HEADER, at, level, limits)
        parts.append(found)
    if not parts:
        raise ValueError("it has no section")
    lowest = min(part[4].shape[1] for part in parts)
    means, scales, quats, rgba = (np.concatenate([part[k] for part in parts]) for k in range(4))
    rest = np.concatenate([part[4][:, :lowest] for part in parts])
    sh = np.concatenate([((rgba[:, :3] / 255.0 - 0.5) / geometry.SH0)[:, None], rest], axis=1)
    return Gaussians(
        means=float_tensor(means),
        quats=geometry.normalize_quaternions(torch.from_numpy(quats)).to(torch.float32),
        scales=float_tensor(np.where(scales == 0, _SMALLEST, scales)),
        opacities=float_tensor(rgba[:, 3] / 255.0),
        sh=float_tensor(sh),
    )


def _section(
    data: bytes, header: int, at: int, level: int, limits: tuple[float, float]
) -> tuple[tuple[NDArray[Any], ...], int]:
    """Means, scales, quaternions, colours and SH rest of the section at ``at``, and its end."""
    count, room, size, buckets = struct.unpack_from("<4I", data, header)
    (block,) = struct.unpack_from("<f", data, header + 16)
    (width,) = struct.unpack_from("<H", data, header + 20)
    scale_range, _, full, partial = struct.unpack_from("<4I", data, header + 24)
    (degree,) = struct.unpack_from("<H", data, header + 40)
    if degree >= len(_REST):
        raise ValueError(f"SH degree {degree}")
    position, half, harmonic = _TYPES[level]
    row = np.dtype(
        [("position", position, 3), ("scale", half, 3), ("rotation", half, 4), ("rgba", "u1", 4),
         ("rest", harmonic, _REST[degree])]
    )  # fmt: skip
    rows_at = at + 4 * partial + width * buckets
    end = rows_at + row.itemsize * room
    if end > len(data) or count > room:
        raise ValueError(f"a section announces {room} splats and {buckets} buckets")
    rows = np.frombuffer(data, row, count or room, rows_at)
    means = rows["position"].astype(np.float64)
    if level:
        lengths = np.frombuffer(data, "<u4", partial, at).astype(np.int64)
        sizes = np.concatenate([np.full(min(full, buckets), size, np.int64), lengths])
        if width != 12 or len(sizes) != buckets or int(sizes.sum()) < len(rows):
            raise ValueError(f"{buckets} buckets do not hold {len(rows)} splats")
        middles = np.frombuffer(data, "<f4", 3 * buckets, at + 4 * partial).reshape(-1, 3)
        bucket = np.searchsorted(np.cumsum(sizes), np.arange(len(rows)), side="right")
        reach = scale_range or _SCALE_RANGE[level]
        means = (means - reach) * (0.5 * block / reach) + middles[bucket]
    rest = rows["rest"].astype(np.float64)
    if level == 2:
        rest = rest / 255.0 * (limits[1] - limits[0]) + limits[0]
    bands = [
        rest[:, 3 * (band**2 - 1) : 3 * ((band + 1) ** 2 - 1)]
        .reshape(len(rows), 3, 2 * band + 1)
        .transpose(0, 2, 1)
        for band in range(1, degree + 1)
    ]
    empty = np.zeros((len(rows), 0, 3))
    columns = (means, rows["scale"].astype(np.float64), rows["rotation"].astype(np.float64))
    return (*columns, rows["rgba"], np.concatenate([empty, *bands], axis=1)), end
