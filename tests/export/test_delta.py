"""The delta file: what it keeps, how exactly, how small; and that damage is named, not played."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import struct
from pathlib import Path

import numpy as np
import pytest
import torch
from export_run import FPS, FRAMES, make_run, picture

from gsfluent import geometry
from gsfluent.data import Gaussians
from gsfluent.errors import InputError
from gsfluent.export.delta import delta_frame
from gsfluent.export.frames import FrameSequence
from gsfluent.export.write import ExportOptions, export
from gsfluent.io import axes
from gsfluent.io.axes import nearest_axes
from gsfluent.io.splats import delta, delta_write
from gsfluent.io.splats.delta import DeltaFrame, DeltaReader, unpack_arrays
from gsfluent.io.splats.delta_write import Roster, bounds, pack_arrays, steps, write_delta
from gsfluent.metrics import psnr
from gsfluent.results.frames import load_frame

CPU = torch.device("cpu")


def random_frames(count: int = 11, splats: int = 300, seed: int = 0) -> list[DeltaFrame]:
    """Two pieces that spin and fly, one that shatters, births and deaths in every frame."""
    random = np.random.default_rng(seed)
    means = random.normal(size=(splats, 3)) * 0.1
    quats = random.normal(size=(splats, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    scales = np.exp(random.normal(size=(splats, 3)) * 0.6 - 5.0)
    f_dc = random.normal(size=(splats, 3))
    opacities = random.uniform(0.05, 1.0, splats)
    piece = random.integers(-1, 2, splats)
    ids = random.permutation(10 * splats)[:splats] - 5  # any order, some negative
    velocity = random.normal(size=(splats, 3))
    frames = []
    for index in range(count):
        time = index / 24
        turn = np.stack([np.cos(0.2 * index * (piece + 1)), *[np.zeros(splats)] * 2,
                         np.sin(0.2 * index * (piece + 1))], axis=1)  # fmt: skip
        moved = delta.multiply(turn, quats)
        matrix = geometry.quaternion_to_matrix(torch.from_numpy(turn)).numpy()
        where = (matrix @ means[..., None])[..., 0] + time * np.where(
            piece[:, None] < 0, velocity, [0.3, 0.1, 0.5]
        )
        # an eigen-decomposition names the axes as it likes
        wild = delta.multiply(random.permutation(moved), np.tile([1.0, 0, 0, 0], (splats, 1)))
        moved, sizes = nearest_axes(moved, scales * (1 + 0.1 * (piece[:, None] < 0) * time), wild)
        alive = random.uniform(size=splats) < 0.9
        colors = f_dc + (0.4 * index if index > 6 else 0.0)  # relit: the light changes
        columns = (where, moved, sizes, opacities, colors)
        frames.append(
            DeltaFrame(
                index,
                time,
                ids[alive],
                np.where(index > 4, piece, 0)[alive].astype(np.int32),
                *(column[alive].astype(np.float32) for column in columns),
            )
        )
    return frames


def write(path: Path, frames: list[DeltaFrame], key_every: int = 4, error: float = 1e-4) -> None:
    roster = Roster()
    for frame in frames:
        roster.meet(frame)
    times = [frame.time for frame in frames]
    write_delta(path, frames, roster, times=times, fps=24.0, step=steps(error), key_every=key_every)


def covariances(frame: DeltaFrame, rows: np.ndarray | slice = slice(None)) -> torch.Tensor:
    packed = geometry.covariance(
        torch.from_numpy(frame.quats[rows].astype(np.float64)),
        torch.from_numpy(frame.scales[rows].astype(np.float64)),
    )
    return geometry.unpack_symmetric(packed)


def check(got: DeltaFrame, truth: DeltaFrame, error: dict[str, float]) -> None:
    order = np.argsort(truth.ids)
    assert (got.ids == truth.ids[order]).all()
    assert (got.fragment == truth.fragment[order]).all()
    rounding = 1e-6
    assert np.abs(got.means - truth.means[order]).max() < error["position"] + rounding
    assert np.abs(got.opacities - truth.opacities[order]).max() < error["opacity"] + rounding
    assert np.abs(got.f_dc - truth.f_dc[order]).max() < error["f_dc"] + 1e-5
    wanted = covariances(truth, order)
    off = torch.linalg.matrix_norm(covariances(got) - wanted, ord=2)
    share = off / torch.linalg.matrix_norm(wanted, ord=2)
    assert float(share.max()) < error["covariance"]
    assert np.abs(np.linalg.norm(got.quats, axis=1) - 1).max() < 1e-6


def test_every_value_stays_within_the_stated_error(tmp_path: Path) -> None:
    frames = random_frames()
    write(tmp_path / "a.gsd", frames)
    reader = DeltaReader(tmp_path / "a.gsd")
    assert len(reader) == len(frames) and reader.header["fps"] == 24.0
    assert reader.header["error"] == bounds(steps(1e-4))
    for index, truth in enumerate(frames):
        got = reader.frame(index)
        assert got.time == truth.time
        check(got, truth, reader.header["error"])


def test_frames_come_in_any_order(tmp_path: Path) -> None:
    frames = random_frames()
    write(tmp_path / "a.gsd", frames)
    played = DeltaReader(tmp_path / "a.gsd")
    forward = [played.frame(index) for index in range(len(frames))]
    jumped = DeltaReader(tmp_path / "a.gsd")
    for index in (10, 3, 0, 7, 8, 5, 5, 1):
        for field in dataclasses.fields(DeltaFrame):
            mine, other = (
                getattr(jumped.frame(index), field.name),
                getattr(forward[index], field.name),
            )
            assert np.array_equal(mine, other), (index, field.name)
    with pytest.raises(IndexError):
        jumped.frame(len(frames))


def test_rigid_pieces_in_free_flight_cost_next_to_nothing(tmp_path: Path) -> None:
    random = np.random.default_rng(1)
    frames = random_frames(8, 4000)
    piece = random.integers(0, 3, 4000).astype(np.int32)
    start = dataclasses.replace(
        frames[0],
        ids=np.arange(4000),
        fragment=piece,
        means=random.normal(size=(4000, 3)).astype(np.float32) * 0.1,
        quats=np.tile(np.float32([0.5, 0.5, 0.5, 0.5]), (4000, 1)),
        scales=np.exp(random.normal(size=(4000, 3)) - 5).astype(np.float32),
        opacities=np.ones(4000, np.float32),
        f_dc=np.zeros((4000, 3), np.float32),
    )
    flight = []
    for index in range(8):
        half = 0.1 * index * (1.0 + piece)
        turn = np.stack([np.cos(half), np.sin(half), 0 * half, 0 * half], axis=1)
        matrix = geometry.quaternion_to_matrix(torch.from_numpy(turn)).numpy()
        fall = np.array([0.1, 0.0, -0.02 * index]) * index
        flight.append(
            dataclasses.replace(
                start,
                means=((matrix @ start.means[..., None])[..., 0] + fall).astype(np.float32),
                quats=delta.multiply(turn, start.quats.astype(np.float64)).astype(np.float32),
            )
        )
    roster = Roster()
    for frame in flight:
        roster.meet(frame)
    spent = write_delta(
        tmp_path / "a.gsd", flight, roster, times=[0.1 * i for i in range(8)], fps=10.0,
        step=steps(1e-4),
    )  # fmt: skip
    # a .ply of SH degree 0 takes 68 bytes a splat, quantised values without prediction about 12
    assert spent["delta"] < 1.0 * spent["splat_frames"]
    reader = DeltaReader(tmp_path / "a.gsd")
    check(reader.frame(7), flight[7], reader.header["error"])


def test_a_run_goes_there_and_back(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", degree=0)
    export(run, ["delta"], device=CPU, to=tmp_path, options=ExportOptions(key_every=3))
    reader = DeltaReader(tmp_path / "splats.gsd")
    assert reader.header["fps"] == pytest.approx(FPS)
    for place, moment in enumerate(FrameSequence(run)):
        check(reader.frame(place), delta_frame(moment, place), reader.header["error"])
    export(tmp_path / "splats.gsd", ["ply-seq"], device=CPU)
    from gsfluent.io import load_splats

    back = load_splats(tmp_path / "splats" / "frames" / f"frame_{FRAMES:04d}.ply")
    truth = load_frame(run / "stages" / "simulate", FRAMES - 1).gaussians
    assert psnr(picture(back), picture(truth)) > 42.0
    assert back.count == truth.count
    with pytest.raises(InputError, match="splats only"):
        export(tmp_path / "splats.gsd", ["vtk"], device=CPU)


@pytest.mark.parametrize("share", [0.0, 0.001, 0.01, 0.3, 0.6, 0.9, 0.999])
def test_a_truncated_file_is_named(tmp_path: Path, share: float) -> None:
    write(tmp_path / "a.gsd", random_frames(6, 100))
    whole = (tmp_path / "a.gsd").read_bytes()
    cut = tmp_path / "cut.gsd"
    cut.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(InputError, match=r"cut\.gsd: (the file ends|not a delta)"):
        DeltaReader(cut)


def test_no_damaged_byte_goes_unnoticed(tmp_path: Path) -> None:
    frames = random_frames(6, 40)
    write(tmp_path / "a.gsd", frames, key_every=3)
    whole = (tmp_path / "a.gsd").read_bytes()
    body = 16 + struct.unpack_from("<I", whole, 12)[0]
    hurt = tmp_path / "hurt.gsd"
    for at in [*range(0, 16), *range(body, len(whole), 97)]:
        changed = bytearray(whole)
        changed[at] ^= 0x5A
        hurt.write_bytes(changed)
        with pytest.raises(InputError, match=r"hurt\.gsd"):
            reader = DeltaReader(hurt)
            for index in range(len(reader)):
                reader.frame(index)


def test_damage_in_one_frame_spares_the_others(tmp_path: Path) -> None:
    frames = random_frames(9, 60)
    write(tmp_path / "a.gsd", frames, key_every=3)
    data = bytearray((tmp_path / "a.gsd").read_bytes())
    at = data.index(b"DELT" + struct.pack("<I", 4))
    data[at + 20] ^= 0xFF
    (tmp_path / "a.gsd").write_bytes(data)
    reader = DeltaReader(tmp_path / "a.gsd")
    check(reader.frame(3), frames[3], reader.header["error"])
    with pytest.raises(InputError, match="frame 4"):
        reader.frame(5)
    check(reader.frame(8), frames[8], reader.header["error"])


def test_the_reader_needs_numpy_only() -> None:
    for module in (delta, delta_write, axes):
        tree = ast.parse(inspect.getsource(module))
        names = {
            name.split(".")[0] if not name.startswith("gsfluent") else name
            for node in ast.walk(tree)
            for name in (
                [alias.name for alias in node.names] if isinstance(node, ast.Import)
                else [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            )
        }  # fmt: skip
        assert not names & {"torch", "scipy", "gsfluent.geometry", "gsfluent.data"}, module


def test_numbers_survive_packing() -> None:
    random = np.random.default_rng(3)
    arrays = [
        random.integers(-(10**k), 10**k, (random.integers(0, 9), 1 + k % 4)) for k in range(1, 18)
    ]
    arrays += [np.zeros((5, 2), np.int64), np.array([[2**62], [-(2**62)]])]
    back = unpack_arrays(pack_arrays(arrays))
    assert len(back) == len(arrays)
    assert all(np.array_equal(a, b) for a, b in zip(arrays, back, strict=True))


def test_axes_change_names_and_nothing_else() -> None:
    random = torch.Generator().manual_seed(5)
    quats = torch.nn.functional.normalize(torch.randn(200, 4, generator=random).double(), dim=1)
    scales = torch.rand(200, 3, generator=random).double() + 0.1
    wanted = torch.nn.functional.normalize(torch.randn(200, 4, generator=random).double(), dim=1)
    turned, sizes = nearest_axes(quats.numpy(), scales.numpy(), wanted.numpy())
    other = Gaussians(
        torch.zeros(200, 3).double(), torch.from_numpy(turned), torch.from_numpy(sizes),
        torch.ones(200).double(), torch.zeros(200, 1, 3).double(),
    ).covariances()  # fmt: skip
    assert torch.allclose(other, geometry.covariance(quats, scales), atol=1e-12)
    # the fundamental zone of the cube's rotations ends at 62.8 degrees (Mackenzie 1958)
    angle = 2 * np.arccos(np.clip((turned * wanted.numpy()).sum(1), -1, 1))
    assert np.degrees(angle).max() < 62.8


def test_too_little_to_write(tmp_path: Path) -> None:
    frames = random_frames(2, 10)
    with pytest.raises(InputError, match="key-every"):
        write(tmp_path / "a.gsd", frames, key_every=0)
    with pytest.raises(InputError, match="no splat"):
        write(tmp_path / "a.gsd", [])
    twice = dataclasses.replace(frames[0], ids=np.zeros_like(frames[0].ids))
    with pytest.raises(InputError, match="one id"):
        write(tmp_path / "a.gsd", [twice])
    assert list(tmp_path.iterdir()) == []
