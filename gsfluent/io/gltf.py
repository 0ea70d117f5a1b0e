"""Splats in glTF 2.0 binary (``.glb``) with the extension KHR_gaussian_splatting.

Attributes of a point primitive: ``POSITION``, ``KHR_gaussian_splatting:ROTATION`` (``xyzw``),
``:SCALE`` (linear), ``:OPACITY`` (0..1), ``:SH_DEGREE_l_COEF_n``, and ``COLOR_0`` for viewers that
know only points. glTF has +y up.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsfluent import geometry
from gsfluent.colors import srgb_to_linear
from gsfluent.data.gaussians import Gaussians
from gsfluent.io.atomic import atomic_path

_EXTENSION = "KHR_gaussian_splatting"
_FLOAT, _BYTE = 5126, 5121
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
_JSON, _BIN = 0x4E4F534A, 0x004E4942


def save_glb(gaussians: Gaussians, path: str | Path) -> None:
    """Write splats as ``.glb``, atomically.

    Args:
        gaussians: What to write, in the axes of the format (+y up), metres.
        path: Output file.

    Raises:
        InputError: Values that no splat can have.
        RunError: The disk is full.
    """
    host = gaussians.validated(f"save to {path}").to("cpu", torch.float64)
    quats = geometry.normalize_quaternions(host.quats)
    linear = srgb_to_linear(host.colors().numpy())
    rgba = np.concatenate([linear, host.opacities[:, None].numpy()], axis=1)
    attributes: dict[str, np.ndarray] = {
        "POSITION": host.means.numpy().astype("<f4"),
        "COLOR_0": np.round(rgba * 255.0).astype(np.uint8),
        f"{_EXTENSION}:ROTATION": quats[:, [1, 2, 3, 0]].numpy().astype("<f4"),
        f"{_EXTENSION}:SCALE": host.scales.numpy().astype("<f4"),
        f"{_EXTENSION}:OPACITY": host.opacities.numpy().astype("<f4")[:, None],
    }
    for degree in range(host.sh_degree + 1):
        for number in range(2 * degree + 1):
            values = host.sh[:, degree * degree + number].numpy().astype("<f4")
            attributes[f"{_EXTENSION}:SH_DEGREE_{degree}_COEF_{number}"] = values
    document, body = _document(attributes)
    with atomic_path(path) as part:
        part.write_bytes(container(document, body))


def _document(attributes: dict[str, np.ndarray]) -> tuple[dict[str, Any], bytes]:
    """The JSON part and the binary part."""
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    body = bytearray()
    for values in attributes.values():
        views.append(
            {"buffer": 0, "byteOffset": len(body), "byteLength": values.nbytes, "target": 34962}
        )
        accessor: dict[str, Any] = {
            "bufferView": len(views) - 1,
            "componentType": _BYTE if values.dtype == np.uint8 else _FLOAT,
            "count": len(values),
            "type": _TYPES[values.shape[1]],
        }
        if values.dtype == np.uint8:
            accessor["normalized"] = True
        if len(accessors) == 0:  # the specification asks for the limits of POSITION
            accessor["min"] = [float(v) for v in values.min(axis=0)]
            accessor["max"] = [float(v) for v in values.max(axis=0)]
        accessors.append(accessor)
        body += values.tobytes()
        body += bytes(-len(body) % 4)
    primitive = {
        "mode": 0,
        "attributes": {name: index for index, name in enumerate(attributes)},
        "extensions": {_EXTENSION: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}},
    }
    document = {
        "asset": {"version": "2.0", "generator": "gsfluent"},
        "extensionsUsed": [_EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "splats"}],
        "meshes": [{"primitives": [primitive]}],
        "buffers": [{"byteLength": len(body)}],
        "bufferViews": views,
        "accessors": accessors,
    }
    return document, bytes(body)


def container(document: dict[str, Any], body: bytes) -> bytes:
    """The binary container: a header of 12 bytes, a JSON chunk, a binary chunk."""
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = (
        struct.pack("<II", len(text), _JSON) + text + struct.pack("<II", len(body), _BIN) + body
    )
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
