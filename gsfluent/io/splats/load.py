"""Gaussians from any splat file, and in INRIA-layout 3DGS ``.ply`` files.

Stored in a ``.ply``: log scales, logit opacities, quaternions ``wxyz``, ``f_dc`` and ``f_rest``
with the rest channel-major (all red, all green, all blue). Kerbl et al. 2023, reference
implementation's ``save_ply``.
"""

from __future__ import annotations

import logging
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gsfluent import geometry
from gsfluent.data.gaussians import Gaussians
from gsfluent.errors import InputError
from gsfluent.io.atomic import atomic_path
from gsfluent.io.splats.checkpoint import load_checkpoint
from gsfluent.io.splats.compressed import (
    decode_compressed,
    encode_compressed,
    float_tensor,
    is_compressed,
)
from gsfluent.io.splats.forge import converted
from gsfluent.io.splats.ksplat import load_ksplat
from gsfluent.io.splats.ply import read_ply, write_ply
from gsfluent.io.splats.sog import load_sog
from gsfluent.io.splats.splat import load_splat
from gsfluent.io.splats.spz import later_spz, load_spz, upright

logger = logging.getLogger(__name__)

_LOGIT_LIMIT = 20.0
"""Stored opacities are cut here: sigmoid(20) is 1 in float32, so opaque stays opaque."""

_REQUIRED = (
    "x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity",
    "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3",
)  # fmt: skip


def _load_spz(path: Path) -> Gaussians:
    """A ``.spz`` of any version; 4 by gaussforge."""
    packed = later_spz(path)
    if packed is None:
        return load_spz(path)
    with tempfile.TemporaryDirectory() as folder:
        plain = Path(folder) / "splats.ply"
        plain.write_bytes(converted(packed, "spz", "ply", path))
        return upright(load_splats(plain))


READERS = {
    ".splat": load_splat, ".spz": _load_spz, ".ksplat": load_ksplat, ".sog": load_sog,
    ".pt": load_checkpoint, ".ckpt": load_checkpoint,
}  # fmt: skip
"""Readers by the end of the name; all others are read as ``.ply``."""


def load_splats(path: str | Path) -> Gaussians:
    """Read a splat file as float32 on the CPU.

    A 3DGS ``.ply`` (INRIA or SuperSplat's compressed layout), ``.splat``, ``.spz``, ``.ksplat``,
    ``.sog``, or a checkpoint of gsplat or splatfacto (``.pt``, ``.ckpt``).

    Quaternions are normalised (trained files hold any length), opacities pass a sigmoid (some
    exporters write 400 for opaque) and scales an exponential. ``nx, ny, nz`` become normals unless
    all are zero; our own column ``label`` becomes labels; every other property is ignored.

    Args:
        path: The file.

    Returns:
        Gaussians in the file's own coordinates.

    Raises:
        InputError: Missing or truncated file, a property missing, no rows, NaN, or a scale of zero.
    """
    path = Path(path)
    reader = READERS.get(path.suffix.lower())
    if reader is not None:
        return reader(path)
    data = read_ply(path)
    if is_compressed(data):
        return decode_compressed(path, data).validated(str(path))
    vertex = data.get("vertex")
    if vertex is None:
        raise InputError(
            f"{path}: there is no element 'vertex', got {sorted(data) or 'none'}",
            "pass a 3DGS .ply file",
        )
    names = set(vertex.dtype.names or ())
    missing = [name for name in _REQUIRED if name not in names]
    if missing:
        kind = (
            "this looks like a point cloud or mesh, not splats; "
            if {"x", "y", "z"} <= names
            else ""
        )
        raise InputError(
            f"{path}: properties missing: {', '.join(missing)}", f"{kind}pass a trained 3DGS .ply"
        )
    scales = np.exp(_columns(vertex, "scale_0", "scale_1", "scale_2"))
    opacity = _columns(vertex, "opacity")[:, 0]
    gaussians = Gaussians(
        means=float_tensor(_columns(vertex, "x", "y", "z")),
        quats=_unit_quaternions(path, _columns(vertex, "rot_0", "rot_1", "rot_2", "rot_3")),
        scales=float_tensor(scales),
        opacities=float_tensor(_sigmoid(opacity)),
        sh=float_tensor(_harmonics(path, vertex)),
        labels=_labels(path, vertex),
        normals=_normals(vertex),
    )
    return gaussians.validated(str(path))


FORGED = {".ksplat": 2, ".sog": 3}
"""What gaussforge writes for us, by the end of the name, and its highest SH degree."""


def save_forged(gaussians: Gaussians, path: str | Path) -> None:
    """Write splats as ``.ksplat`` or ``.sog``, atomically; normals and labels are left out.

    A ``.ksplat`` has level 0: numbers as they are, colours and opacities in 8 bits. A ``.sog``
    has code books for scales and colours, found by clustering.

    Args:
        gaussians: What to write, in any axes; SH above :data:`FORGED` is left out.
        path: Output file.

    Raises:
        InputError: Another ending, no gaussforge, or values no splat can have.
        RunError: The disk is full.
    """
    path = Path(path)
    kind = path.suffix.lower()
    if kind not in FORGED:
        raise InputError(f"{path}: not a name of these", f"end it with {' or '.join(FORGED)}")
    degree = min(gaussians.sh_degree, FORGED[kind])
    with tempfile.TemporaryDirectory() as folder:
        plain = Path(folder) / "splats.ply"
        save_splats(gaussians.with_sh_degree(degree).replace(labels=None), plain)
        made = converted(plain.read_bytes(), "ply", kind[1:], path)
    with atomic_path(path) as part:
        part.write_bytes(made)


def save_splats(
    gaussians: Gaussians,
    path: str | Path,
    *,
    compressed: bool = False,
    keep_order: bool = False,
    extra: dict[str, NDArray[Any]] | None = None,
) -> None:
    """Write Gaussians as an INRIA-layout 3DGS ``.ply`` that other viewers open, atomically.

    ``nx, ny, nz`` hold the normals (zero without); labels, when present, go into one extra float
    property ``label`` at the end, which viewers that look properties up by name ignore.

    Args:
        gaussians: What to write; the values are checked first.
        path: Output file, ``.ply``.
        compressed: SuperSplat's layout of 16 bytes a splat instead, without normals and labels.
        keep_order: Leave the rows of a compressed file in their order, at some loss of precision.
        extra: More float properties [N] to put at the end; a compressed file has none.

    Raises:
        InputError: NaN, zero scale or no rows; nothing is written.
        RunError: The disk is full or the folder cannot be written.
    """
    gaussians.validated(f"save to {path}")
    if compressed:
        write_ply(path, encode_compressed(gaussians, keep_order=keep_order), ("gsfluent",))
        return
    host = gaussians.to("cpu", torch.float64)
    count, rest = host.count, host.sh[:, 1:].transpose(1, 2).reshape(host.count, -1).numpy()
    opacity = host.opacities.numpy()
    with np.errstate(divide="ignore"):
        logit = np.clip(np.log(opacity) - np.log1p(-opacity), -_LOGIT_LIMIT, _LOGIT_LIMIT)
    normals = np.zeros((count, 3)) if host.normals is None else host.normals.numpy()
    quats = geometry.normalize_quaternions(host.quats).numpy()
    blocks: list[tuple[list[str], NDArray[Any]]] = [
        (["x", "y", "z"], host.means.numpy()),
        (["nx", "ny", "nz"], normals),
        (["f_dc_0", "f_dc_1", "f_dc_2"], host.sh[:, 0].numpy()),
        ([f"f_rest_{index}" for index in range(rest.shape[1])], rest),
        (["opacity"], logit[:, None]),
        (["scale_0", "scale_1", "scale_2"], np.log(host.scales.numpy())),
        (["rot_0", "rot_1", "rot_2", "rot_3"], quats),
    ]
    if host.labels is not None:
        blocks.append((["label"], host.labels.numpy()[:, None]))
    blocks += [([name], np.asarray(values)[:, None]) for name, values in (extra or {}).items()]
    rows = np.zeros(count, dtype=[(name, "<f4") for names, _ in blocks for name in names])
    table = np.concatenate([values for _, values in blocks], axis=1).astype("<f4")
    rows = np.ascontiguousarray(table).view(rows.dtype)[:, 0]
    write_ply(path, {"vertex": rows}, comments=("gsfluent",))


def _columns(rows: NDArray[Any], *names: str) -> NDArray[np.float64]:
    """Stack named properties as float64 [N, len(names)]."""
    return np.stack([rows[name].astype(np.float64) for name in names], axis=1)


def _sigmoid(logit: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sigmoid that does not overflow for the 400 that exporters write."""
    small = np.exp(-np.abs(logit))
    return np.where(logit >= 0, 1.0, small) / (1.0 + small)


def _unit_quaternions(path: Path, quats: NDArray[np.float64]) -> torch.Tensor:
    bad = int((~np.isfinite(quats)).any(axis=1).sum())
    if bad:
        raise InputError(
            f"{path}: quaternions must be finite, got others in {bad} of {len(quats)} rows",
            "remove these rows or export the splat again",
        )
    zero = int((np.linalg.norm(quats, axis=1) == 0).sum())
    if zero:
        logger.warning("%s: %d quaternions of length zero read as no rotation", path, zero)
    return geometry.normalize_quaternions(torch.from_numpy(quats)).to(torch.float32)


def _harmonics(path: Path, rows: NDArray[Any]) -> NDArray[np.float64]:
    """Read f_dc and f_rest as [N, K, 3]."""
    rest = sum(1 for name in rows.dtype.names or () if name.startswith("f_rest_"))
    try:
        if rest % 3:
            raise ValueError
        geometry.sh_degree(rest // 3 + 1)
    except ValueError as error:
        raise InputError(
            f"{path}: f_rest must have 0, 9, 24 or 45 properties (SH degree 0 to 3), got {rest}",
            "export the splat again",
        ) from error
    constant = _columns(rows, "f_dc_0", "f_dc_1", "f_dc_2")[:, None]
    if not rest:
        return constant
    try:
        values = _columns(rows, *(f"f_rest_{index}" for index in range(rest)))
    except ValueError as error:
        raise InputError(
            f"{path}: f_rest properties are not numbered 0 to {rest - 1}", "export the splat again"
        ) from error
    return np.concatenate(
        [constant, values.reshape(len(rows), 3, rest // 3).transpose(0, 2, 1)], axis=1
    )


def _labels(path: Path, rows: NDArray[Any]) -> torch.Tensor | None:
    if "label" not in (rows.dtype.names or ()):
        return None
    values = rows["label"].astype(np.float64)
    if not np.isfinite(values).all() or (np.abs(values) > 2**24).any():
        raise InputError(
            f"{path}: label must hold small whole numbers",
            "write the file again without that property",
        )
    return torch.from_numpy(np.rint(values).astype(np.int32))


def _normals(rows: NDArray[Any]) -> torch.Tensor | None:
    if not {"nx", "ny", "nz"} <= set(rows.dtype.names or ()):
        return None
    values = _columns(rows, "nx", "ny", "nz")
    if not np.isfinite(values).all() or not values.any():
        return None
    return float_tensor(values)
