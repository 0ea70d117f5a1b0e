"""PLY container and 3DGS splat files."""

from __future__ import annotations

import errno
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import gsfluent
from gsfluent.data import Gaussians
from gsfluent.errors import InputError, RunError
from gsfluent.io import load_splats, read_ply, save_splats, write_ply


def make_gaussians(
    count: int, degree: int, seed: int = 0, labels: bool = False, normals: bool = False
) -> Gaussians:
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    return Gaussians(
        normal(count, 3),
        torch.nn.functional.normalize(normal(count, 4), dim=1),
        normal(count, 3).exp(),
        torch.rand(count, generator=generator),
        normal(count, (degree + 1) ** 2, 3),
        torch.arange(count, dtype=torch.int32) % 4 if labels else None,
        torch.nn.functional.normalize(normal(count, 3), dim=1) if normals else None,
    )


def assert_same(a: Gaussians, b: Gaussians) -> None:
    for name in ("means", "sh", "normals"):
        left, right = getattr(a, name), getattr(b, name)
        assert (left is None) == (right is None)
        if left is not None:
            assert torch.equal(left, right), name
    torch.testing.assert_close(a.scales, b.scales, rtol=1e-5, atol=0)
    torch.testing.assert_close(a.opacities, b.opacities, rtol=1e-5, atol=1e-8)
    torch.testing.assert_close(a.quats, b.quats, rtol=0, atol=2e-7)
    assert (a.labels is None) == (b.labels is None)
    assert a.labels is None or torch.equal(a.labels, b.labels)


def write_rows(path: Path, columns: dict[str, list[float]]) -> None:
    rows = np.zeros(len(next(iter(columns.values()))), dtype=[(name, "f4") for name in columns])
    for name, values in columns.items():
        rows[name] = values
    write_ply(path, {"vertex": rows})


def plain_columns(count: int = 3, rest: int = 0) -> dict[str, list[float]]:
    names = [
        "x",
        "y",
        "z",
        "f_dc_0",
        "f_dc_1",
        "f_dc_2",
        *(f"f_rest_{i}" for i in range(rest)),
        "opacity",
    ]
    names += ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    columns = {name: [0.0] * count for name in names}
    columns["rot_0"] = [1.0] * count
    return columns


@settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    count=st.integers(1, 40),
    degree=st.integers(0, 3),
    seed=st.integers(0, 2**31),
    labels=st.booleans(),
    normals=st.booleans(),
)
def test_splats_survive_saving(
    tmp_path: Path, count: int, degree: int, seed: int, labels: bool, normals: bool
) -> None:
    gaussians = make_gaussians(count, degree, seed, labels, normals)
    save_splats(gaussians, tmp_path / "a.ply")
    assert_same(gsfluent.load(tmp_path / "a.ply"), gaussians)


@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    opacity=st.floats(-400, 400, width=32),
    scale=st.floats(-40, 20, width=32),
    quat=st.tuples(*[st.floats(-3, 3, width=32)] * 4),
    f_dc=st.floats(-1e4, 1e4, width=32),
)
def test_any_finite_row_reads_as_valid_gaussian(
    tmp_path: Path, opacity: float, scale: float, quat: tuple[float, ...], f_dc: float
) -> None:
    columns = plain_columns(1)
    columns |= {"opacity": [opacity], "scale_1": [scale], "f_dc_0": [f_dc]}
    columns |= {f"rot_{i}": [part] for i, part in enumerate(quat)}
    write_rows(tmp_path / "a.ply", columns)
    gaussians = load_splats(tmp_path / "a.ply").validated()
    assert float(gaussians.quats.norm()) == pytest.approx(1.0, abs=1e-6)
    assert 0.0 <= float(gaussians.opacities[0]) <= 1.0
    assert float(gaussians.scales[0, 1]) == pytest.approx(math.exp(scale), rel=1e-5)


def test_layout_is_that_of_the_reference_implementation(tmp_path: Path) -> None:
    gaussians = make_gaussians(2, 1)
    save_splats(gaussians, tmp_path / "a.ply")
    rows = read_ply(tmp_path / "a.ply")["vertex"]
    names = list(rows.dtype.names)
    assert names[:9] == ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    assert names[9:18] == [f"f_rest_{i}" for i in range(9)]
    assert names[18:] == [
        "opacity",
        "scale_0",
        "scale_1",
        "scale_2",
        "rot_0",
        "rot_1",
        "rot_2",
        "rot_3",
    ]
    assert all(rows.dtype[name] == np.dtype("f4") for name in names)
    # Rest coefficients are channel-major: all of red first.
    assert rows["f_rest_1"][0] == pytest.approx(float(gaussians.sh[0, 2, 0]))
    assert rows["f_rest_3"][0] == pytest.approx(float(gaussians.sh[0, 1, 1]))
    assert rows["scale_2"][1] == pytest.approx(math.log(gaussians.scales[1, 2]), rel=1e-5)
    opacity = float(gaussians.opacities[0])
    assert rows["opacity"][0] == pytest.approx(math.log(opacity / (1 - opacity)), rel=1e-4)


def test_labels_are_an_extra_float_column_at_the_end(tmp_path: Path) -> None:
    save_splats(make_gaussians(5, 0, labels=True), tmp_path / "a.ply")
    rows = read_ply(tmp_path / "a.ply")["vertex"]
    assert rows.dtype.names[-1] == "label" and rows["label"].tolist() == [0, 1, 2, 3, 0]


def test_opaque_stays_opaque(tmp_path: Path) -> None:
    gaussians = make_gaussians(3, 0).replace(opacities=torch.tensor([1.0, 0.0, 0.5]))
    save_splats(gaussians, tmp_path / "a.ply")
    again = load_splats(tmp_path / "a.ply").opacities
    assert float(again[0]) == 1.0 and float(again[1]) < 1e-8 and float(again[2]) == 0.5


def test_extra_properties_elements_and_doubles_are_survived(tmp_path: Path) -> None:
    columns = plain_columns()
    rows = np.zeros(
        3, dtype=[(name, "f8") for name in columns] + [("segment", "i4"), ("filter", "u1")]
    )
    rows["rot_0"], rows["x"] = 2.0, [1.0, 2.0, 3.0]
    write_ply(tmp_path / "a.ply", {"camera": np.zeros(1, dtype=[("k", "f4")]), "vertex": rows})
    assert load_splats(tmp_path / "a.ply").means[:, 0].tolist() == [1.0, 2.0, 3.0]


@pytest.mark.parametrize("form", ["ascii", "binary_big_endian"])
def test_other_encodings_read_the_same(tmp_path: Path, form: str) -> None:
    gaussians = make_gaussians(4, 1)
    save_splats(gaussians, tmp_path / "a.ply")
    rows = read_ply(tmp_path / "a.ply")["vertex"]
    header = [
        "ply",
        f"format {form} 1.0",
        "element vertex 4",
        *(f"property float {n}" for n in rows.dtype.names),
        "end_header",
    ]
    text = ("\n".join(header) + "\n").encode()
    if form == "ascii":
        body = (
            "\n".join(" ".join(f"{value:.9g}" for value in row) for row in rows.tolist()).encode()
            + b"\n"
        )
    else:
        body = rows.astype(rows.dtype.newbyteorder(">")).tobytes()
    (tmp_path / "b.ply").write_bytes(text + body)
    assert_same(load_splats(tmp_path / "b.ply"), load_splats(tmp_path / "a.ply"))


def test_mesh_lists_are_read_over(tmp_path: Path) -> None:
    header = "ply\nformat {} 1.0\nelement face 2\n"
    header += "property list uchar int vertex_indices\nproperty float area\n"
    header += "element vertex 2\nproperty float x\nproperty uchar red\nend_header\n"
    text = header.format("ascii") + "3 0 1 2 0.5\n4 0 1 2 3 1.5\n7 255\n8 1\n"
    (tmp_path / "a.ply").write_text(text)
    binary = header.format("binary_little_endian").encode()
    for indices, area in (((0, 1, 2), 0.5), ((0, 1, 2, 3), 1.5)):
        binary += (
            bytes([len(indices)])
            + np.array(indices, "<i4").tobytes()
            + np.array(area, "<f4").tobytes()
        )
    binary += b"".join(np.array(x, "<f4").tobytes() + bytes([red]) for x, red in ((7, 255), (8, 1)))
    (tmp_path / "b.ply").write_bytes(binary)
    for name in ("a.ply", "b.ply"):
        data = read_ply(tmp_path / name)
        assert data["face"]["area"].tolist() == [0.5, 1.5]
        assert data["vertex"]["x"].tolist() == [7, 8] and data["vertex"]["red"].tolist() == [255, 1]


@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(share=st.floats(0, 0.999))
def test_truncation_anywhere_is_an_input_error(tmp_path: Path, share: float) -> None:
    path = tmp_path / "a.ply"
    save_splats(make_gaussians(5, 1), path)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(InputError) as caught:
        load_splats(path)
    assert str(path) in str(caught.value) and caught.value.hint


@settings(
    max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(noise=st.binary(max_size=300), place=st.integers(0, 600))
def test_damage_anywhere_never_crashes(tmp_path: Path, noise: bytes, place: int) -> None:
    path = tmp_path / "a.ply"
    save_splats(make_gaussians(2, 0), path)
    whole = bytearray(path.read_bytes())
    whole[place : place + len(noise)] = noise
    path.write_bytes(bytes(whole))
    try:
        load_splats(path).validated()
    except InputError as error:
        assert "a.ply" in error.what


ASCII = b"ply\nformat ascii 1.0\n"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "not a PLY file"),
        (b"\x89PNG\r\n\x1a\n", "not a PLY file"),
        (ASCII + b"", "no end_header"),
        (ASCII + b"element vertex many\nend_header\n", "header line 'element vertex many'"),
        (ASCII + b"element vertex -4\nend_header\n", "header line"),
        (b"ply\nformat odd 1.0\nend_header\n", "header line 'format odd 1.0'"),
        (b"ply\nelement vertex 0\nend_header\n", "names no format"),
        (
            ASCII + b"element vertex 1\nproperty float x\nproperty float x\nend_header\n1 1\n",
            "twice",
        ),
        (ASCII + b"element vertex 1\nproperty float x\nend_header\nabc\n", "not a number"),
        (ASCII + b"element vertex 2\nproperty float x\nend_header\n1\n", "promises 2 rows"),
        (ASCII + b"element face 0\nend_header\n", "no element 'vertex'"),
        (
            ASCII
            + b"element vertex 1\n"
            + b"property float x\nproperty float y\nproperty float z\n"
            + b"end_header\n1 1 1\n",
            "properties missing: f_dc_0",
        ),
    ],
)
def test_what_is_no_splat_file_is_said(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(content)
    with pytest.raises(InputError, match=message):
        load_splats(path)


def test_missing_file_and_folder(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        load_splats(tmp_path / "none.ply")
    with pytest.raises(InputError, match="is a folder"):
        load_splats(tmp_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"x": [0.0, math.nan, 0.0]},
            "means must be finite, got NaN or infinite in 1 of 3 rows, first row 1",
        ),
        ({"scale_1": [0.0, 0.0, -math.inf]}, "scales must be positive"),
        ({"opacity": [math.nan, 0.0, 0.0]}, "opacities must be finite"),
        ({"f_dc_1": [math.inf, 0.0, 0.0]}, "sh must be finite"),
    ],
)
def test_bad_values_name_row_and_file(
    tmp_path: Path, change: dict[str, list[float]], message: str
) -> None:
    write_rows(tmp_path / "a.ply", plain_columns() | change)
    with pytest.raises(InputError, match=message) as caught:
        load_splats(tmp_path / "a.ply")
    assert "a.ply" in caught.value.what


def test_zero_gaussians_is_an_input_error(tmp_path: Path) -> None:
    write_rows(tmp_path / "a.ply", plain_columns(0))
    with pytest.raises(InputError, match="at least one Gaussian, got 0"):
        load_splats(tmp_path / "a.ply")


def test_odd_number_of_harmonics_is_said(tmp_path: Path) -> None:
    write_rows(tmp_path / "a.ply", plain_columns(2, rest=12))
    with pytest.raises(InputError, match="f_rest must have 0, 9, 24 or 45 properties"):
        load_splats(tmp_path / "a.ply")


def test_saving_bad_values_writes_nothing(tmp_path: Path) -> None:
    gaussians = make_gaussians(3, 0)
    with pytest.raises(InputError, match="means must be finite"):
        save_splats(gaussians.replace(means=gaussians.means * math.nan), tmp_path / "a.ply")
    assert list(tmp_path.iterdir()) == []


def test_full_disk_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.ply"
    save_splats(make_gaussians(3, 0), path)
    before = path.read_bytes()

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(RunError, match="No space left on device") as caught:
        save_splats(make_gaussians(9, 3), path)
    assert caught.value.hint and path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["a.ply"]


@pytest.mark.data
def test_real_plush_dog_reads_and_survives_saving(data_root: Path, tmp_path: Path) -> None:
    """Its quirks: quaternions of norm 0.37 to 2.25, opacities of 400, scales down to exp(-15.2)."""
    gaussians = load_splats(data_root / "splats/plush_dog/point_cloud_29999_clean.ply")
    assert gaussians.count == 15105 and gaussians.sh_degree == 3
    assert int((gaussians.opacities == 1).sum()) >= 11928
    assert float(gaussians.scales.min()) < math.exp(-15)
    save_splats(gaussians, tmp_path / "a.ply")
    assert_same(load_splats(tmp_path / "a.ply"), gaussians)


@pytest.mark.data
def test_real_compressed_splat_equals_the_plain_one(data_root: Path) -> None:
    """SOURCE.md: position error median 2e-5, |q.q'| > 0.999999 typically, SH difference 0.008."""
    from scipy.spatial import cKDTree

    folder = data_root / "splats/plush_dog"
    plain = load_splats(folder / "point_cloud_29999_clean.ply")
    packed = load_splats(folder / "point_cloud_29999_clean.compressed.ply")
    assert packed.count == plain.count and packed.sh_degree == plain.sh_degree
    distance, match = cKDTree(plain.means.numpy()).query(
        packed.means.numpy()
    )  # SuperSplat sorts its rows
    pair = plain.select(torch.from_numpy(match))
    assert np.median(distance) < 4e-5
    assert float((pair.quats * packed.quats).sum(dim=1).abs().median()) > 0.99999
    assert float((pair.sh - packed.sh).abs().median()) < 0.02
    assert float((pair.scales.log() - packed.scales.log()).abs().median()) < 0.01
    assert float((pair.opacities - packed.opacities).abs().median()) < 0.01


@pytest.mark.data
def test_real_playbot_reads(data_root: Path) -> None:
    gaussians = load_splats(data_root / "splats/playbot/playbot_robot_lod1_sh3.ply")
    assert gaussians.count == 25143 and gaussians.sh_degree == 2


def test_compressed_splat_that_is_incomplete_is_said(tmp_path: Path) -> None:
    chunk = np.zeros(1, dtype=[("min_x", "f4")])
    vertex = np.zeros(2, dtype=[("packed_position", "u4")])
    write_ply(tmp_path / "a.ply", {"chunk": chunk, "vertex": vertex})
    with pytest.raises(InputError, match="compressed splat is incomplete"):
        load_splats(tmp_path / "a.ply")


def test_a_volume_names_the_splats_that_it_belongs_to(tmp_path: Path) -> None:
    volume = tmp_path / "melon.volume.npz"
    with pytest.raises(InputError, match=r"melon\.ply, which is not there"):
        gsfluent.load(volume)
    (tmp_path / "melon.ply").touch()
    with pytest.raises(InputError) as caught:
        gsfluent.load(volume)
    assert str(caught.value).endswith(f"load {tmp_path / 'melon.ply'}")
