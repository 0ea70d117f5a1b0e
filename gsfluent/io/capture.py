"""Find out what kind of capture a folder holds and read it."""

from __future__ import annotations

import os
from pathlib import Path

from gsfluent.data.camera import Camera
from gsfluent.data.capture import Capture
from gsfluent.errors import InputError
from gsfluent.io.colmap import find_model, read_model
from gsfluent.io.exports.archive import unpacked
from gsfluent.io.exports.polycam import is_polycam, polycam_frames
from gsfluent.io.images import IMAGE_SUFFIXES
from gsfluent.io.splats.load import READERS
from gsfluent.io.transforms import capture_of, read_poses, read_transforms
from gsfluent.spatial.mesh_file import is_mesh

_TRANSFORMS = ("transforms.json", "transforms_train.json")


def kind_of(path: str | Path) -> str | None:
    """What a path holds: ``capture``, ``splats``, ``mesh`` or ``shot``; None for anything else.

    Names and headers are looked at, nothing is read.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if os.path.isdir(path):  # no error for names that cannot be one
        return "capture" if _posed(path) else None
    if is_mesh(path):
        return "mesh"
    if suffix == ".ply" or suffix in READERS:
        return "splats"
    return {".json": "capture", ".zip": "capture", ".yaml": "shot", ".yml": "shot"}.get(suffix)


def load_capture(path: str | Path) -> Capture:
    """Read a capture: a folder with a COLMAP model or a ``transforms.json``, or that file itself.

    A COLMAP model (``sparse/0`` and the usual other places) is preferred when both are there. A
    folder of Polycam's raw export is read, too, and a zip of any of them, which is unpacked beside
    itself.
    Photographs are only located, not decoded; :meth:`Capture.view` reads them.

    Args:
        path: Folder, ``.json`` or ``.zip`` file.

    Returns:
        The capture, cameras in the order of their image names.

    Raises:
        InputError: Nothing usable there, a damaged model, an unsupported lens, a pose or image
            missing.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path}: no such capture", "check the path")
    if path.suffix.lower() == ".zip" and not path.is_dir():
        path = _within(unpacked(path))
    if path.is_file():
        if path.suffix.lower() != ".json":
            raise InputError(
                f"{path}: a capture must be a folder or a transforms.json",
                "pass the folder of the capture",
            )
        return read_transforms(path)
    model = find_model(path)
    if model is not None:
        return read_model(model, path)
    for name in _TRANSFORMS:
        if (path / name).is_file():
            return read_transforms(path / name)
    if is_polycam(path):
        return capture_of(path / "keyframes", polycam_frames(path), path)
    raise _nothing_found(path)


def _posed(folder: Path) -> bool:
    """Whether a folder holds a capture itself."""
    named = any((folder / name).is_file() for name in _TRANSFORMS)
    return named or find_model(folder) is not None or is_polycam(folder)


def _within(folder: Path) -> Path:
    """The capture in an unpacked folder: itself, or one folder or two further down."""
    for place in (folder, *sorted(folder.glob("*/")), *sorted(folder.glob("*/*/"))):
        if _posed(place):
            return place
    return folder


def load_poses(path: str | Path) -> list[Camera]:
    """Read the cameras of a capture whose photographs need not be there, as a camera path.

    Args:
        path: Folder with a COLMAP model or a ``transforms.json``, or that file itself.

    Returns:
        The cameras: of a ``transforms.json`` in its order, of a model in the order of the names.

    Raises:
        InputError: Nothing usable there, a damaged model, an unsupported lens, a pose missing.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path}: no such camera path", "check the path")
    if path.is_file():
        return read_poses(path)
    model = find_model(path)
    if model is None and (path / "images.txt").is_file():
        model = path
    if model is not None:
        return read_model(model, path, photographs=False).cameras
    for name in _TRANSFORMS:
        if (path / name).is_file():
            return read_poses(path / name)
    raise _nothing_found(path)


def _nothing_found(path: Path) -> InputError:
    """Explain what a folder without poses does hold."""
    if not any(path.iterdir()):
        return InputError(
            f"{path}: the capture folder is empty",
            "put images/ and sparse/0 or transforms.json there",
        )
    folders = [folder for folder in (path / "images", path) if folder.is_dir()]
    images = sum(
        1
        for folder in folders
        for file in folder.iterdir()
        if file.suffix.lower() in IMAGE_SUFFIXES
    )
    if images:
        return InputError(
            f"{path}: {images} images but no poses (no sparse/0 and no transforms.json)",
            f"pose them first: gsfluent poses {path} -o capture, or COLMAP into sparse/0",
        )
    return InputError(
        f"{path}: no COLMAP model and no transforms.json here", "pass the folder that holds them"
    )
