"""Find out what kind of capture a folder holds and read it."""

from __future__ import annotations

import os
from pathlib import Path

from gsfluent.data.camera import Camera
from gsfluent.data.capture import Capture
from gsfluent.errors import InputError
from gsfluent.io.colmap import find_model, read_model
from gsfluent.io.images import IMAGE_SUFFIXES
from gsfluent.io.splats.load import READERS
from gsfluent.io.transforms import read_poses, read_transforms
from gsfluent.spatial.mesh_file import is_mesh

_TRANSFORMS = ("transforms.json", "transforms_train.json")


def kind_of(path: str | Path) -> str | None:
    """What a path holds: ``capture``, ``splats``, ``mesh`` or ``shot``; None for anything else.

    Names and headers are looked at, nothing is read.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if os.path.isdir(path):  # no error for names that cannot be one
        posed = any((path / name).is_file() for name in _TRANSFORMS)
        return "capture" if posed or find_model(path) is not None else None
    if is_mesh(path):
        return "mesh"
    if suffix == ".ply" or suffix in READERS:
        return "splats"
    return {".json": "capture", ".yaml": "shot", ".yml": "shot"}.get(suffix)


def load_capture(path: str | Path) -> Capture:
    """Read a capture: a folder with a COLMAP model or a ``transforms.json``, or that file itself.

    A COLMAP model (``sparse/0`` and the usual other places) is preferred when both are there.
    Photographs are only located, not decoded; :meth:`Capture.view` reads them.

    Args:
        path: Folder or ``.json`` file.

    Returns:
        The capture, cameras in the order of their image names.

    Raises:
        InputError: Nothing usable there, a damaged model, an unsupported lens, a pose or image
            missing.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path}: no such capture", "check the path")
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
    raise _nothing_found(path)


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
            "pose them first, for example with `colmap automatic_reconstructor`, into sparse/0",
        )
    return InputError(
        f"{path}: no COLMAP model and no transforms.json here", "pass the folder that holds them"
    )
