"""Files that ask for too much, never end, or lie: each ends in the usual error, at once."""

from __future__ import annotations

import io
import json
import os
import struct
import tracemalloc
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import capture_files as files
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsfluent.config import load_shot
from gsfluent.errors import InputError, RunError, short
from gsfluent.io import DeltaReader, load_capture, load_image, load_splats, read_ply
from gsfluent.io.checked.arrays import read_npy, read_npz
from gsfluent.io.checked.files import read_json
from gsfluent.io.checked.inside import allow_outside, inside
from gsfluent.io.checked.limits import LIMITS, limit, unpacked_limit, within
from gsfluent.io.segmentation import load_segmentation
from gsfluent.io.segmentation.sam import decode_rle, painted, read_rle
from gsfluent.io.segmentation.sam import read_json as sam_json
from gsfluent.io.splats.delta import (
    BLOCK,
    END,
    KEY,
    MAGIC,
    TRAILER,
    DeltaFrame,
    _check_finite,
    decode,
    unpack_arrays,
)  # fmt: skip
from gsfluent.io.splats.delta_write import Roster, steps, write_delta
from gsfluent.pipeline.light.environment import of_file
from gsfluent.pipeline.render.camera import read_path
from gsfluent.results.frames import load_frame

ROOT = Path(__file__).resolve().parents[2]
Read = Callable[[Path], Any]

# every reader that takes a file by name
READ: dict[str, Read] = {
    "a.ply": load_splats,
    "a.splat": load_splats,
    "a.spz": load_splats,
    "a.ksplat": load_splats,
    "a.sog": load_splats,
    "a.ckpt": load_splats,
    "a.gsd": DeltaReader,
    "a.npy": read_npy,
    "a.npz": read_npz,
    "a.json": read_json,
    "a.png": load_image,
    "a.hdr": of_file,
    "a.yaml": load_shot,
    "path.json": lambda path: read_path(path, 3, (64, 48)),
    "masks.json": sam_json,
}


def refused(read: Callable[[], Any], said: str = "", most: int = 1 << 26) -> str:
    """The message, after a check that little was allocated on the way to it (unless 0: slow)."""
    if most:
        tracemalloc.start()
    try:
        with pytest.raises(InputError, match=said) as caught:
            read()
        assert not most or tracemalloc.get_traced_memory()[1] < most
    finally:
        tracemalloc.stop()
    assert caught.value.hint
    return caught.value.what


@pytest.mark.parametrize("name", READ)
def test_pipes_folders_and_names_that_are_none(tmp_path: Path, name: str) -> None:
    pipe = tmp_path / name
    os.mkfifo(pipe)
    assert name in refused(lambda: READ[name](pipe), "is a pipe or device")
    pipe.unlink()
    refused(lambda: READ[name](pipe), "no such")
    pipe.mkdir()
    refused(lambda: READ[name](pipe), "is a folder")
    refused(lambda: READ[name](tmp_path / ("a" * 5000) / name), "too long")
    refused(lambda: READ[name](tmp_path / f"\0{name}"), "no name of a file")


# --- limits ---


def test_limits_are_raised_by_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    assert limit("pixels") == LIMITS["pixels"][0]
    within("pixels", limit("pixels"), "a")
    with pytest.raises(InputError, match="a: 100000001 pixels") as caught:
        within("pixels", limit("pixels") + 1, "a")
    assert "GSFLUENT_MAX_PIXELS" in caught.value.hint
    monkeypatch.setenv("GSFLUENT_MAX_PIXELS", "4e9")
    within("pixels", 10**9, "a")
    for wrong in ("many", "0", "-1", "nan", "inf"):
        monkeypatch.setenv("GSFLUENT_MAX_PIXELS", wrong)
        with pytest.raises(InputError, match="positive number"):
            limit("pixels")


def test_every_limit_stands_in_the_document() -> None:
    page = (ROOT / "SECURITY.md").read_text(encoding="utf-8")
    for name, (value, what) in LIMITS.items():
        assert f"| `GSFLUENT_MAX_{name.upper()}` | {value} | {what} |" in page


@settings(max_examples=40)
@given(st.recursive(st.integers() | st.text() | st.floats(), lambda inner: st.lists(inner)
                    | st.dictionaries(st.text(), inner)))  # fmt: skip
def test_what_a_message_shows_is_short(value: object) -> None:
    assert len(short(value)) < 20_000 and len(short("a" * 9999, bare=True)) < 400


def test_what_a_message_shows_of_giants() -> None:
    deep: list[Any] = ["a"]
    for _ in range(40):
        deep = [deep] * 9  # written out: 9^40
    assert len(short(deep)) < 20_000
    assert short(10**9999) == "2^33215 or more" and short(-(10**9999)).startswith("-2^")
    assert short(7) == "7" and short("a") == "'a'"


# --- bombs ---


def test_run_lengths_that_wrap_are_refused() -> None:
    # 2^63 - 1 and 2^63 - 1 and 92 add up to 90 in 64 bits: np.repeat then wrote past its end
    huge = 2**63 - 1
    refused(lambda: decode_rle({"size": [9, 10], "counts": [huge, huge, 92]}), "add up to")
    refused(lambda: decode_rle({"size": [9, 10], "counts": [10**400]}), "add up to 2\\^")
    refused(lambda: decode_rle({"size": [9, 10], "counts": [-10, 100]}), "add up to")
    text = {"size": [9, 10], "counts": "oooooo1" * 3}
    refused(lambda: decode_rle(text), "add up to|too many digits")


def test_a_mask_costs_what_its_file_costs() -> None:
    side = 1 << 17
    refused(lambda: read_rle({"size": [side, side], "counts": [side * side]}, "a"), "above the lim")
    # a hundred masks of 100 Mpx are 10 GB as pictures and 2 kB here
    one = {"size": [10_000, 10_000], "counts": [0, 100_000_000]}
    refused(lambda: painted([read_rle(one)] * 100, "a"), "above the limit of 3000000000")
    mask = read_rle({"size": [3, 2], "counts": [1, 2, 2, 1]})
    assert mask.area == 3 and mask.extent() == (1, 6) and mask.shape == (3, 2)
    assert mask.mask().T.ravel().tolist() == [False, True, True, False, False, True]
    for counts in ([], [6], [0, 6], [2, 4], [5, 0, 1]):
        if sum(counts) == 6:
            assert read_rle({"size": [3, 2], "counts": counts}).mask().sum() == sum(counts[1::2])


def test_numpy_files_that_grow(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        with archive.open("a.npy", "w") as member:
            np.lib.format.write_array_header_1_0(
                member, {"descr": "|u1", "fortran_order": False, "shape": (1 << 26,)}
            )
            for _ in range(1 << 2):
                member.write(bytes(1 << 24))
    assert (tmp_path / "a.npz").stat().st_size < 1 << 17
    assert read_npz(tmp_path / "a.npz")["a"].size == 1 << 26
    monkeypatch.setenv("GSFLUENT_MAX_UNPACKED_BYTES", str(1 << 24))
    refused(lambda: read_npz(tmp_path / "a.npz"), "above the limit", most=1 << 20)
    assert unpacked_limit(1 << 30) == 50 << 30  # large honest files stay readable


@pytest.mark.parametrize(
    "shape", ["(1000000000000,)", "(4, -1)", "(3, 4)", f"({'9' * 40},)", "(1, ("]
)
def test_numpy_headers_that_lie(tmp_path: Path, shape: str) -> None:
    text = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    body = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode() + bytes(64)
    (tmp_path / "a.npy").write_bytes(body)
    refused(lambda: read_npy(tmp_path / "a.npy"), "damaged")
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("a.npy", body)
    refused(lambda: read_npz(tmp_path / "a.npz"), "damaged")


def test_numpy_files_are_read_as_numpy_reads_them(tmp_path: Path) -> None:
    arrays = {
        "a": np.arange(12, dtype=">i4").reshape(3, 4),
        "b": np.asfortranarray(np.random.default_rng(0).random((3, 2, 4))),
        "c": np.array("text"), "d": np.zeros((0, 3), np.float32), "e": np.array(True),
    }  # fmt: skip
    np.savez_compressed(tmp_path / "a.npz", **arrays)
    for name, found in read_npz(tmp_path / "a.npz").items():
        assert found.shape == arrays[name].shape and np.array_equal(found, arrays[name])
        assert found.dtype.isnative and found.flags.writeable
    assert list(read_npz(tmp_path / "a.npz", ("c",))) == ["c"]
    refused(lambda: read_npz(tmp_path / "a.npz", ("z",)), "damaged")
    np.save(tmp_path / "o.npy", np.array([{}], dtype=object), allow_pickle=True)
    refused(lambda: read_npy(tmp_path / "o.npy"), "not numbers")


def png(width: int, height: int) -> bytes:
    """A PNG that declares a size and holds nothing of it."""
    out = b"\x89PNG\r\n\x1a\n"
    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    for kind, body in ((b"IHDR", head), (b"IDAT", zlib.compress(bytes(100))), (b"IEND", b"")):
        out += (
            struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        )
    return out


@pytest.mark.parametrize(("width", "height"), [(12_000, 12_000), (30_000, 30_000), (65535, 65535)])
def test_pictures_of_absurd_size(tmp_path: Path, width: int, height: int) -> None:
    (tmp_path / "a.png").write_bytes(png(width, height))
    refused(lambda: load_image(tmp_path / "a.png"), "above the limit")
    refused(lambda: of_file(tmp_path / "a.png"), "above the limit")
    (tmp_path / "a.hdr").write_bytes(b"#?RADIANCE\n\n-Y %d +X %d\n" % (height, width) + bytes(64))
    refused(lambda: of_file(tmp_path / "a.hdr"), "above the limit")


def test_other_formats_of_absurd_size(tmp_path: Path) -> None:
    from PIL import Image

    Image.new("RGB", (8, 4)).save(tmp_path / "a.tif")
    data = bytearray((tmp_path / "a.tif").read_bytes())
    (start,) = struct.unpack_from("<I", data, 4)
    for entry in range(struct.unpack_from("<H", data, start)[0]):
        tag, kind = struct.unpack_from("<HH", data, start + 2 + 12 * entry)
        if tag in (256, 257):  # width and height
            struct.pack_into("<I" if kind == 4 else "<H", data, start + 10 + 12 * entry, 60_000)
    (tmp_path / "a.tif").write_bytes(data)
    refused(lambda: load_image(tmp_path / "a.tif"), "above the limit")
    refused(lambda: of_file(tmp_path / "a.tif"), "above the limit")
    (tmp_path / "a.exr").write_bytes(b"\x76\x2f\x31\x01" + bytes(99))
    refused(lambda: of_file(tmp_path / "a.exr"), "not a picture")
    refused(lambda: load_image(tmp_path / "a.exr"), "not an image")


def test_a_picture_is_what_it_is_called(tmp_path: Path) -> None:
    # Pillow starts Ghostscript for EPS whatever the name; OpenCV goes by content, too
    (tmp_path / "a.png").write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n")
    refused(lambda: load_image(tmp_path / "a.png"), "not an image")
    (tmp_path / "a.hdr").write_bytes(png(8, 4))
    refused(lambda: of_file(tmp_path / "a.hdr"), "not a Radiance picture")


def test_float_pictures_with_nan_are_refused(tmp_path: Path) -> None:
    from PIL import Image

    values = np.full((8, 16), 0.5, np.float32)
    values[2, 3] = np.nan
    Image.fromarray(values).save(tmp_path / "a.tif")
    refused(lambda: load_image(tmp_path / "a.tif"), "NaN")


# --- PLY ---


def ply(path: Path, *lines: str, body: bytes = b"", kind: str = "binary_little_endian") -> Path:
    path.write_bytes(
        "\n".join(["ply", f"format {kind} 1.0", *lines, "end_header\n"]).encode() + body
    )
    return path


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian"])
@pytest.mark.parametrize(
    ("lines", "said"),
    [
        (["element vertex 1000000000000"], "rows of no property"),
        (["element vertex 1000000000000", "property float x"], "ends inside"),
        (["element a 3", "property list float int b"], "not understood"),
    ],
)
def test_ply_headers_that_promise(tmp_path: Path, lines: list[str], said: str, kind: str) -> None:
    refused(lambda: read_ply(ply(tmp_path / "a.ply", *lines, kind=kind, body=b"\n1\n")), said)


def test_ply_lists_and_words_of_absurd_length(tmp_path: Path) -> None:
    lists = ("element f 1", "property list int float b")
    for length in (-5, 2**31 - 1):
        path = ply(tmp_path / "a.ply", *lists, body=struct.pack("<i", length) + bytes(8))
        refused(lambda path=path: read_ply(path), "a list of -5|ends inside")
        path = ply(tmp_path / "b.ply", *lists, "property int c", kind="ascii",
                   body=b"%d 1 2\n" % length)  # fmt: skip
        refused(lambda path=path: read_ply(path), "not a number")
    rows = b"\n".join([b"1"] * 99) + b"\n" + b"1" * 100_000 + b"\n"
    path = ply(tmp_path / "c.ply", "element v 100", "property float x", kind="ascii", body=rows)
    refused(lambda: read_ply(path), "a word of 100000 letters")


def test_packed_columns_of_another_type(tmp_path: Path) -> None:
    limits = [f"property float {s}_{n}" for s in ("min", "max") for n in
              ("x", "y", "z", "scale_x", "scale_y", "scale_z")]  # fmt: skip
    names = ("position", "rotation", "scale", "color")
    for kind, size in (("float", 4), ("int", 4), ("uchar", 1)):
        packed = [f"property {kind} packed_{n}" for n in names]
        lines = ("element chunk 1", *limits, "element vertex 1", *packed)
        path = ply(tmp_path / "a.ply", *lines, body=bytes(48 + 4 * size))
        refused(lambda path=path: load_splats(path), "must be uint")


def test_quaternions_of_nan_are_refused(tmp_path: Path) -> None:
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1",
             "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]  # fmt: skip
    body = np.ones(14, "<f4")
    body[11] = np.nan
    path = ply(tmp_path / "a.ply", "element vertex 1", *(f"property float {n}" for n in names),
               body=body.tobytes())  # fmt: skip
    refused(lambda: load_splats(path), "quaternions must be finite")


# --- delta sequences ---


def block(kind: bytes, payload: bytes, frame: int = 0) -> bytes:
    packed = zlib.compress(payload)
    return BLOCK.pack(kind, frame, len(packed), zlib.crc32(packed)) + packed


def gsd(path: Path, roster: bytes, **header: Any) -> Path:
    step = dict.fromkeys(("position", "rotation", "log_scale", "opacity", "f_dc"), 0.01)
    values = {"frames": 0, "times": [], "key_every": 2, "step": step} | header
    text = json.dumps(values).encode()
    out = MAGIC + struct.pack("<II", 1, len(text)) + text
    at = len(out)
    out += block(b"ROST", roster)
    end = len(out)
    out += block(b"INDX", struct.pack("<IBB", 1, 2, 8) + struct.pack("<QQ", 2 * at, 0))
    path.write_bytes(out + TRAILER.pack(end, END))
    return path


def test_delta_bombs(tmp_path: Path) -> None:
    path = gsd(tmp_path / "a.gsd", struct.pack("<IBB", 2**32 - 1, 255, 0))  # numbers of no bytes
    refused(lambda: DeltaReader(path), "4294967295 rows of 255 numbers")
    refused(lambda: DeltaReader(gsd(path, struct.pack("<IBB", 1, 1, 200))), "damaged")
    refused(lambda: DeltaReader(gsd(path, struct.pack("<IBB", 0, 1, 0) * 40)), "damaged")
    refused(lambda: DeltaReader(gsd(path, b"")), "the roster")
    with pytest.raises(ValueError, match="rows"):
        unpack_arrays(struct.pack("<IBB", 9, 1, 0), most_rows=8)


def test_a_delta_that_zlib_blows_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GSFLUENT_MAX_UNPACKED_BYTES", str(1 << 20))
    path = gsd(tmp_path / "a.gsd", struct.pack("<IBB", 1 << 24, 1, 1) + bytes(1 << 24))
    refused(lambda: DeltaReader(path), "above the limit", most=1 << 23)


@pytest.mark.parametrize(
    "header",
    [
        {"frames": 1, "times": [float("nan")]}, {"frames": 1, "times": ["a"]}, {"key_every": 0.5},
        {"frames": 2, "times": [1.0, 0.0]}, {"frames": 1, "times": [10**400]}, {"step": []},
        {"step": dict.fromkeys(("position", "rotation", "log_scale", "opacity", "f_dc"), 1e999)},
        {"key_every": True},
    ],
)  # fmt: skip
def test_delta_headers_that_lie(tmp_path: Path, header: dict[str, Any]) -> None:
    refused(lambda: DeltaReader(gsd(tmp_path / "a.gsd", b"", **header)), "the header")


def test_delta_frames_that_lie(tmp_path: Path) -> None:
    count = 3
    one = np.ones(count)
    frame = DeltaFrame(
        0, 0.0, np.arange(count), np.zeros(count, np.int32), np.zeros((count, 3), np.float32),
        np.tile(np.float32([1, 0, 0, 0]), (count, 1)), np.full((count, 3), 0.1, np.float32),
        one.astype(np.float32), np.zeros((count, 3), np.float32),
    )  # fmt: skip
    roster = Roster()
    roster.meet(frame)
    write_delta(tmp_path / "a.gsd", [frame], roster, times=[0.0], fps=24.0, step=steps(1e-3),
                key_every=1)  # fmt: skip
    reader = DeltaReader(tmp_path / "a.gsd")
    arrays = reader._payload(reader._frames[0], KEY, 0)

    def read(at: int, value: int) -> None:
        lying = [array.copy() for array in arrays]
        lying[at][:] = value
        state = decode(lying, reader._nothing(), reader._born, reader.step, key=True)
        _check_finite(state, reader.step)

    for largest in (-1, 4):
        with pytest.raises(ValueError, match="four components"):
            read(3, largest)
    with pytest.raises(ValueError, match="finite place, turn, size or colour"):
        read(5, 1 << 40)  # scales beyond all numbers


# --- captures ---


def capture(folder: Path, edit: Callable[[dict[str, Any]], object] = lambda data: None) -> Path:
    cameras = files.ring(3, 24, 18)
    files.write_images(folder / "images", cameras)
    files.write_transforms(folder / "transforms.json", cameras, {"fl_x": 20.0, "w": 24, "h": 18})
    data = json.loads((folder / "transforms.json").read_text())
    edit(data)
    (folder / "transforms.json").write_text(json.dumps(data))
    return folder


@pytest.mark.parametrize(
    ("edit", "said"),
    [
        (lambda d: d.update(fl_x=10**350), "fl_x must be a finite number"),
        (lambda d: d.update(fl_x=-20.0, fl_y=20.0), "focal lengths must be positive"),
        (lambda d: d.update(w=10**6, h=10**6), "above the limit"),
        (lambda d: d.update(k1=1e9), "which no lens has"),
        (lambda d: d.update(fl_x=1e-80), "no lens has"),
        (lambda d: d.update(cx=1e29), "no lens has"),
        (lambda d: d["frames"][0].update(transform_matrix=[[10**350] * 4] * 4), "4 x 4"),
        (lambda d: d["frames"][0].update(mask_path=["a"]), "mask_path must be text"),
        (lambda d: d["frames"][0].update(file_path="a" * 5000), "no name of a file"),
        (lambda d: d["frames"][0].update(file_path=""), "no name of a file"),
        (lambda d: d.update(ply_file_path={}, camera_model=[]), "camera model"),
    ],
)
def test_transforms_that_lie(tmp_path: Path, edit: Callable[[Any], object], said: str) -> None:
    folder = capture(tmp_path, edit)
    refused(lambda: load_capture(folder), said)


def test_json_that_nests_or_counts_without_end(tmp_path: Path) -> None:
    for text in ("[" * 100_000, '{"frames": ' * 5000, '{"w": ' + "9" * 5000 + "}"):
        (tmp_path / "transforms.json").write_text(text)
        refused(lambda: load_capture(tmp_path), "not readable as JSON")


@pytest.mark.parametrize("name", ["/etc/hostname", "../a.png", "images/../../a.png", "..\\a.png"])
def test_names_that_leave_the_capture(tmp_path: Path, name: str) -> None:
    folder = tmp_path / "capture"
    capture(folder)
    for key in ("file_path", "mask_path"):
        capture(folder, lambda d, key=key: d["frames"][0].update({key: name}))
        refused(lambda: load_capture(folder), "outside the folder")
    capture(folder, lambda d: d.update(ply_file_path=name))
    refused(lambda: load_capture(folder), "outside the folder")


def test_outside_is_allowed_when_asked_for(tmp_path: Path) -> None:
    folder = tmp_path / "capture"
    capture(folder, lambda d: d["frames"][0].update(file_path="../away.png"))
    (folder / "images" / "0.png").rename(tmp_path / "away.png")
    with allow_outside():
        found = load_capture(folder)
    assert tmp_path / "away.png" in [camera.image_path for camera in found.cameras]
    refused(lambda: load_capture(folder), "outside the folder")
    assert inside(folder, "images/./a/../0.png", "a") == folder / "images" / "0.png"


@pytest.mark.parametrize("text", [False, True])
def test_names_in_a_model_that_leave_the_capture(tmp_path: Path, text: bool) -> None:
    cameras = [c.replace(name=f"../{c.name}") for c in files.ring(3, 24, 18)]
    files.write_images(tmp_path, [c.replace(name=c.name[3:]) for c in cameras])
    folder = tmp_path / "capture"
    files.write_colmap(folder / "sparse/0", cameras, "PINHOLE", [20.0, 20.0, 12.0, 9.0], text)
    (folder / "images").mkdir()
    refused(lambda: load_capture(folder), "outside the folder")
    with allow_outside():
        assert len(load_capture(folder)) == 3


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("cameras", "20.0", "nan"), ("cameras", "20.0", "inf"), ("cameras", " 24 ", " 1e400 "),
        ("cameras", " 24 ", " 99999999 "), ("images", " 0.0 ", " nan "), ("images", "1 0.png",
        "nan 0.png"), ("images", "1 0.png", "1e999 0.png"), ("cameras", "0.5", "1e30"),
        ("cameras", "20.0", "1e-80"),
    ],
)  # fmt: skip
def test_models_of_text_that_lie(tmp_path: Path, name: str, old: str, new: str) -> None:
    cameras = files.ring(3, 24, 18)
    files.write_images(tmp_path / "images", cameras)
    place = tmp_path / "sparse/0"
    files.write_colmap(place, cameras, "SIMPLE_RADIAL", [20.0, 12.0, 9.0, 0.5], text=True)
    path = place / f"{name}.txt"
    before = path.read_text()
    path.write_text(before.replace(old, new, 1))
    assert path.read_text() != before
    refused(lambda: load_capture(tmp_path), "txt")


@pytest.mark.parametrize(
    "data",
    [
        {"images": [{"id": [1], "file_name": "0.png"}], "annotations": []},
        {"images": [{"id": 1}], "annotations": [{"image_id": {}}]},
        {"images": [{"id": 1}], "annotations": [{"image_id": 1, "category_id": []}]},
        {"images": [], "annotations": [], "categories": 5},
        [{"segmentation": {"size": [18, 24], "counts": [432]}, "label": [1]}],
        [{"segmentation": {"size": [18, 24], "counts": [432]}, "stability_score": 10**400}],
    ],
)
def test_annotations_that_are_lists_where_numbers_belong(tmp_path: Path, data: Any) -> None:
    folder = capture(tmp_path / "capture")
    (tmp_path / "0.json").write_text(json.dumps(data))
    refused(lambda: load_segmentation(tmp_path / "0.json", load_capture(folder)), r"0\.json")


# --- shots ---


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("size: 2020-13-45", "not a value of the kind timestamp"),
        ("size: 0b_", "not a value of the kind int"),
        ("size: !!int abc", "not a value of the kind int"),
        ("size: !!bool perhaps", "not a value of the kind bool"),
        ("size: !!timestamp soon", "not a value of the kind timestamp"),
        ("size: " + "[" * 3000, "more than 100 deep"),
        ("size: &a [*a]", "inside of what it stands for"),
        ("size: 1\0", "not valid YAML"),
        ("? [a]\n: 1", "a key must be plain text"),
        ("splats: 'a\\0b'", "no such|does not exist|is no path"),
        ('splats: "a\\0b"', "is no path"),
        ("splats: " + "a" * 5000, "is no path"),
        ("splats: ~nobody_of_that_name/a.ply", "is no path"),
        ("splats: a.ply\nsize: " + "9" * 400, "size must lie in"),
        ("capture: 2020-01-02", "must be text"),
    ],
)
def test_shots_that_lie(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "a.ply").touch()
    (tmp_path / "shot.yaml").write_text(text)
    assert "shot.yaml" in refused(lambda: load_shot(tmp_path / "shot.yaml"), said, 0)


@pytest.mark.parametrize("where", ["size", "events", "floor", "up", "<<"])
def test_aliases_that_double(tmp_path: Path, where: str) -> None:
    # 400 bytes whose value written out has 9^20 words
    opener, closer = ("{<<: [", "]}") if where == "<<" else ("[", "]")
    lines = ["a0: &a0 {k: 1}" if where == "<<" else "a0: &a0 [x, x]"]
    lines += [f"a{k}: &a{k} {opener}{', '.join([f'*a{k - 1}'] * 9)}{closer}" for k in range(1, 21)]
    (tmp_path / "shot.yaml").write_text("\n".join([*lines, f"{where}: *a20"]))
    refused(lambda: load_shot(tmp_path / "shot.yaml"), "aliases written out", 0)


def test_honest_aliases_are_read(tmp_path: Path) -> None:
    (tmp_path / "a.ply").touch()
    (tmp_path / "shot.yaml").write_text(
        "splats: a.ply\nsize: 0.1\n"
        "objects:\n  a: &m {material: fruit.watermelon}\n  b:\n    <<: *m\n"
    )
    shot = load_shot(tmp_path / "shot.yaml")
    assert shot.objects["a"].material == shot.objects["b"].material


# --- results ---


@pytest.mark.parametrize("name", ["means", "damage", "velocity", "led_positions"])
def test_frames_with_nan_are_refused(name: str, tmp_path: Path) -> None:
    stream = io.BytesIO()
    head = {"index": 0, "time": 0.0, "carried": 1, "facts": {}}
    arrays = {"scales": np.ones((1, 3)), name: np.full((1, 3), np.nan, np.float32)}
    np.savez(stream, head=np.array(json.dumps(head)), **arrays)
    (tmp_path / "frame_0001.npz").write_bytes(stream.getvalue())
    with pytest.raises(RunError, match=f"{name} holds NaN"):
        load_frame(tmp_path, 0)
