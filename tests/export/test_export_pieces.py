"""Export of pieces: opened again by trimesh and usd-core, their motion that of the frames."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from export_run import add_record, make_run
from partition_shapes import EDGE, cube, points_of, slabs

from gsfluent import geometry
from gsfluent.data import Frame
from gsfluent.errors import InputError, RunError
from gsfluent.export.write import export
from gsfluent.io import save_solid
from gsfluent.pipeline.matter.fragments import ranked
from gsfluent.results.frames import load_frame, save_frame
from gsfluent.results.partition import FILE, SavedBody, SavedPartition, SavedSplit, save_partition

FRAMES, SPLIT = 4, 2
CPU = torch.device("cpu")


def pose(piece: int, index: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Rotation and translation of a piece in a frame; all go together before the split."""
    own = piece + 1 if index >= SPLIT else 0
    half = 0.15 * index + 0.2 * own
    axis = torch.nn.functional.normalize(torch.tensor([1.0, 0.5 * own, 0.3]).double(), dim=0)
    quat = torch.cat([torch.tensor([np.cos(half)]), np.sin(half) * axis])
    shift = torch.tensor([0.1 * own, -0.05 * index, 0.4 - 0.07 * index]).double()
    return geometry.quaternion_to_matrix(quat[None])[0], shift


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cube that breaks into three in frame 2, with some points that fly off alone."""
    out = add_record(make_run(tmp_path_factory.mktemp("pieces")))
    solid, folder = cube(), out / "stages" / "simulate"
    (out / "stages" / "texture").mkdir(parents=True)
    save_solid(solid, out / "stages" / "texture" / "a cube.ply")
    rest, spacing = points_of(solid, EDGE / 10)
    piece = ranked(slabs(rest, 3), rest)[1]
    body = SavedBody(0, "a cube", Frame.identity(), spacing, 0.2)
    crumbs = torch.arange(0, len(rest), 50)
    saved = SavedPartition(
        rest, torch.zeros(len(rest), dtype=torch.int64), torch.ones(len(rest), dtype=torch.bool),
        crumbs, 1, (body,), (SavedSplit(0, SPLIT, torch.arange(len(rest)), piece),),
    )  # fmt: skip
    save_partition(folder, saved)
    for index in range(FRAMES):
        now = torch.empty_like(rest)
        for number in range(3):
            turn, shift = pose(number, index)
            rows = piece == number
            now[rows] = (rest[rows].double() @ turn.T + shift).float()
        now[crumbs] += 0.3 * index  # they must not pull their piece along
        count = len(rest)
        frame = load_frame(folder, index)
        save_frame(
            folder,
            replace(
                frame,
                positions=now,
                volumes=torch.full((count,), spacing**3),
                damage=torch.zeros(count),
                fragments=(piece * 7 if index >= SPLIT else 0 * piece).to(torch.int32),
                velocity=torch.zeros(count, 3),
                body=torch.zeros(count, dtype=torch.int32),
                material=torch.zeros(count, dtype=torch.int32),
            ),
        )
    return out


NAMES = [f"piece_{number:03d}_a_cube" for number in range(4)]


def of_gltf(path: Path) -> tuple[dict, bytes]:
    """The two parts of a binary glTF, by its specification."""
    data = path.read_bytes()
    assert struct.unpack("<4sII", data[:12]) == (b"glTF", 2, len(data))
    size, kind = struct.unpack("<II", data[12:20])
    assert kind == 0x4E4F534A
    return json.loads(data[20 : 20 + size]), data[28 + size :]


def track(document: dict, body: bytes, number: int) -> np.ndarray:
    accessor = document["accessors"][number]
    view = document["bufferViews"][accessor["bufferView"]]
    width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
    part = body[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
    return np.frombuffer(part, "<f4").reshape(-1, width)


def test_gltf_opens_in_trimesh_and_moves_as_the_frames_do(run: Path, tmp_path: Path) -> None:
    assert export(run, ["pieces-glb"], device=CPU, to=tmp_path) == {"pieces-glb": "pieces.glb"}
    scene = trimesh.load(tmp_path / "pieces.glb")
    assert sorted(scene.geometry) == NAMES
    volumes = {}
    for name, mesh in scene.geometry.items():
        assert mesh.is_watertight and mesh.is_winding_consistent
        volumes[name] = mesh.volume
    assert volumes[NAMES[0]] == pytest.approx(EDGE**3, rel=0.01)
    assert sum(volumes[n] for n in NAMES[1:]) == pytest.approx(volumes[NAMES[0]], rel=1e-4)
    document, body = of_gltf(tmp_path / "pieces.glb")
    tracks: dict[tuple[int, str], tuple[np.ndarray, np.ndarray]] = {}
    (animation,) = document["animations"]
    for channel in animation["channels"]:
        sampler = animation["samplers"][channel["sampler"]]
        times, values = (track(document, body, sampler[k]) for k in ("input", "output"))
        tracks[channel["target"]["node"], channel["target"]["path"]] = times[:, 0], values
        wanted = "STEP" if channel["target"]["path"] == "scale" else "LINEAR"
        assert sampler["interpolation"] == wanted
    assert np.allclose(tracks[0, "scale"][0], np.arange(FRAMES) / 25.0)
    shown = np.stack([tracks[n, "scale"][1][:, 0] for n in range(4)])
    assert np.array_equal(shown, [[1, 1, 0, 0]] + 3 * [[0, 0, 1, 1]])
    corners = rest_corners(document, body)
    upright = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    for number in range(4):
        for index in range(FRAMES):
            if shown[number, index]:
                quat = torch.from_numpy(tracks[number, "rotation"][1][index][[3, 0, 1, 2]].copy())
                turn = geometry.quaternion_to_matrix(quat[None].double())[0].numpy()
                here = corners[number] @ turn.T + tracks[number, "translation"][1][index]
                wanted = rest_places(run, number, number - 1, index) @ upright.T
                assert np.abs(here - wanted).max() < 2e-6


def rest_corners(document: dict, body: bytes) -> list[np.ndarray]:
    """Vertices of every node, around its own origin."""
    return [
        track(document, body, mesh["primitives"][0]["attributes"]["POSITION"]).astype(np.float64)
        for mesh in document["meshes"]
    ]


def rest_places(run: Path, number: int, piece: int, index: int) -> np.ndarray:
    """Where the vertices of a piece must be: its mesh moved as its points were."""
    from gsfluent.export.pieces import body_pieces
    from gsfluent.io import load_solid
    from gsfluent.results.partition import load_partition

    saved = load_partition(run / "stages" / "simulate")
    assert saved is not None
    solid = load_solid(run / "stages" / "texture" / "a cube.ply")
    found = list(body_pieces(saved, saved.bodies[0], solid))[number]
    turn, shift = pose(max(piece, 0), index)
    return found.mesh.vertices @ turn.numpy().T + shift.numpy()


def test_at_rest_faces_of_the_file_fit_bit_by_bit(run: Path, tmp_path: Path) -> None:
    # of the first frame: one pose for all of them
    export(run, ["pieces-glb"], device=CPU, to=tmp_path)
    document, body = of_gltf(tmp_path / "pieces.glb")
    from gsfluent.export.pieces import body_pieces
    from gsfluent.io import load_solid
    from gsfluent.results.partition import load_partition

    saved = load_partition(run / "stages" / "simulate")
    assert saved is not None
    solid = load_solid(run / "stages" / "texture" / "a cube.ply")
    pieces = list(body_pieces(saved, saved.bodies[0], solid))
    places = []
    for piece, local in zip(pieces, rest_corners(document, body), strict=True):
        middle = np.round(piece.mesh.vertices.mean(axis=0) / piece.step) * piece.step
        turned = np.stack([local[:, 0], -local[:, 2], local[:, 1]], axis=1)
        assert np.array_equal(turned + middle, piece.mesh.vertices)
        places.append({row.tobytes() for row in turned + middle})
    whole, *parts = places
    # what a part has not in common with the whole it has in common with another part
    for number, part in enumerate(parts):
        others = set().union(*(p for k, p in enumerate(parts) if k != number))
        assert len(part - whole) > 50 and part - whole <= others
    assert whole == whole & set().union(*parts)


@pytest.mark.parametrize("up", ["z", "y"])
def test_usd_opens_and_moves_as_the_frames_do(run: Path, tmp_path: Path, up: str) -> None:
    pytest.importorskip("pxr", reason="needs usd-core: pip install 'gsfluent[usd]'")
    from pxr import Usd, UsdGeom

    from gsfluent.export.job import ExportOptions

    options = ExportOptions(up=up)
    export(run, ["pieces-usd"], device=CPU, to=tmp_path, options=options)
    stage = Usd.Stage.Open(str(tmp_path / "pieces.usdc"))
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (1.0, FRAMES)
    prims = stage.GetPrimAtPath("/scene/pieces").GetChildren()
    assert [prim.GetName() for prim in prims] == NAMES
    axes = np.eye(3) if up == "z" else np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    for number, prim in enumerate(prims):
        mesh = UsdGeom.Mesh(prim)
        local = np.array(mesh.GetPointsAttr().Get(), np.float64)
        faces = np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
        assert trimesh.Trimesh(local, faces, process=False).is_watertight
        assert len(mesh.GetNormalsAttr().Get()) == faces.size
        assert len(mesh.GetDisplayColorAttr().Get()) == len(local)
        for index in range(FRAMES):
            code = index + 1.0
            there = (index < SPLIT) == (number == 0)
            assert (mesh.ComputeVisibility(code) == "inherited") == there
            if there:
                moved = np.array(mesh.ComputeLocalToWorldTransform(code))
                here = local @ moved[:3, :3] + moved[3, :3]
                wanted = rest_places(run, number, number - 1, index) @ axes.T
                assert np.abs(here - wanted).max() < 2e-6


def test_only_pieces_of_the_chosen_frames_are_written(run: Path, tmp_path: Path) -> None:
    from gsfluent.export.job import ExportOptions

    export(run, ["pieces-glb"], device=CPU, to=tmp_path, options=ExportOptions(frames="3"))
    assert len(trimesh.load(tmp_path / "pieces.glb").geometry) == 3


def test_a_run_without_pieces_is_refused_in_words(run: Path, tmp_path: Path) -> None:
    from gsfluent.export.job import ExportOptions

    out, to = add_record(make_run(tmp_path / "run")), tmp_path / "to"
    with pytest.raises(InputError, match="did not save how its solids were split"):
        export(out, ["pieces-glb"], device=CPU, to=to)
    record = json.loads((out / "run.json").read_text())
    record["shot"]["output"]["cracks"] = "gap"
    (out / "run.json").write_text(json.dumps(record))
    with pytest.raises(InputError, match=r"output\.cracks: gap"):
        export(out, ["pieces-glb"], device=CPU, to=to)
    (out / "stages" / "simulate" / FILE).write_bytes(b"no archive")
    with pytest.raises(RunError, match="no readable partition"):
        export(out, ["pieces-glb"], device=CPU, to=to)
    lit = ExportOptions(relit=True, light="1,-1,2")
    with pytest.raises(InputError, match="light cannot be baked"):
        export(run, ["pieces-glb"], device=CPU, to=to, options=lit)
    assert list(to.iterdir()) == []
