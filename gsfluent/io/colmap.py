"""COLMAP sparse models, binary and text: cameras, images, points3D.

Formats: COLMAP documentation, "Output Format". Poses are world-to-camera, the pixel origin is the
corner of the first pixel; both as gsfluent has them.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import torch

from gsfluent import geometry
from gsfluent.data.camera import Camera
from gsfluent.data.capture import Capture
from gsfluent.errors import InputError, short
from gsfluent.io.checked.files import is_file, read_bytes
from gsfluent.io.checked.inside import inside
from gsfluent.io.checked.pictures import check_pixels
from gsfluent.io.images import IMAGE_SUFFIXES, load_view

# name -> (COLMAP id, parameter count, places of fx fy cx cy, of the OpenCV coefficients or None)
_Lens = tuple[int, int, torch.Tensor, tuple[float, ...]]  # width, height, K, OpenCV coefficients
_Layout = tuple[int, int, tuple[int, int, int, int], tuple[int | None, ...]]
_MODELS: dict[str, _Layout] = {
    "SIMPLE_PINHOLE": (0, 3, (0, 0, 1, 2), ()),
    "PINHOLE": (1, 4, (0, 1, 2, 3), ()),
    "SIMPLE_RADIAL": (2, 4, (0, 0, 1, 2), (3, None, None, None)),
    "RADIAL": (3, 5, (0, 0, 1, 2), (3, 4, None, None)),
    "OPENCV": (4, 8, (0, 1, 2, 3), (4, 5, 6, 7)),
    "FULL_OPENCV": (6, 12, (0, 1, 2, 3), (4, 5, 6, 7, 8, 9, 10, 11)),
}
_UNSUPPORTED = {
    5: "OPENCV_FISHEYE",
    7: "FOV",
    8: "SIMPLE_RADIAL_FISHEYE",
    9: "RADIAL_FISHEYE",
    10: "THIN_PRISM_FISHEYE",
}
_POINT_BYTES = 51  # of a point without a track
_LARGE = 1e30  # no number of a capture is beyond; a float32 still holds it
_PLACES = ("sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse", "distorted/sparse/0", ".")
_IMAGE_FOLDERS = ("images", "input", "../images", "../../images", ".")


class _Bytes:
    """A file read into memory with a cursor; running off its end is an InputError."""

    def __init__(self, path: Path) -> None:
        self.path, self.data, self.place = path, read_bytes(path), 0

    def take(self, layout: str) -> tuple[float, ...]:
        packed = struct.Struct("<" + layout)
        if self.place + packed.size > len(self.data):
            raise _damaged(self.path, "it ends too early")
        values = packed.unpack_from(self.data, self.place)
        self.place += packed.size
        return values

    def count(self) -> int:
        """Read a 64-bit count that the rest of the file could hold at one byte each."""
        (number,) = self.take("Q")
        if number > len(self.data):
            raise _damaged(self.path, f"it announces {int(number)} entries")
        return int(number)

    def text(self) -> str:
        end = self.data.find(b"\0", self.place)
        if end < 0:
            raise _damaged(self.path, "a name has no end")
        raw, self.place = self.data[self.place : end], end + 1
        return raw.decode("utf-8", errors="replace")

    def skip(self, size: int) -> None:
        self.place += size
        if self.place > len(self.data):
            raise _damaged(self.path, "it ends too early")


def find_model(root: Path) -> Path | None:
    """Return the folder below ``root`` with the largest COLMAP model, or None."""
    folders = [root / place for place in _PLACES]
    if (root / "sparse").is_dir():
        folders += sorted(folder for folder in (root / "sparse").iterdir() if folder.is_dir())
    found = []
    for folder in folders:
        for suffix in (".bin", ".txt"):
            images = folder / f"images{suffix}"
            if images.is_file() and (folder / f"cameras{suffix}").is_file():
                found.append((images.stat().st_size, folder))
    return max(found, key=lambda item: item[0])[1] if found else None


def read_model(model: Path, root: Path, *, photographs: bool = True) -> Capture:
    """Read the COLMAP model in folder ``model`` with the photographs below ``root``.

    Args:
        model: Folder with ``cameras`` and ``images``.
        root: Folder of the capture.
        photographs: Whether these must be there.

    Raises:
        InputError: A damaged file, an unsupported lens model, no registered image, or a photograph
            that is not there.
    """
    binary = (model / "images.bin").is_file()
    suffix = ".bin" if binary else ".txt"
    try:
        lenses = dict((_binary_cameras if binary else _text_cameras)(model / f"cameras{suffix}"))
        poses = list((_binary_images if binary else _text_images)(model / f"images{suffix}"))
        points_path = model / f"points3D{suffix}"
        points, colors = np.zeros((0, 3)), np.zeros((0, 3))
        if points_path.is_file():
            points, colors = (_binary_points if binary else _text_points)(points_path)
    except OSError as error:
        raise InputError(
            f"{error.filename or model}: cannot be read ({error.strerror})", "check the file"
        ) from error
    if not poses:
        raise InputError(
            f"{model / f'images{suffix}'}: no image has a pose",
            "the posing failed; run COLMAP again",
        )
    folder = _image_folder(root, [name for name, _, _ in poses]) if photographs else root
    cameras = []
    for name, lens_id, viewmat in sorted(poses, key=lambda pose: pose[0]):
        if lens_id not in lenses:
            raise InputError(
                f"{model}: image {name} uses camera {lens_id}, which cameras{suffix} lacks",
                "export again",
            )
        width, height, intrinsics, distortion = lenses[lens_id]
        cameras.append(
            Camera(
                viewmat,
                intrinsics,
                width,
                height,
                distortion,
                name,
                inside(folder, name, model),
                find_mask(root, name),
            )
        )
    good = (np.abs(points) < _LARGE).all(axis=1) & np.isfinite(colors).all(axis=1)
    return Capture(
        cameras,
        torch.from_numpy(np.ascontiguousarray(points[good])),
        torch.from_numpy((colors[good] / 255.0).astype(np.float32)),
        root,
        load_view,
    )


def find_mask(root: Path, name: str) -> Path | None:
    """Return the mask of image ``name``: in ``masks/``, same name, name + .png, or same stem."""
    parts = Path(os.path.normpath(name)).parts
    if os.path.isabs(name):  # allowed, see inside(): its mask has the same name in masks/
        parts = parts[-1:]
    for folder in (root / "masks", root / "mask"):
        if not folder.is_dir():
            continue
        for start in range(len(parts)):
            beside = inside(folder, str(Path(*parts[start:])), folder)
            for candidate in (
                beside,
                beside.with_name(beside.name + ".png"),
                *map(beside.with_suffix, IMAGE_SUFFIXES),
            ):
                if is_file(candidate):
                    return candidate
    return None


def _image_folder(root: Path, names: list[str]) -> Path:
    """Return the folder that holds all named images."""
    best: tuple[int, Path, list[str]] | None = None
    for place in _IMAGE_FOLDERS:
        folder = root / place
        missing = [n for n in names if not is_file(inside(folder, n, root))]
        if not missing:
            return Path(os.path.normpath(folder))
        if best is None or len(missing) < best[0]:
            best = (len(missing), folder, missing)
    folder, missing = (best[1], best[2]) if best else (root, names)
    raise InputError(
        f"{folder}: {len(missing)} of {len(names)} posed images are missing, first "
        f"{short(missing[0], bare=True)}",
        "restore the images, or delete these views from the model",
    )


def is_lens(focal: Sequence[float], middle: Sequence[float], bent: Sequence[float]) -> bool:
    """Whether there are such lenses; far beyond, the picture overflows where it is resampled.

    Args:
        focal: Focal lengths [pixels].
        middle: Principal point [pixels].
        bent: Coefficients of the distortion.
    """
    return (
        all(1e-2 <= f <= 1e8 for f in focal)
        and all(abs(c) <= 1e7 for c in middle)
        and all(abs(k) <= 1e3 for k in bent)
    )


def _damaged(path: Path, why: str) -> InputError:
    return InputError(
        f"{path}: the COLMAP file is damaged ({why})", "copy or export the model again"
    )


def _lens(path: Path, model: str, width: float, height: float, params: tuple[float, ...]) -> _Lens:
    """Turn COLMAP parameters into (width, height, K, OpenCV coefficients)."""
    layout = _MODELS.get(model)
    if layout is None:
        raise InputError(
            f"{path}: camera model {short(model, bare=True)} is not supported",
            f"undistort with `colmap image_undistorter`, or use one of {', '.join(_MODELS)}",
        )
    _, count, (fx, fy, cx, cy), coefficients = layout
    if (
        len(params) != count
        or not all(abs(number) < _LARGE for number in (*params, width, height))
        or min(params[fx], params[fy]) <= 0
        or min(width, height) < 1
    ):
        raise _damaged(
            path, f"camera model {model} with size {width} x {height} and parameters {list(params)}"
        )
    bent = [params[place] for place in coefficients if place is not None]
    if not is_lens([params[fx], params[fy]], [params[cx], params[cy]], bent):
        raise _damaged(path, f"no lens has the parameters {list(params)}")
    check_pixels(int(width), int(height), path)
    k = [[params[fx], 0.0, params[cx]], [0.0, params[fy], params[cy]], [0.0, 0.0, 1.0]]
    distortion = tuple(0.0 if place is None else params[place] for place in coefficients)
    if not any(distortion):
        distortion = ()
    return int(width), int(height), torch.tensor(k, dtype=torch.float64), distortion


def _pose(
    path: Path, name: str, quat: tuple[float, ...], translation: tuple[float, ...]
) -> torch.Tensor:
    """World-to-camera matrix from COLMAP's quaternion (wxyz) and translation."""
    numbers = (*quat, *translation)
    if not all(abs(n) < _LARGE for n in numbers) or not sum(q * q for q in quat) > 0:
        raise InputError(
            f"{path}: the pose of {name} is not a number: {list(numbers)}",
            "pose this image again or delete it",
        )
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = geometry.quaternion_to_matrix(torch.tensor(quat, dtype=torch.float64))
    viewmat[:3, 3] = torch.tensor(translation, dtype=torch.float64)
    return viewmat


def _binary_cameras(path: Path) -> Iterator[tuple[int, _Lens]]:
    data = _Bytes(path)
    names = {layout[0]: name for name, layout in _MODELS.items()}
    for _ in range(data.count()):
        camera, model, width, height = data.take("iiQQ")
        name = names.get(int(model), _UNSUPPORTED.get(int(model), f"number {int(model)}"))
        params = data.take("d" * _MODELS[name][1]) if name in _MODELS else ()
        yield int(camera), _lens(path, name, width, height, params)


def _binary_images(path: Path) -> Iterator[tuple[str, int, torch.Tensor]]:
    data = _Bytes(path)
    for _ in range(data.count()):
        _, *numbers, camera = data.take("I7dI")
        name = data.text()
        data.skip(24 * data.count())  # the image's feature points: x, y, id of the 3D point
        yield name, int(camera), _pose(path, name, tuple(numbers[:4]), tuple(numbers[4:]))


def _binary_points(path: Path) -> tuple[np.ndarray, np.ndarray]:
    data = _Bytes(path)
    count = data.count()
    if count * _POINT_BYTES > len(data.data):
        raise _damaged(path, f"it announces {count} points")
    table = np.zeros((count, 6))
    for row in range(count):
        _, *values, _ = data.take("Q3d3Bd")
        table[row] = values
        data.skip(8 * data.count())  # the track: image id, feature index
    return table[:, :3], table[:, 3:]


def _lines(path: Path) -> Iterator[list[str]]:
    for line in read_bytes(path).decode("utf-8", errors="replace").splitlines():
        if not line.startswith("#"):
            yield line.split()


def _numbers(
    path: Path, words: list[str], kind: Callable[[str], float] = float
) -> tuple[float, ...]:
    try:
        return tuple(kind(word) for word in words)
    except (ValueError, OverflowError) as error:
        raise _damaged(path, f"{' '.join(words)[:60]!r} are not numbers") from error


def _number_of(path: Path, word: str) -> int:
    """The number of a camera."""
    (number,) = _numbers(path, [word[:20]], int)
    return int(number)


def _text_cameras(path: Path) -> Iterator[tuple[int, _Lens]]:
    for words in _lines(path):
        if words:
            if len(words) < 5:
                raise _damaged(path, f"line {' '.join(words)!r} is too short")
            width, height, *params = _numbers(path, words[2:])
            yield (
                _number_of(path, words[0]),
                _lens(path, words[1], width, height, tuple(params)),
            )


def _text_images(path: Path) -> Iterator[tuple[str, int, torch.Tensor]]:
    """Every second line lists feature points, and may be empty."""
    lines = _lines(path)
    for words in lines:
        if not words:
            continue
        if len(words) < 10:
            raise _damaged(path, f"line {' '.join(words)[:60]!r} is too short")
        numbers, name = _numbers(path, words[1:8]), " ".join(words[9:])
        next(lines, None)
        yield name, _number_of(path, words[8]), _pose(path, name, numbers[:4], numbers[4:7])


def _text_points(path: Path) -> tuple[np.ndarray, np.ndarray]:
    rows = [_numbers(path, words[1:7]) for words in _lines(path) if words]
    if any(len(row) != 6 for row in rows):
        raise _damaged(path, "a point has too few numbers")
    table = np.array(rows, dtype=np.float64).reshape(-1, 6)
    return table[:, :3], table[:, 3:]
