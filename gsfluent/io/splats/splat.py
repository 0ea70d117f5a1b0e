"""Splats in the 32-byte rows of the first web viewer (``.splat``): direction-independent colours.

Row: position and linear scale (3 + 3 float32), colour and opacity (4 bytes), quaternion ``wxyz``
(4 bytes, -1..1 as 0..255), largest splats first. Layout: antimatter15/splat.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from gsfluent import geometry
from gsfluent.data.gaussians import Gaussians
from gsfluent.errors import InputError
from gsfluent.io.atomic import atomic_path
from gsfluent.io.checked.files import read_bytes
from gsfluent.io.splats.compressed import float_tensor

_ROW = np.dtype(
    [("position", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)]
)


def save_splat(gaussians: Gaussians, path: str | Path) -> None:
    """Write splats as ``.splat``, atomically; only SH degree 0 is kept.

    Raises:
        InputError: Values that no splat can have.
        RunError: The disk is full.
    """
    host = gaussians.validated(f"save to {path}").to("cpu", torch.float64)
    # viewers that draw while they load show what matters first
    order = torch.argsort(-geometry.product(host.scales) * host.opacities, stable=True)
    host = host.select(order)
    rows = np.zeros(host.count, dtype=_ROW)
    rows["position"], rows["scale"] = host.means.numpy(), host.scales.numpy()
    rgba = torch.cat([host.colors().clamp(max=1.0), host.opacities[:, None]], dim=1).numpy()
    rows["rgba"] = np.round(rgba * 255.0)
    quats = geometry.normalize_quaternions(host.quats).numpy()
    rows["rotation"] = np.clip(np.round(quats * 128.0 + 128.0), 0, 255)
    with atomic_path(path) as part:
        part.write_bytes(rows.tobytes())


def load_splat(path: str | Path) -> Gaussians:
    """Read a ``.splat``, as float32 on the CPU.

    Raises:
        InputError: Missing, not whole rows, or values that no splat can have.
    """
    data = read_bytes(path)
    if not data or len(data) % _ROW.itemsize:
        raise InputError(
            f"{path}: {len(data)} bytes are no rows of {_ROW.itemsize}", "export the splat again"
        )
    rows = np.frombuffer(data, dtype=_ROW)
    quats = torch.from_numpy((rows["rotation"].astype(np.float64) - 128.0) / 128.0)
    return Gaussians.from_colors(
        float_tensor(rows["position"]),
        float_tensor(rows["scale"]),
        float_tensor(rows["rgba"][:, :3] / 255.0),
        opacities=float_tensor(rows["rgba"][:, 3] / 255.0),
        quats=geometry.normalize_quaternions(quats).to(torch.float32),
    ).validated(str(path))
