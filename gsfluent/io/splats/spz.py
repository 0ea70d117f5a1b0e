"""Splats in Niantic's ``.spz``: gzip over planes of 8- to 24-bit numbers, versions 2 and 3.

After the header of 16 bytes: positions (24-bit fixed point), opacities, colours, log scales (8 bits
each), rotations (version 2: ``x, y, z`` in 8 bits; version 3: the smallest three of ``x, y, z, w``
in 10 bits), SH rest with the channel fastest. Axes: +x right, +y up, +z toward the viewer. Layout:
README of nianticlabs/spz.
"""

from __future__ import annotations

import gzip
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gsfluent import geometry
from gsfluent.data.frame import Frame
from gsfluent.data.gaussians import Gaussians
from gsfluent.errors import InputError
from gsfluent.io.atomic import atomic_path
from gsfluent.io.checked.files import read_bytes
from gsfluent.io.checked.limits import unpacked_limit, within
from gsfluent.io.splats.compressed import float_tensor

_MAGIC = 0x5053474E
_COLOR_SCALE = 0.15
_HIGHEST = (1 << 23) - 1
_HEADER = struct.Struct("<IIIBBBB")
_AGAIN = "convert it to .ply, for example with splat-transform (npm)"
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
    header = _HEADER.pack(_MAGIC, version, host.count, host.sh_degree, fraction, 0, 0)
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


def load_spz(path: str | Path) -> Gaussians:
    """Read a ``.spz`` of version 2 or 3, as float32 on the CPU.

    The axes are turned to those of a trained ``.ply`` (+y down, +z away from the viewer), so that
    a splat has the same axes in either file.

    Raises:
        InputError: Missing, damaged, of another version, or above the limit of unpacked bytes.
    """
    packed = read_bytes(path)
    most = unpacked_limit(len(packed))
    unpacker = zlib.decompressobj(wbits=31)
    try:
        data = unpacker.decompress(packed, most + 1)
    except zlib.error as error:
        raise InputError(f"{path}: is no .spz file ({error})", "export the splat again") from error
    within("unpacked_bytes", len(data), path, most)
    if len(data) < _HEADER.size:
        raise InputError(f"{path}: ends within its header", "export the splat again")
    magic, version, count, degree, fraction, _, _ = _HEADER.unpack_from(data)
    if magic != _MAGIC or version not in (2, 3) or degree > 3 or fraction > 24:
        said = f"version {version}, SH degree {degree}" if magic == _MAGIC else "another magic"
        raise InputError(f"{path}: cannot be read ({said})", _AGAIN)
    rest = (degree + 1) ** 2 - 1
    widths = (9, 1, 3, 3, version + 1 if version == 3 else 3, 3 * rest)
    if len(data) != _HEADER.size + count * sum(widths):
        raise InputError(
            f"{path}: {count} splats need {_HEADER.size + count * sum(widths)} bytes unpacked, "
            f"got {len(data)}",
            "export the splat again",
        )
    planes, at = [], _HEADER.size
    for width in widths:
        plane = np.frombuffer(data, np.uint8, count * width, at)
        planes.append(plane.reshape(count, width))
        at += count * width
    fixed, opacity, color, scale, turn, harmonics = planes
    wide = np.zeros((count, 3, 4), np.uint8)
    wide[..., 1:] = fixed.reshape(count, 3, 3)  # into the upper bytes: the shift keeps the sign
    means = (wide.view("<i4")[..., 0] >> 8) / 2.0**fraction
    quats = _of_first_three(turn) if version == 2 else _of_smallest_three(turn)
    sh = np.zeros((count, rest + 1, 3))
    sh[:, 0] = (color / 255.0 - 0.5) / _COLOR_SCALE
    sh[:, 1:] = (harmonics.reshape(count, rest, 3) - 128.0) / 128.0
    return upright(
        Gaussians(
            means=float_tensor(means),
            quats=float_tensor(quats[:, [3, 0, 1, 2]]),
            scales=float_tensor(np.exp(scale / 16.0 - 10.0)),
            opacities=float_tensor(opacity[:, 0] / 255.0),
            sh=float_tensor(sh),
        ).validated(str(path))
    )


def upright(splats: Gaussians) -> Gaussians:
    """The splats with their axes turned from +y up to those of a trained ``.ply``."""
    half_turn = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
    return splats.transformed(Frame(half_turn, torch.zeros(3), 1.0))


def later_spz(path: str | Path) -> bytes | None:
    """A file of version 4, whose planes are packed by zstd each; None for versions 2 and 3.

    Raises:
        InputError: Missing, of a still later version, or above the limit of unpacked bytes.
    """
    packed = read_bytes(path)
    if packed[:4] != _MAGIC.to_bytes(4, "little"):
        return None
    if len(packed) < _HEADER.size:
        raise InputError(f"{path}: ends within its header", "export the splat again")
    _, version, count, degree, *_ = _HEADER.unpack_from(packed)
    if version != 4 or degree > 3:
        raise InputError(f"{path}: cannot be read (version {version}, SH degree {degree})", _AGAIN)
    needs = count * (20 + 3 * ((degree + 1) ** 2 - 1))
    within("unpacked_bytes", needs, path, unpacked_limit(len(packed)))
    return packed


def _of_first_three(packed: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Unit quaternions ``xyzw`` with ``w >= 0``."""
    xyz = packed / 127.5 - 1.0
    w = np.sqrt(np.clip(1.0 - (xyz**2).sum(axis=1, keepdims=True), 0.0, None))
    quats = np.concatenate([xyz, w], axis=1)
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)


def _of_smallest_three(packed: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Unit quaternions ``xyzw`` whose largest component was left out."""
    word = np.ascontiguousarray(packed).view("<u4")[:, 0]
    largest = word >> 30
    quats = np.zeros((len(word), 4))
    for component in (3, 2, 1, 0):  # the last one stands in the lowest bits
        here = largest != component
        value = (word & 511) / (511.0 * np.sqrt(2.0)) * np.where(word >> 9 & 1, -1.0, 1.0)
        quats[here, component] = value[here]
        word = np.where(here, word >> np.uint32(10), word)
    missing = np.sqrt(np.clip(1.0 - (quats**2).sum(axis=1), 0.0, None))
    np.put_along_axis(quats, largest[:, None].astype(np.int64), missing[:, None], axis=1)
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)
