"""Splats in Niantic's ``.spz``: gzip over planes of 8- to 24-bit numbers, versions 2 and 3.

After the header of 16 bytes: positions (24-bit fixed point), opacities, colours, log scales (8 bits
each), rotations (version 2: ``x, y, z`` in 8 bits; version 3: the smallest three of ``x, y, z, w``
in 10 bits), SH rest with the channel fastest. Axes: +x right, +y up, +z toward the viewer. Layout:
README of nianticlabs/spz.
"""

from __future__ import annotations

import gzip
import struct
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gsfluent import geometry
from gsfluent.data.gaussians import Gaussians
from gsfluent.errors import InputError
from gsfluent.io.atomic import atomic_path

_MAGIC = 0x5053474E
_COLOR_SCALE = 0.15
_HIGHEST = (1 << 23) - 1
_SH_BITS = (5, 4, 4)  # per degree: what the format's own writer keeps


def save_spz(gaussians: Gaussians, path: str | Path, *, version: int = 3) -> None:
    """Write splats as ``.spz``, atomically; normals and labels are left out.

    Fixed-point positions get as many fractional bits as fit (12 to 20), so an object of a few
    decimetres is stored to micrometres.

    Args:
        gaussians: What to write, in the axes of the format (+y up).
        path: Output file.
        version: 2 or 3.

    Raises:
        InputError: Another version, values no splat can have, or positions beyond the format.
        RunError: The disk is full.
    """
    if version not in (2, 3):
        raise InputError(f"spz version {version}", "give 2 or 3")
    host = gaussians.validated(f"save to {path}").to("cpu", torch.float64)
    means = host.means.numpy()
    reach = max(float(np.abs(means).max()), 1e-9)
    fraction = int(np.clip(np.floor(np.log2(_HIGHEST / reach)), 0, 20))
    if reach * 2.0**fraction > _HIGHEST:
        raise InputError(
            f"{path}: a splat lies {reach:.3g} from the origin", "move the scene to the origin"
        )
    fixed = np.round(means * 2.0**fraction).astype("<i4")
    quats = geometry.normalize_quaternions(host.quats).numpy()[:, [1, 2, 3, 0]]
    planes = [
        fixed.view(np.uint8).reshape(-1, 4)[:, :3],
        _byte(host.opacities.numpy() * 255.0),
        _byte((host.sh[:, 0].numpy() * _COLOR_SCALE + 0.5) * 255.0),
        _byte((np.log(host.scales.numpy()) + 10.0) * 16.0),
        _first_three(quats) if version == 2 else _smallest_three(quats),
        _rest(host.sh[:, 1:].numpy()),
    ]
    header = struct.pack("<IIIBBBB", _MAGIC, version, host.count, host.sh_degree, fraction, 0, 0)
    body = header + b"".join(np.ascontiguousarray(plane).tobytes() for plane in planes)
    with atomic_path(path) as part:
        # no time stamp: the same splats give the same file
        part.write_bytes(gzip.compress(body, compresslevel=6, mtime=0))


def _byte(values: NDArray[Any]) -> NDArray[np.uint8]:
    return np.clip(np.round(values), 0, 255).astype(np.uint8)


def _first_three(xyzw: NDArray[Any]) -> NDArray[np.uint8]:
    """``x, y, z`` of the quaternion with ``w >= 0``, -1..1 in a byte."""
    positive = xyzw * np.where(xyzw[:, 3:] < 0, -1.0, 1.0)
    return _byte(positive[:, :3] * 127.5 + 127.5)


def _smallest_three(xyzw: NDArray[Any]) -> NDArray[np.uint8]:
    """Number of the largest component (2 bits), then the others: sign and 9 bits of magnitude."""
    rows = np.arange(len(xyzw))
    largest = np.abs(xyzw).argmax(axis=1)
    xyzw = xyzw * np.where(xyzw[rows, largest] < 0, -1.0, 1.0)[:, None]
    packed = largest.astype(np.uint32)
    for component in range(4):
        value = xyzw[:, component]
        level = np.round(np.abs(value) * np.sqrt(2.0) * 511.0).clip(0, 511).astype(np.uint32)
        word = (value < 0).astype(np.uint32) << np.uint32(9) | level
        packed = np.where(largest == component, packed, packed << np.uint32(10) | word)
    return packed.astype("<u4").view(np.uint8).reshape(-1, 4)


def _rest(sh: NDArray[Any]) -> NDArray[np.uint8]:
    """SH rest [N, K - 1, 3], -1..1 in a byte, rounded to the bits that the degree keeps."""
    out = np.zeros(sh.shape, dtype=np.uint8)
    for degree, bits in enumerate(_SH_BITS, start=1):
        part = slice(degree * degree - 1, (degree + 1) ** 2 - 1)
        step = 1 << (8 - bits)
        level = np.round(sh[:, part] * 128.0) + 128.0
        out[:, part] = np.clip(np.floor((level + step / 2) / step) * step, 0, 255)
    return out
