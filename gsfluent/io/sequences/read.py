"""Any file or folder to a :class:`Sequence`."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsfluent.errors import InputError
from gsfluent.io.checked.arrays import read_npy, read_npz
from gsfluent.io.sequences.gltf_animation import read_gltf
from gsfluent.io.sequences.scene_files import (
    VTK_ENDINGS,
    read_usd,
    read_vtk_files,
    read_vtk_series,
)
from gsfluent.io.sequences.sequence import FPS, Sequence, checked, stacked
from gsfluent.io.splats.ply import read_ply
from gsfluent.spatial.mesh_file import is_mesh, read_parts

_POSITIONS = ("positions", "points", "vertices", "x", "particle_q")
"""Names of positions in an ``.npz`` file, likeliest first."""
_FRAMES = (".npy", ".ply", ".obj", ".stl", ".off", *VTK_ENDINGS)
"""Endings of files that hold one frame each."""
_HINT = (
    "give an .npz or .npy [T, N, 3], a folder of frames (.npy, .ply, .obj, .vtk), an animated "
    ".glb, a .usd, a .vtk.series or a .pvd"
)


def read_sequence(path: str | Path, fps: float | None = None) -> Sequence:
    """Read moving points or a moving mesh.

    Args:
        path: ``.npz`` (``positions`` [T, N, 3], and if there are any ``faces`` [F, 3], ``times``
            [T] or ``fps``), ``.npy``, a folder with a file per frame in the order of their numbers,
            an animated ``.glb`` or ``.gltf``, ``.usd``, ``.usda``, ``.usdc``, ``.usdz``,
            ``.vtk.series`` or ``.pvd``.
        fps: Frames per second where the file has no times; also how often an animation that is
            continuous is sampled. 24 when None.

    Raises:
        InputError: Not such a file, or what it holds is no sequence of the same points.
        MissingPackage: A library of the format is not installed.
    """
    path = Path(path)
    if fps is not None and not 0.0 < fps <= 1e6:
        raise InputError(f"fps is {fps:g}", "give frames per second above 0")
    if not path.exists():
        raise InputError(f"{path} does not exist", "check the path")
    suffix = path.suffix.lower()
    if path.is_dir():
        return _folder(path, fps)
    if suffix == ".npz":
        return _npz(path, fps)
    if suffix == ".npy":
        return checked(path, read_npy(path), fps=fps)
    if suffix in (".glb", ".gltf"):
        return read_gltf(path, fps or FPS)
    if suffix.startswith(".usd"):
        return read_usd(path, fps or FPS)
    if suffix in (".series", ".pvd"):
        return read_vtk_series(path, fps)
    raise InputError(f"{path}: no sequence", _HINT)


def _npz(path: Path, fps: float | None) -> Sequence:
    arrays = read_npz(path)
    named = [name for name in _POSITIONS if name in arrays]
    if not named:
        raise InputError(
            f"{path}: has {', '.join(arrays) or 'nothing'}, but no positions",
            "save positions [T, N, 3], and if there are any faces [F, 3] and times [T]",
        )
    rate = fps
    if "fps" in arrays and fps is None:
        rate = float(np.ravel(arrays["fps"])[0])
        if not rate > 0.0:
            raise InputError(f"{path}: fps is {rate:g}", "save frames per second above 0")
    times = arrays.get("times", arrays.get("time"))
    return checked(path, arrays[named[0]], times, arrays.get("faces"), rate)


def _folder(path: Path, fps: float | None) -> Sequence:
    """The files of a folder that hold a frame each, by number."""
    groups: dict[str, list[Path]] = {}
    for file in path.iterdir():
        if file.is_file() and file.suffix.lower() in _FRAMES:
            groups.setdefault(file.suffix.lower(), []).append(file)
    if not groups:
        raise InputError(f"{path}: no frames in this folder", _HINT)
    if len(groups) > 1:
        raise InputError(f"{path}: frames of {', '.join(sorted(groups))}", "keep one kind of file")
    ending, files = groups.popitem()
    files.sort(key=_natural)
    if ending in VTK_ENDINGS:
        return read_vtk_files(path, files, None, fps)
    read = [_frame(file) for file in files]
    return checked(path, stacked(path, [points for points, _ in read]), None, read[0][1], fps)


def _natural(path: Path) -> list[Any]:
    """Sorts frame_2 before frame_10."""
    return [int(w) if w.isdigit() else w for w in re.split(r"(\d+)", path.name)]


def _frame(path: Path) -> tuple[NDArray[Any], NDArray[np.int64] | None]:
    """Points and triangles of one file."""
    if path.suffix.lower() == ".npy":
        return read_npy(path), None
    if not is_mesh(path):
        columns = read_ply(path)
        try:
            rows = columns["vertex"]
            return np.stack([np.asarray(rows[axis], np.float64) for axis in "xyz"], axis=1), None
        except (KeyError, ValueError) as error:
            raise InputError(f"{path}: has no x, y and z", "export points") from error
    parts, count = read_parts(path), 0
    points, faces = [], []
    for part in parts:
        points.append(np.asarray(part.vertices, np.float64))
        faces.append(np.asarray(part.faces, np.int64) + count)
        count += len(part.vertices)
    return np.concatenate(points), np.concatenate(faces)
