"""Sequences of every format say the same motion: that of a closed form."""

from __future__ import annotations

import base64
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from gsfluent.errors import InputError
from gsfluent.io.sequences import read_sequence

FPS, COUNT = 10.0, 5
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
REST = np.array([[0.1, 0.0, 0.2], [1.0, 0.1, 0.0], [0.0, 1.2, 0.1], [0.2, 0.1, 0.9]])
TIMES = np.arange(COUNT) / FPS


def turn(angle: float) -> NDArray[np.float64]:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def truth() -> NDArray[np.float64]:
    """Turns about z and rises."""
    return np.stack([REST @ turn(0.3 * k).T + [0.0, 0.0, 0.05 * k] for k in range(COUNT)])


class Gltf:
    """A glTF file with its data in the text, written by hand."""

    def __init__(self) -> None:
        self.body, self.views, self.accessors = b"", [], []  # type: ignore[var-annotated]

    def add(self, values: Any, kind: str, code: int = 5126) -> int:
        data = np.asarray(values, {5126: "<f4", 5123: "<u2", 5121: "u1"}[code]).tobytes()
        self.views.append({"buffer": 0, "byteOffset": len(self.body), "byteLength": len(data)})
        self.accessors.append(
            {"bufferView": len(self.views) - 1, "componentType": code, "type": kind,
             "count": len(values)}
        )  # fmt: skip
        self.body += data + bytes(-len(data) % 4)
        return len(self.views) - 1

    def write(self, path: Path, **more: Any) -> Path:
        uri = "data:application/octet-stream;base64," + base64.b64encode(self.body).decode()
        document = {
            "asset": {"version": "2.0"}, "bufferViews": self.views, "accessors": self.accessors,
            "buffers": [{"uri": uri, "byteLength": len(self.body)}], **more,
        }  # fmt: skip
        path.write_text(json.dumps(document))
        return path


def node_animation(path: Path) -> Path:
    """The mesh under a node that turns, under one that rises."""
    file = Gltf()
    clock = file.add(TIMES, "SCALAR")
    rise = file.add([[0, 0, 0.05 * k] for k in range(COUNT)], "VEC3")
    half = [0.15 * k for k in range(COUNT)]
    spin = file.add([[0, 0, math.sin(h), math.cos(h)] for h in half], "VEC4")
    mesh = {"attributes": {"POSITION": file.add(REST, "VEC3")},
            "indices": file.add(FACES.reshape(-1, 1), "SCALAR", 5123)}  # fmt: skip
    return file.write(
        path,
        scene=0, scenes=[{"nodes": [0]}],
        nodes=[{"children": [1]}, {"mesh": 0}], meshes=[{"primitives": [mesh]}],
        animations=[{
            "samplers": [{"input": clock, "output": rise}, {"input": clock, "output": spin}],
            "channels": [{"sampler": 0, "target": {"node": 0, "path": "translation"}},
                         {"sampler": 1, "target": {"node": 1, "path": "rotation"}}],
        }],
    )  # fmt: skip


def skin_animation(path: Path) -> Path:
    """The mesh hangs on one bone that does all of it, bound away from the origin."""
    file = Gltf()
    clock = file.add(TIMES, "SCALAR")
    offset = np.array([0.3, -0.2, 0.1])
    inverse = np.eye(4)
    inverse[:3, 3] = -offset
    places = [turn(0.3 * k) @ offset + [0, 0, 0.05 * k] for k in range(COUNT)]
    move = file.add(places, "VEC3")
    half = [0.15 * k for k in range(COUNT)]
    spin = file.add([[0, 0, math.sin(h), math.cos(h)] for h in half], "VEC4")
    attributes = {
        "POSITION": file.add(REST, "VEC3"),
        "JOINTS_0": file.add([[0, 0, 0, 0]] * 4, "VEC4", 5121),
        "WEIGHTS_0": file.add([[1.0, 0, 0, 0]] * 4, "VEC4"),
    }
    bind = file.add([inverse.T.reshape(-1)], "MAT4")
    primitive = {
        "attributes": attributes,
        "indices": file.add(FACES.reshape(-1, 1), "SCALAR", 5123),
    }
    return file.write(
        path,
        scene=0, scenes=[{"nodes": [0, 1]}],
        nodes=[{"mesh": 0, "skin": 0}, {"translation": offset.tolist()}],
        meshes=[{"primitives": [primitive]}],
        skins=[{"joints": [1], "inverseBindMatrices": bind}],
        animations=[{
            "samplers": [{"input": clock, "output": move}, {"input": clock, "output": spin}],
            "channels": [{"sampler": 0, "target": {"node": 1, "path": "translation"}},
                         {"sampler": 1, "target": {"node": 1, "path": "rotation"}}],
        }],
    )  # fmt: skip


def morph_animation(path: Path) -> Path:
    """One target per frame, as exporters of simulations write them."""
    file = Gltf()
    moves = truth() - REST
    weights = np.eye(COUNT)
    primitive = {
        "attributes": {"POSITION": file.add(REST, "VEC3")},
        "indices": file.add(FACES.reshape(-1, 1), "SCALAR", 5123),
        "targets": [{"POSITION": file.add(move, "VEC3")} for move in moves],
    }
    clock, track = file.add(TIMES, "SCALAR"), file.add(weights.reshape(-1), "SCALAR")
    return file.write(
        path,
        scene=0, scenes=[{"nodes": [0]}], nodes=[{"mesh": 0}],
        meshes=[{"primitives": [primitive]}],
        animations=[{
            "samplers": [{"input": clock, "output": track}],
            "channels": [{"sampler": 0, "target": {"node": 0, "path": "weights"}}],
        }],
    )  # fmt: skip


def folder_of(path: Path, ending: str) -> Path:
    path.mkdir()
    for k, points in enumerate(truth()):
        file = path / f"frame_{k * 7}{ending}"  # by number, not by letters: 7 before 14
        if ending == ".npy":
            np.save(file, points)
        elif ending == ".ply":
            trimesh.PointCloud(points).export(file)
        else:
            trimesh.Trimesh(points, FACES, process=False).export(file)
    return path


def usd(path: Path) -> Path:
    """A mesh whose points turn under a transform that rises."""
    pytest.importorskip("pxr")
    from pxr import Gf, Usd, UsdGeom, Vt

    stage = Usd.Stage.CreateNew(str(path))
    stage.SetTimeCodesPerSecond(FPS)
    above = UsdGeom.Xform.Define(stage, "/above")
    lift = above.AddTranslateOp()
    mesh = UsdGeom.Mesh.Define(stage, "/above/mesh")
    mesh.GetFaceVertexCountsAttr().Set([3] * len(FACES))
    mesh.GetFaceVertexIndicesAttr().Set(FACES.reshape(-1).tolist())
    for k in range(COUNT):
        lift.Set(Gf.Vec3d(0, 0, 0.05 * k), k)
        points = (REST @ turn(0.3 * k).T).astype(np.float32)
        mesh.GetPointsAttr().Set(Vt.Vec3fArray.FromNumpy(points), k)
    stage.Save()
    return path


def vtk_series(path: Path) -> Path:
    pytest.importorskip("vtkmodules")
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

    rows = []
    for k, points in enumerate(truth()):
        data, places, cells = vtkPolyData(), vtkPoints(), vtkCellArray()
        places.SetData(numpy_to_vtk(points, deep=True))
        for face in FACES:
            cells.InsertNextCell(3, [int(i) for i in face])
        data.SetPoints(places)
        data.SetPolys(cells)
        writer = vtkXMLPolyDataWriter()
        writer.SetFileName(str(path.parent / f"step{k}.vtp"))
        writer.SetInputData(data)
        writer.Write()
        rows.append({"name": f"step{k}.vtp", "time": TIMES[k]})
    path.write_text(json.dumps({"file-series-version": "1.0", "files": rows}))
    return path


def npz(path: Path) -> Path:
    np.savez(path, positions=truth(), faces=FACES, times=TIMES)
    return path


def npy(path: Path) -> Path:
    np.save(path, truth())
    return path


CASES = {
    "npz": (lambda at: npz(at / "a.npz"), True),
    "npy": (lambda at: npy(at / "a.npy"), False),
    "folder of npy": (lambda at: folder_of(at / "f", ".npy"), False),
    "folder of ply": (lambda at: folder_of(at / "f", ".ply"), False),
    "folder of obj": (lambda at: folder_of(at / "f", ".obj"), True),
    "gltf nodes": (lambda at: node_animation(at / "a.gltf"), True),
    "gltf skin": (lambda at: skin_animation(at / "a.gltf"), True),
    "gltf morph": (lambda at: morph_animation(at / "a.gltf"), True),
    "usd": (lambda at: usd(at / "a.usda"), True),
    "vtk series": (lambda at: vtk_series(at / "a.vtk.series"), True),
}


@pytest.mark.parametrize("name", CASES)
def test_what_moves_is_read(name: str, tmp_path: Path) -> None:
    make, has_faces = CASES[name]
    read = read_sequence(make(tmp_path), FPS)
    np.testing.assert_allclose(read.positions, truth(), atol=2e-6)
    np.testing.assert_allclose(read.times, TIMES, atol=1e-6)
    assert (read.faces is not None) == has_faces
    if read.faces is not None:
        assert {tuple(sorted(f)) for f in read.faces} == {tuple(sorted(f)) for f in FACES.tolist()}


def test_a_glb_of_our_own_export_is_read(tmp_path: Path) -> None:
    from gsfluent.io.rigid import RigidMesh, save_rigid_glb

    half = np.array([0.15 * k for k in range(COUNT)])
    rotation = np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], axis=1)
    lift = np.stack([0 * half, 0 * half, 0.05 * np.arange(COUNT)], axis=1)
    corner = np.zeros((4, 3, 3)) + [0.0, 0.0, 1.0]
    mesh = RigidMesh(
        "m", REST.astype(np.float32), FACES, np.ones((4, 3), np.float32), corner[:, 0], corner,
        lift, rotation, np.ones(COUNT, bool),
    )  # fmt: skip
    save_rigid_glb(tmp_path / "a.glb", [mesh], TIMES.tolist())
    read = read_sequence(tmp_path / "a.glb", FPS)
    np.testing.assert_allclose(read.positions, truth(), atol=2e-6)


def test_between_keys_turns_are_interpolated_on_the_sphere(tmp_path: Path) -> None:
    read = read_sequence(node_animation(tmp_path / "a.gltf"), 2 * FPS)
    wanted = REST @ turn(0.45).T + [0.0, 0.0, 0.075]
    np.testing.assert_allclose(read.positions[3], wanted, atol=2e-6)


def spoilt(at: Path, name: str) -> Path:
    path = at / name
    if name == "shape.npy":
        np.save(path, np.zeros((3, 4)))
    elif name == "names.npz":
        np.savez(path, q=np.zeros(3))
    elif name == "faces.npz":
        np.savez(path, positions=truth(), faces=np.array([[0, 1, 9]]))
    elif name == "times.npz":
        np.savez(path, positions=truth(), times=TIMES[::-1])
    elif name == "nan.npy":
        np.save(path, np.full((2, 3, 3), np.nan))
    elif name == "still.gltf":
        Gltf().write(path)
    elif name == "short.gltf":
        file = Gltf()
        file.add(TIMES, "SCALAR")
        file.accessors[0]["count"] = 10**6
        file.write(path, nodes=[{}], animations=[{
            "samplers": [{"input": 0, "output": 0}],
            "channels": [{"sampler": 0, "target": {"node": 0, "path": "scale"}}]}])  # fmt: skip
    elif name == "cut.glb":
        path.write_bytes(b"glTF\x02\x00\x00\x00\x40\x00\x00\x00\xff\x00\x00\x00JSON{")
    elif name == "mixed":
        folder_of(path, ".npy")
        (path / "a.ply").write_text("")
    elif name == "counts":
        folder_of(path, ".npy")
        np.save(path / "frame_99.npy", np.zeros((2, 3)))
    elif name == "outside.pvd":
        path.write_text('<DataSet timestep="0" file="../../x.vtp"/>')
    return path


@pytest.mark.parametrize(
    "name",
    "shape.npy names.npz faces.npz times.npz nan.npy still.gltf short.gltf cut.glb mixed counts "
    "outside.pvd nowhere.npz".split(),
)
def test_what_is_no_sequence_is_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=name.split(".")[0]):
        read_sequence(spoilt(tmp_path, name))
