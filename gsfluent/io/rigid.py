"""Meshes that move rigidly, and how glTF 2.0 binary (``.glb``) holds them: a node each, animated.

A node that is not there has scale 0, since glTF has no visibility.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsfluent.colors import srgb_to_linear
from gsfluent.errors import InputError
from gsfluent.io.atomic import atomic_path
from gsfluent.io.gltf import container

_FLOAT, _BYTE, _INDEX = 5126, 5121, 5125
_ARRAY, _ELEMENTS = 34962, 34963
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


@dataclass(frozen=True, eq=False)
class RigidMesh:
    """A mesh and where it is at K times."""

    name: str  # A valid identifier
    vertices: NDArray[np.float32]  # [V, 3], around its own origin [m]
    faces: NDArray[np.int64]  # [F, 3], normals out
    colors: NDArray[np.float32]  # [V, 3] in 0..1, display values
    normals: NDArray[np.float64]  # Unit normals of vertices [V, 3]
    corner_normals: NDArray[np.float64]  # The same of corners [F, 3, 3], sharp at edges
    translation: NDArray[np.float64]  # [K, 3] in metres
    rotation: NDArray[np.float64]  # Unit quaternions wxyz [K, 4], of the same sign
    shown: NDArray[np.bool_]  # [K]


def save_rigid_glb(path: str | Path, meshes: Sequence[RigidMesh], times: Sequence[float]) -> None:
    """Write moving meshes as one ``.glb`` with one animation, atomically.

    Args:
        path: Output file.
        meshes: In the axes of the format (+y up).
        times: [s], ascending, K.

    Raises:
        InputError: No mesh or no time.
        RunError: The disk is full.
    """
    if not meshes or len(times) == 0:
        raise InputError(f"{path}: no mesh to write", "export a run that has some")
    file = _File()
    clock = file.add(np.asarray(times, "<f4")[:, None], limits=True)
    nodes: list[dict[str, Any]] = []
    forms, samplers, channels = [], [], []
    for number, mesh in enumerate(meshes):
        rgba = np.full((len(mesh.vertices), 4), 255, np.uint8)
        rgba[:, :3] = np.round(srgb_to_linear(mesh.colors) * 255.0)
        attributes = {
            "POSITION": file.add(mesh.vertices.astype("<f4"), _ARRAY, limits=True),
            "NORMAL": file.add(mesh.normals.astype("<f4"), _ARRAY),
            "COLOR_0": file.add(rgba, _ARRAY),
        }
        indices = file.add(mesh.faces.reshape(-1, 1).astype("<u4"), _ELEMENTS)
        primitive = {"attributes": attributes, "indices": indices, "material": 0}
        forms.append({"name": mesh.name, "primitives": [primitive]})
        scale = np.repeat(mesh.shown[:, None].astype("<f4"), 3, axis=1)
        turned = mesh.rotation[:, [1, 2, 3, 0]].astype("<f4")
        tracks = {"translation": mesh.translation.astype("<f4"), "rotation": turned, "scale": scale}
        # what does not play animations shows the first frame
        first = {name: [float(v) for v in values[0]] for name, values in tracks.items()}
        nodes.append({"name": mesh.name, "mesh": number, **first})
        for name, values in tracks.items():
            how = "STEP" if name == "scale" else "LINEAR"
            samplers.append({"input": clock, "output": file.add(values), "interpolation": how})
            target = {"node": number, "path": name}
            channels.append({"sampler": len(samplers) - 1, "target": target})
    document = {
        "asset": {"version": "2.0", "generator": "gsfluent"},
        "scene": 0,
        "scenes": [{"nodes": list(range(len(nodes)))}],
        "nodes": nodes,
        "meshes": forms,
        "materials": [{"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.8}}],
        "animations": [{"name": "pieces", "samplers": samplers, "channels": channels}],
        "buffers": [{"byteLength": len(file.body)}],
        "bufferViews": file.views,
        "accessors": file.accessors,
    }
    with atomic_path(path) as part:
        part.write_bytes(container(document, bytes(file.body)))


class _File:
    """The binary part, as it grows."""

    def __init__(self) -> None:
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []
        self.body = bytearray()

    def add(self, values: NDArray[Any], target: int | None = None, *, limits: bool = False) -> int:
        """Append values [N, C]; returns the number of their accessor."""
        view = {"buffer": 0, "byteOffset": len(self.body), "byteLength": values.nbytes}
        self.views.append(view if target is None else view | {"target": target})
        kind = {"u1": _BYTE, "u4": _INDEX}.get(values.dtype.str[1:], _FLOAT)
        accessor: dict[str, Any] = {
            "bufferView": len(self.views) - 1,
            "componentType": kind,
            "count": len(values),
            "type": _TYPES[values.shape[1]],
        }
        if kind == _BYTE:
            accessor["normalized"] = True
        if limits:
            accessor["min"] = [float(v) for v in values.min(axis=0)]
            accessor["max"] = [float(v) for v in values.max(axis=0)]
        self.accessors.append(accessor)
        self.body += np.ascontiguousarray(values).tobytes()
        self.body += bytes(-len(self.body) % 4)
        return len(self.accessors) - 1
