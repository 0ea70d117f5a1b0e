"""Animated meshes of glTF 2.0: nodes that move, skins, and morph targets.

Formulas: Khronos, glTF 2.0 specification, sections 3.7.3 (skins, morph targets) and Appendix C
(interpolation). Vertices are given in the scene, +y up, metres.
"""

from __future__ import annotations

import base64
import binascii
import struct
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from gsfluent.errors import InputError
from gsfluent.io.checked.files import parse_json, read_bytes, read_json
from gsfluent.io.checked.inside import inside
from gsfluent.io.checked.limits import within
from gsfluent.io.sequences.sequence import Sequence, checked, stacked

Array = NDArray[np.float64]
_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_AT_REST = {"translation": [0.0] * 3, "rotation": [0.0, 0.0, 0.0, 1.0], "scale": [1.0] * 3}
_DAMAGE = (LookupError, TypeError, ValueError, AttributeError, struct.error, RecursionError)


def read_gltf(path: Path, fps: float) -> Sequence:
    """Read the animation of a ``.glb`` or ``.gltf``, sampled at ``fps``.

    All animations of the file play together; all meshes become one, in the order of the nodes.

    Raises:
        InputError: Not such a file, damaged, or without a mesh or an animation.
    """
    hint = "export it again as glTF 2.0, with its animation and without Draco compression"
    try:
        return _Document(path).sequence(fps)
    except InputError:
        raise
    except _DAMAGE as error:
        raise InputError(f"{path}: no glTF animation that can be read ({error!r})", hint) from error


class _Document:
    """A file in memory."""

    def __init__(self, path: Path) -> None:
        self.path, self.binary = path, b""
        if path.suffix.lower() == ".gltf":
            self.json: dict[str, Any] = read_json(path)
        else:
            data = read_bytes(path)
            if data[:4] != b"glTF":
                raise InputError(f"{path}: is no binary glTF", "give a .glb of version 2")
            size = struct.unpack_from("<I", data, 12)[0]
            self.json = parse_json(data[20 : 20 + size].decode("utf-8"), path)
            if len(data) >= 28 + size:
                length = struct.unpack_from("<I", data, 20 + size)[0]
                self.binary = data[28 + size : 28 + size + length]
        self.buffers: dict[int, bytes] = {}
        self.nodes: list[dict[str, Any]] = self.json.get("nodes", [])

    def sequence(self, fps: float) -> Sequence:
        """The meshes at the times of the animation."""
        tracks = [
            (channel["target"], animation["samplers"][channel["sampler"]])
            for animation in self.json.get("animations", [])
            for channel in animation["channels"]
            if "node" in channel["target"]
        ]
        if not tracks:
            raise InputError(f"{self.path}: holds no animation", "export it with its animation")
        clocks = [self.values(sampler["input"])[:, 0] for _, sampler in tracks]
        first, last = min(c[0] for c in clocks), max(c[-1] for c in clocks)
        times = first + np.arange(int(np.floor((last - first) * fps + 1e-6)) + 1) / fps
        within("unpacked_bytes", 24 * len(times), self.path)
        moved: dict[int, dict[str, Array]] = {}
        for (target, sampler), clock in zip(tracks, clocks, strict=True):
            values = self.values(sampler["output"])
            kind = sampler.get("interpolation", "LINEAR")
            turns = target["path"] == "rotation"
            rows = _sampled(clock, values, times, kind, turns, target["path"] == "weights")
            moved.setdefault(int(target["node"]), {})[target["path"]] = rows
        frames, faces = self._meshes(moved, times)
        return checked(self.path, stacked(self.path, frames), times - first, faces)

    def _meshes(
        self, moved: dict[int, dict[str, Array]], times: Array
    ) -> tuple[list[Array], NDArray[np.int64]]:
        """Vertices of all meshes frame by frame, and their triangles."""
        drawn = [n for n in self._reached() if "mesh" in self.nodes[n]]
        if not drawn:
            raise InputError(f"{self.path}: holds no mesh", "export it with its meshes")
        shapes = {n: self._shape(self.nodes[n]["mesh"]) for n in drawn}
        faces, count = [], 0
        for n in drawn:
            faces.append(shapes[n][1] + count)
            count += len(shapes[n][0])
        within("unpacked_bytes", 24 * count * len(times), self.path)
        frames = []
        for k in range(len(times)):
            world = self._worlds({n: {p: v[k] for p, v in m.items()} for n, m in moved.items()})
            parts = []
            for n in drawn:
                rest, _, targets, joints, weights = shapes[n]
                mesh = self.json["meshes"][self.nodes[n]["mesh"]]
                share = self.nodes[n].get("weights", mesh.get("weights", [0.0] * len(targets)))
                share = moved.get(n, {}).get("weights", np.asarray([share] * (k + 1)))[k]
                points = rest + np.tensordot(np.asarray(share)[: len(targets)], targets, 1)
                if "skin" in self.nodes[n] and joints is not None:
                    points = self._skinned(self.nodes[n]["skin"], points, joints, weights, world)
                else:
                    points = points @ world[n][:3, :3].T + world[n][:3, 3]
                parts.append(points)
            frames.append(np.concatenate(parts))
        return frames, np.concatenate(faces)

    def _skinned(
        self, skin: int, points: Array, joints: Array, weights: Array, world: dict[int, Array]
    ) -> Array:
        made = self.json["skins"][skin]
        inverse = np.tile(np.eye(4), (len(made["joints"]), 1, 1))
        if "inverseBindMatrices" in made:  # columns first in the file
            inverse = self.values(made["inverseBindMatrices"]).reshape(-1, 4, 4).swapaxes(1, 2)
        bones = np.stack([world[j] for j in made["joints"]]) @ inverse
        map_ = np.einsum("nk,nkij->nij", weights, bones[joints.astype(np.int64)])
        return np.einsum("nij,nj->ni", map_[:, :3, :3], points) + map_[:, :3, 3]

    def _shape(self, mesh: int) -> tuple[Array, NDArray[np.int64], Array, Any, Any]:
        """Vertices, triangles, morph targets [M, N, 3], joints and weights of a mesh."""
        rest, faces, targets, joints, weights, count = [], [], [], [], [], 0
        for primitive in self.json["meshes"][mesh]["primitives"]:
            names = primitive["attributes"]
            points = self.values(names["POSITION"])
            if primitive.get("mode", 4) == 4:
                row = np.arange(len(points))[:, None]
                index = self.values(primitive["indices"]) if "indices" in primitive else row
                faces.append(index.astype(np.int64).reshape(-1, 3) + count)
            moves = [self.values(t["POSITION"]) for t in primitive.get("targets", [])]
            targets.append(np.stack(moves) if moves else np.zeros((0, len(points), 3)))
            sets = [k for k in range(8) if f"JOINTS_{k}" in names]
            if sets:
                joints.append(np.concatenate([self.values(names[f"JOINTS_{k}"]) for k in sets], 1))
                share = np.concatenate([self.values(names[f"WEIGHTS_{k}"]) for k in sets], 1)
                weights.append(share / share.sum(axis=1, keepdims=True))
            rest.append(points)
            count += len(points)
        return (
            np.concatenate(rest),
            np.concatenate(faces) if faces else np.zeros((0, 3), np.int64),
            np.concatenate(targets, axis=1),
            np.concatenate(joints) if joints else None,
            np.concatenate(weights) if weights else None,
        )

    def _reached(self) -> list[int]:
        """Nodes of the scene, parents first."""
        scenes = self.json.get("scenes")
        if not scenes:
            return list(range(len(self.nodes)))
        found, waiting = [], list(scenes[self.json.get("scene", 0)].get("nodes", []))
        while waiting:
            node = int(waiting.pop(0))
            if node in found:
                raise ValueError("a node below itself")
            found.append(node)
            waiting += self.nodes[node].get("children", [])
        return found

    def _worlds(self, moved: dict[int, dict[str, Any]]) -> dict[int, Array]:
        """Matrix to the scene of every node."""
        parent = {c: n for n, node in enumerate(self.nodes) for c in node.get("children", [])}
        known: dict[int, Array] = {}

        def world(n: int, depth: int = 0) -> Array:
            if depth > len(self.nodes):
                raise ValueError("a node below itself")
            if n not in known:
                own = _matrix(self.nodes[n], moved.get(n, {}))
                known[n] = world(parent[n], depth + 1) @ own if n in parent else own
            return known[n]

        return {n: world(n) for n in range(len(self.nodes))}

    def values(self, accessor: int) -> Array:
        """An accessor as [N, C]."""
        wanted = self.json["accessors"][accessor]
        width, count = _WIDTHS[wanted["type"]], int(wanted["count"])
        kind = np.dtype(_TYPES[wanted["componentType"]])
        within("unpacked_bytes", 8 * width * count, self.path)
        found = np.zeros((count, width))
        if "bufferView" in wanted:
            found = self._view(
                wanted["bufferView"], wanted.get("byteOffset", 0), kind, width, count
            )
        if "sparse" in wanted:
            sparse = wanted["sparse"]
            at, new, most = sparse["indices"], sparse["values"], int(sparse["count"])
            rows = self._view(
                at["bufferView"],
                at.get("byteOffset", 0),
                np.dtype(_TYPES[at["componentType"]]),
                1,
                most,
            )
            found[rows[:, 0].astype(np.int64)] = self._view(
                new["bufferView"], new.get("byteOffset", 0), kind, width, most
            )
        if wanted.get("normalized"):
            found = np.maximum(found / np.iinfo(kind).max, -1.0)
        return found

    def _view(self, number: int, start: int, kind: np.dtype[Any], width: int, count: int) -> Array:
        view = self.json["bufferViews"][number]
        data = self._buffer(int(view["buffer"]))
        begin = int(view.get("byteOffset", 0)) + int(start)
        step = int(view.get("byteStride", kind.itemsize * width))
        if count and (begin < 0 or begin + step * (count - 1) + kind.itemsize * width > len(data)):
            raise ValueError(f"values beyond the end of buffer {view['buffer']}")
        array = np.ndarray((count, width), kind, data, begin, (step, kind.itemsize))
        return array.astype(np.float64)

    def _buffer(self, number: int) -> bytes:
        if number not in self.buffers:
            uri = self.json["buffers"][number].get("uri")
            if uri is None:
                data = self.binary
            elif uri.startswith("data:"):
                try:
                    data = base64.b64decode(uri.split(",", 1)[1], validate=True)
                except binascii.Error as error:
                    raise ValueError(f"buffer {number}: {error}") from error
            else:
                data = read_bytes(inside(self.path.parent, unquote(uri), self.path))
            self.buffers[number] = data
        return self.buffers[number]


def _matrix(node: dict[str, Any], moved: dict[str, Any]) -> Array:
    """The matrix of a node within its parent."""
    if "matrix" in node and not moved:
        return np.asarray(node["matrix"], np.float64).reshape(4, 4).T
    part = {name: moved.get(name, node.get(name, rest)) for name, rest in _AT_REST.items()}
    x, y, z, w = np.asarray(part["rotation"], np.float64) / np.linalg.norm(part["rotation"])
    turn = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    matrix = np.eye(4)
    matrix[:3, :3] = turn * np.asarray(part["scale"], np.float64)
    matrix[:3, 3] = part["translation"]
    return matrix


def _sampled(
    clock: Array, values: Array, times: Array, kind: str, turns: bool, weights: bool
) -> Array:
    """Values of a track at some times, [T, C]."""
    keys = len(clock)
    cubic = kind == "CUBICSPLINE"
    if weights:  # all targets of a key follow each other
        values = values.reshape(keys * (3 if cubic else 1), -1)
    if cubic:
        values = values.reshape(keys, 3, -1)
    inside_ = np.clip(times, clock[0], clock[-1])
    left = np.clip(np.searchsorted(clock, inside_, side="right") - 1, 0, max(keys - 2, 0))
    right = np.minimum(left + 1, keys - 1)
    span = np.where(right > left, clock[right] - clock[left], 1.0)
    t = np.clip((inside_ - clock[left]) / span, 0.0, 1.0)[:, None]
    if cubic:
        span = span[:, None]
        a, b = values[left, 1], values[right, 1]
        out, come = span * values[left, 2], span * values[right, 0]
        t2, t3 = t * t, t * t * t
        mixed = (2 * t3 - 3 * t2 + 1) * a + (t3 - 2 * t2 + t) * out
        mixed += (3 * t2 - 2 * t3) * b + (t3 - t2) * come
    elif kind == "STEP":
        mixed = np.where(t >= 1.0, values[right], values[left])
    elif turns:
        mixed = _slerp(values[left], values[right], t)
    else:
        mixed = (1.0 - t) * values[left] + t * values[right]
    return mixed / np.linalg.norm(mixed, axis=1, keepdims=True) if turns else mixed


def _slerp(a: Array, b: Array, t: Array) -> Array:
    """Spherical interpolation of unit quaternions, the short way."""
    dot = (a * b).sum(axis=1, keepdims=True)
    b, dot = np.where(dot < 0, -b, b), np.minimum(np.abs(dot), 1.0)
    angle = np.arccos(dot)
    near = angle < 1e-6
    sine = np.where(near, 1.0, np.sin(angle))
    return np.asarray(
        np.where(near, 1 - t, np.sin((1 - t) * angle) / sine) * a
        + np.where(near, t, np.sin(t * angle) / sine) * b
    )
