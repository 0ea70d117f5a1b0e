"""Splat files opened by readers that are not ours, and drawn beside the frame they are of."""

from __future__ import annotations

import gzip
import json
import re
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from export_run import CARRIED, FPS, FRAMES, LIVING, make_run, picture

from gsfluent import geometry
from gsfluent.data import Frame, Gaussians
from gsfluent.errors import InputError
from gsfluent.export.frames import upright
from gsfluent.export.write import FORMATS, ExportOptions, export
from gsfluent.metrics import psnr
from gsfluent.results.frames import frame_path, load_frame

CPU = torch.device("cpu")
LAST = FRAMES - 1


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_run(tmp_path_factory.mktemp("run"))


def write(run: Path, to: Path, kind: str, **options: Any) -> Path:
    export(run, [kind], device=CPU, to=to, options=ExportOptions(**options))
    return to


def frame(run: Path, index: int = LAST, degree: int = 0) -> Gaussians:
    return load_frame(run / "stages" / "simulate", index).gaussians.with_sh_degree(degree)


def same_picture(
    got: Gaussians, run: Path, bound: float, *, up: str = "z", degree: int = 0
) -> None:
    back = upright(up).inverse()
    value = psnr(picture(got.transformed(back)), picture(frame(run, degree=degree)))
    assert value > bound
    # the same splats with every rotation dropped are far off: the bound can tell
    still = got.replace(quats=torch.tensor([1.0, 0, 0, 0]).expand_as(got.quats).contiguous())
    assert psnr(picture(still.transformed(back)), picture(frame(run, degree=degree))) < 25.0


def of_rows(rows: Any, degree: int = 0) -> Gaussians:
    """INRIA rows to splats, by the paper's formulas."""

    def columns(*names: str) -> torch.Tensor:
        return torch.from_numpy(np.stack([np.asarray(rows[n], np.float32) for n in names], axis=1))

    count = (degree + 1) ** 2 - 1
    sh = columns("f_dc_0", "f_dc_1", "f_dc_2")[:, None]
    if count:
        rest = columns(*(f"f_rest_{i}" for i in range(3 * count)))
        sh = torch.cat([sh, rest.reshape(-1, 3, count).transpose(1, 2)], dim=1)
    return Gaussians(
        columns("x", "y", "z"),
        columns("rot_0", "rot_1", "rot_2", "rot_3"),
        columns("scale_0", "scale_1", "scale_2").exp(),
        columns("opacity")[:, 0].sigmoid(),
        sh,
    )


def ply_rows(path: Path) -> Any:
    import trimesh

    return trimesh.load(path).metadata["_ply_raw"]["vertex"]["data"]


def elements(path: Path) -> dict[str, np.ndarray]:
    """Binary PLY elements by the header alone (trimesh refuses vertices without x, y, z)."""
    head, _, body = path.read_bytes().partition(b"end_header\n")
    kinds = {"float": "<f4", "uint": "<u4", "uchar": "u1"}
    shapes: list[tuple[str, int, list[tuple[str, str]]]] = []
    for line in head.decode().splitlines():
        words = line.split()
        if words[0] == "element":
            shapes.append((words[1], int(words[2]), []))
        elif words[0] == "property":
            shapes[-1][2].append((words[2], kinds[words[1]]))
    found, at = {}, 0
    for name, count, columns in shapes:
        found[name] = np.frombuffer(body, np.dtype(columns), count, at)
        at += found[name].nbytes
    assert at == len(body)
    return found


def test_ply_sequence_plays(run: Path, tmp_path: Path) -> None:
    write(run, tmp_path, "ply-seq")
    # a player that is given the folder takes all that is in it
    names = sorted(path.name for path in (tmp_path / "frames").iterdir())
    assert len(names) == FRAMES
    # SuperSplat: one prefix, then a number, then .ply (file-handler.ts, isPlySequence)
    parts = [re.match(r"(.*?)(\d+)(?:\.compressed)?\.ply$", name) for name in names]
    assert {part[1] for part in parts if part} == {"frame_"}
    rows = ply_rows(tmp_path / "frames" / names[-1])
    # the INRIA order up to the rotation, SH degree 0
    assert list(rows.dtype.names) == [
        "x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity",
        "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3",
    ]  # fmt: skip
    same_picture(of_rows(rows), run, 100.0)


def test_ply_keeps_the_harmonics_and_says_what_a_splat_is(run: Path, tmp_path: Path) -> None:
    write(run, tmp_path, "ply-seq", sh=3, attributes=True, frames=str(LAST))
    rows = ply_rows(tmp_path / "frames" / f"frame_{FRAMES:04d}.ply")
    same_picture(of_rows(rows, degree=1), run, 100.0, degree=1)
    saved = load_frame(run / "stages" / "simulate", LAST)
    anchor = saved.anchor.long()
    assert (rows["fragment"] == saved.fragments[anchor].numpy()).all()
    assert (rows["material"] == saved.material[anchor].numpy()).all()


def test_another_axis_up_is_the_same_scene(run: Path, tmp_path: Path) -> None:
    write(run, tmp_path, "ply-seq", up="-y", sh=1)
    got = of_rows(ply_rows(tmp_path / "frames" / f"frame_{FRAMES:04d}.ply"), degree=1)
    same_picture(got, run, 100.0, up="-y", degree=1)
    # what was above is at smaller y
    assert np.corrcoef(got.means[:, 1], -frame(run).means[:, 2])[0, 1] > 0.999


def unpack(words: Any, bits: tuple[int, ...]) -> np.ndarray:
    shifts = [sum(bits[i + 1 :]) for i in range(len(bits))]
    levels = [(1 << b) - 1 for b in bits]
    columns = [(words >> s & m) / m for s, m in zip(shifts, levels, strict=True)]
    return np.stack(columns, axis=1)


def test_compressed_ply(run: Path, tmp_path: Path) -> None:
    write(run, tmp_path, "ply-seq", compressed=True)
    path = tmp_path / "frames_compressed" / f"frame_{FRAMES:04d}.compressed.ply"
    found = elements(path)
    assert list(found) == ["chunk", "vertex"]
    chunk, vertex = found["chunk"], found["vertex"]
    # the order that SuperSplat insists on (splat-transform, decompress-ply)
    axes = [f"{side}_{axis}" for side in ("min", "max") for axis in "xyz"]
    scales = [f"{side}_scale_{axis}" for side in ("min", "max") for axis in "xyz"]
    colors = [f"{side}_{axis}" for side in ("min", "max") for axis in "rgb"]
    assert list(chunk.dtype.names) == axes + scales + colors
    packed = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]
    assert list(vertex.dtype.names) == packed
    assert path.stat().st_size < 24 * len(vertex)
    row = np.arange(len(vertex)) // 256

    def between(names: list[str], part: np.ndarray) -> torch.Tensor:
        low = np.stack([chunk[n][row] for n in names[:3]], axis=1).astype(np.float64)
        high = np.stack([chunk[n][row] for n in names[3:]], axis=1).astype(np.float64)
        return torch.from_numpy((low + part * (high - low)).astype(np.float32))

    color = unpack(vertex["packed_color"], (8, 8, 8, 8))
    small = (unpack(vertex["packed_rotation"], (2, 10, 10, 10))[:, 1:] - 0.5) * 2**0.5
    quats = np.zeros((len(vertex), 4))
    for i, largest in enumerate(vertex["packed_rotation"] >> 30):
        rest = small[i]
        quats[i] = np.insert(rest, largest, np.sqrt(max(0.0, 1 - (rest**2).sum())))
    got = Gaussians(
        between(axes, unpack(vertex["packed_position"], (11, 10, 11))),
        torch.from_numpy(quats.astype(np.float32)),
        between(scales, unpack(vertex["packed_scale"], (11, 10, 11))).exp(),
        torch.from_numpy(color[:, 3].astype(np.float32)),
        geometry.rgb_to_sh0(between(colors, color[:, :3]))[:, None],
    )
    same_picture(got, run, 50.0)


def test_constant_order(run: Path, tmp_path: Path) -> None:
    write(run, tmp_path, "ply-seq", constant=True)
    everyone = sorted({i for ids in LIVING for i in ids})
    for index in range(FRAMES):
        rows = ply_rows(tmp_path / "frames" / f"frame_{index + 1:04d}.ply")
        assert len(rows["x"]) == CARRIED + len(everyone)
        alive = np.array([i in LIVING[index] for i in everyone])
        opacity = 1 / (1 + np.exp(-rows["opacity"][CARRIED:].astype(np.float64)))
        assert (opacity[~alive] < 1e-6).all() and (opacity[alive] > 0.2).all()
    same_picture(of_rows(rows), run, 100.0)


def read_spz(path: Path) -> Gaussians:
    """SPZ 2 and 3 as its README describes them."""
    data = gzip.decompress(path.read_bytes())
    magic, version, count, degree, fraction, flags, reserved = struct.unpack("<IIIBBBB", data[:16])
    assert (magic, flags, reserved) == (0x5053474E, 0, 0)
    at = 16

    def take(width: int) -> np.ndarray:
        nonlocal at
        block = np.frombuffer(data, np.uint8, count * width, at).reshape(count, width)
        at += count * width
        return block.astype(np.int64)

    raw = take(9).reshape(count, 3, 3)
    fixed = raw[..., 0] | raw[..., 1] << 8 | raw[..., 2] << 16
    means = np.where(fixed >= 1 << 23, fixed - (1 << 24), fixed) / (1 << fraction)
    alpha, color, scale = take(1)[:, 0] / 255, take(3), take(3) / 16 - 10
    quats = np.zeros((count, 4))  # x y z w
    if version == 2:
        quats[:, :3] = take(3) / 127.5 - 1
        quats[:, 3] = np.sqrt(np.clip(1 - (quats[:, :3] ** 2).sum(1), 0, None))
    else:
        words = take(4) @ np.array([1, 1 << 8, 1 << 16, 1 << 24])
        for i, word in enumerate(words):
            largest, total = word >> 30, 0.0
            for c in (3, 2, 1, 0):
                if c != largest:
                    value = 0.5**0.5 * (word & 511) / 511 * (-1 if word >> 9 & 1 else 1)
                    quats[i, c], total = value, total + value**2
                    word >>= 10
            quats[i, largest] = np.sqrt(max(0.0, 1 - total))
    coefficients = (degree + 1) ** 2 - 1
    rest = (take(3 * coefficients).reshape(count, coefficients, 3) - 128) / 128
    assert at == len(data)
    sh = np.concatenate([((color / 255 - 0.5) / 0.15)[:, None], rest], axis=1)
    parts = (means, quats[:, [3, 0, 1, 2]], np.exp(scale), alpha, sh)
    return Gaussians(*(torch.from_numpy(p.astype(np.float32)) for p in parts))


@pytest.mark.parametrize(("version", "bound"), [(2, 40.0), (3, 45.0)])
def test_spz(run: Path, tmp_path: Path, version: int, bound: float) -> None:
    write(run, tmp_path, "spz", spz_version=version, sh=1)
    got = read_spz(tmp_path / "spz" / f"frame_{FRAMES:04d}.spz")
    truth = frame(run).transformed(upright("y"))
    assert float((got.means - truth.means).abs().max()) < 1e-6
    assert float((got.scales / truth.scales).log().abs().max()) < 1 / 32 + 1e-4
    same_picture(got, run, bound, up="y", degree=1)


def test_splat(run: Path, tmp_path: Path) -> None:
    write(run, tmp_path, "splat")
    data = (tmp_path / "splat" / f"frame_{FRAMES:04d}.splat").read_bytes()
    assert len(data) % 32 == 0
    floats = np.frombuffer(data, "<f4").reshape(-1, 8)[:, :6]
    tail = np.frombuffer(data, np.uint8).reshape(-1, 32)[:, 24:].astype(np.float32)
    size = floats[:, 3:].prod(axis=1) * tail[:, 3]
    assert (np.diff(size) <= 0.01 * size[:-1]).all()  # the large ones first
    got = Gaussians(
        torch.from_numpy(floats[:, :3].copy()),
        torch.from_numpy((tail[:, 4:] - 128) / 128),
        torch.from_numpy(floats[:, 3:].copy()),
        torch.from_numpy(tail[:, 3] / 255),
        geometry.rgb_to_sh0(torch.from_numpy(tail[:, :3] / 255))[:, None],
    )
    same_picture(got, run, 50.0)


def test_glb(run: Path, tmp_path: Path) -> None:
    import trimesh

    write(run, tmp_path, "glb", sh=1)
    path = tmp_path / "glb" / f"frame_{FRAMES:04d}.glb"
    cloud = trimesh.load(path)
    vertices = np.concatenate([g.vertices for g in cloud.geometry.values()])
    data = path.read_bytes()
    magic, version, length, size, kind = struct.unpack("<4sIIII", data[:20])
    assert (magic, version, length, kind) == (b"glTF", 2, len(data), 0x4E4F534A)
    document = json.loads(data[20 : 20 + size])
    body = data[28 + size :]
    primitive = document["meshes"][0]["primitives"][0]
    assert primitive["mode"] == 0
    assert primitive["extensions"]["KHR_gaussian_splatting"]["kernel"] == "ellipse"
    assert "KHR_gaussian_splatting" in document["extensionsUsed"]

    def values(name: str) -> torch.Tensor:
        accessor = document["accessors"][primitive["attributes"][name]]
        view = document["bufferViews"][accessor["bufferView"]]
        assert accessor["componentType"] == 5126 and view["byteOffset"] % 4 == 0
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        block = np.frombuffer(body, "<f4", accessor["count"] * width, view["byteOffset"])
        return torch.from_numpy(block.reshape(-1, width).copy())

    own = "KHR_gaussian_splatting:"
    sh = [values(f"{own}SH_DEGREE_0_COEF_0")]
    sh += [values(f"{own}SH_DEGREE_1_COEF_{n}") for n in range(3)]
    got = Gaussians(
        values("POSITION"),
        values(f"{own}ROTATION")[:, [3, 0, 1, 2]],
        values(f"{own}SCALE"),
        values(f"{own}OPACITY")[:, 0],
        torch.stack(sh, dim=1),
    )
    assert np.allclose(np.sort(vertices, axis=0), np.sort(got.means.numpy(), axis=0), atol=1e-6)
    same_picture(got, run, 100.0, up="y", degree=1)


@pytest.mark.parametrize("ending", ["usdc", "usdz"])
def test_usd(run: Path, tmp_path: Path, ending: str) -> None:
    usd = pytest.importorskip("pxr.Usd")
    from pxr import UsdGeom, UsdVol

    write(run, tmp_path, "usd", usd_ending=ending, sh=1)
    stage = usd.Stage.Open(str(tmp_path / f"scene.{ending}"))
    assert UsdGeom.GetStageUpAxis(stage) == "Z" and UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert stage.GetTimeCodesPerSecond() == pytest.approx(FPS)
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (1.0, float(FRAMES))
    prim = UsdVol.ParticleField3DGaussianSplat(stage.GetPrimAtPath("/scene/splats"))
    time = float(FRAMES)
    quats = prim.GetOrientationsAttr().Get(time)
    wxyz = np.array([[q.GetReal(), *q.GetImaginary()] for q in quats], np.float32)
    degree = prim.GetRadianceSphericalHarmonicsDegreeAttr().Get()
    sh = np.array(prim.GetRadianceSphericalHarmonicsCoefficientsAttr().Get(time), np.float32)
    got = Gaussians(
        torch.from_numpy(np.array(prim.GetPositionsAttr().Get(time), np.float32)),
        torch.from_numpy(wxyz),
        torch.from_numpy(np.array(prim.GetScalesAttr().Get(time), np.float32)),
        torch.from_numpy(np.array(prim.GetOpacitiesAttr().Get(time), np.float32)),
        torch.from_numpy(sh.reshape(len(wxyz), (degree + 1) ** 2, 3)),
    )
    same_picture(got, run, 100.0, degree=1)
    counts = {len(prim.GetPositionsAttr().Get(float(t))) for t in range(1, FRAMES + 1)}
    assert len(counts) == 1
    low, high = prim.GetExtentAttr().Get(time)
    assert (np.array(low) < got.means.numpy().min(0)).all()
    assert (np.array(high) > got.means.numpy().max(0)).all()
    saved = load_frame(run / "stages" / "simulate", LAST)
    points = UsdGeom.Points(stage.GetPrimAtPath("/scene/particles"))
    assert np.allclose(points.GetPointsAttr().Get(time), saved.positions.numpy(), atol=1e-6)
    assert np.allclose(points.GetVelocitiesAttr().Get(time), saved.velocity.numpy(), atol=1e-3)
    volume = np.pi / 6 * np.array(points.GetWidthsAttr().Get(time), np.float64) ** 3
    assert volume.sum() == pytest.approx(0.2**3, rel=1e-4)
    fragment = UsdGeom.PrimvarsAPI(points).GetPrimvar("fragment").Get(time)
    assert (np.array(fragment) == saved.fragments.numpy()).all()
    # what USD's own validators have to say
    validation = pytest.importorskip("pxr.UsdValidation")
    validators = validation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 5
    problems = validation.ValidationContext(validators).Validate(stage)
    assert [problem.GetErrorAsString() for problem in problems] == []


def test_usd_takes_matter_that_is_poured(tmp_path: Path) -> None:
    usd = pytest.importorskip("pxr.Usd")
    from pxr import UsdGeom

    from gsfluent.io.usd import open_usd

    with open_usd(tmp_path / "jet.usda", fps=24.0, up="y") as stage:
        for frame in (1, 2, 3):
            where = np.random.default_rng(frame).normal(size=(10 * frame, 3))
            ones = np.ones(len(where))
            stage.points(float(frame), where, ones, where, {"damage": ones})
    stage = usd.Stage.Open(str(tmp_path / "jet.usda"))
    points = UsdGeom.Points(stage.GetPrimAtPath("/scene/particles"))
    for frame in (1, 2, 3):
        assert list(points.GetIdsAttr().Get(float(frame))) == list(range(10 * frame))
        assert len(points.GetPointsAttr().Get(float(frame))) == 10 * frame
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    with pytest.raises(InputError, match="no frame"), open_usd(tmp_path / "b.usda", fps=24.0):
        pass
    assert not (tmp_path / "b.usda").exists()


def test_an_interrupted_sequence_goes_on(run: Path, tmp_path: Path) -> None:
    (run / "stages" / "simulate" / "stage.json").write_text('{"fingerprint": "a"}')
    write(run, tmp_path, "spz")
    paths = sorted((tmp_path / "spz").glob("*.spz"))
    before = {path.name: path.stat().st_mtime_ns for path in paths}
    paths[1].unlink()
    write(run, tmp_path, "spz")
    after = {p.name: p.stat().st_mtime_ns for p in (tmp_path / "spz").glob("*.spz")}
    changed = {name for name in before if before[name] != after[name]}
    assert changed == {paths[1].name}
    # other options, or another simulation, write everything again
    write(run, tmp_path, "spz", spz_version=2)
    assert all(p.stat().st_mtime_ns != before[p.name] for p in paths)


def test_frames_that_are_no_more_do_not_play_on(tmp_path: Path) -> None:
    out = make_run(tmp_path / "run")
    write(out, tmp_path, "spz")
    frame_path(out / "stages" / "simulate", LAST).unlink()
    write(out, tmp_path, "spz")
    assert len(list((tmp_path / "spz").glob("*.spz"))) == FRAMES - 1


@pytest.mark.parametrize(
    ("kind", "options", "said"),
    [
        ("spzz", {}, "did you mean 'spz'"),
        ("alembic", {}, "use usd"),
        ("vdb", {}, "vti"),
        ("spz", {"frames": "9:3"}, "--frames"),
        ("spz", {"frames": "77"}, f"0 to {LAST}"),
        ("spz", {"frames": "a:b"}, "10:40"),
        ("spz", {"spz_version": 7}, "2 or 3"),
        ("ply-seq", {"up": "w"}, "--up"),
        ("ply-seq", {"sh": 4}, "--sh"),
        ("usd", {"up": "-y"}, "up axis"),
        ("usd", {"usd_parts": ("teapot",)}, "particles"),
    ],
)
def test_bad_requests(run: Path, tmp_path: Path, kind: str, options: Any, said: str) -> None:
    with pytest.raises(InputError, match=re.escape(said)):
        write(run, tmp_path, kind, **options)


def test_shots_can_ask_for_every_format_without_pictures() -> None:
    from gsfluent.config.settings import EXPORTS

    # meshes of pieces are asked of a finished run: not every shot has one that split
    assert set(EXPORTS) == {
        name
        for name, kind in FORMATS.items()
        if not kind.writer.startswith("pictures.") and not name.startswith("pieces-")
    }


def test_turns_are_turns() -> None:
    for up, vector in (("y", (0, 1, 0)), ("-y", (0, -1, 0)), ("z", (0, 0, 1))):
        turn: Frame = upright(up)
        assert turn.apply_vector(torch.tensor([0.0, 0.0, 1.0])).tolist() == list(vector)
