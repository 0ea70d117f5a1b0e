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
from gsfluent.io.atomic import atomic_path

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
    order = torch.argsort(-host.scales.prod(dim=1) * host.opacities, stable=True)
    host = host.select(order)
    rows = np.zeros(host.count, dtype=_ROW)
    rows["position"], rows["scale"] = host.means.numpy(), host.scales.numpy()
    rgba = torch.cat([host.colors().clamp(max=1.0), host.opacities[:, None]], dim=1).numpy()
    rows["rgba"] = np.round(rgba * 255.0)
    quats = geometry.normalize_quaternions(host.quats).numpy()
    rows["rotation"] = np.clip(np.round(quats * 128.0 + 128.0), 0, 255)
    with atomic_path(path) as part:
        part.write_bytes(rows.tobytes())
