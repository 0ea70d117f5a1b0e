"""Polycam's raw export: ``keyframes/`` with a photograph and a camera file each.

``corrected_cameras`` and ``corrected_images`` are preferred to ``cameras`` and ``images``. A camera
file has ``fx fy cx cy width height`` in pixels and ``t_00`` to ``t_23``, camera-to-world with
OpenGL axes in a world whose +y is up. Layout: nerfstudio's documentation of its Polycam import.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gsfluent.errors import InputError
from gsfluent.io.checked.files import read_json

_PLACES = (("corrected_cameras", "corrected_images"), ("cameras", "images"))
_ROWS = (2, 0, 1)  # of their world, so that +z is up in ours


def is_polycam(folder: Path) -> bool:
    """Whether a folder is such an export."""
    return any((folder / "keyframes" / cameras).is_dir() for cameras, _ in _PLACES)


def polycam_frames(folder: Path) -> dict[str, Any]:
    """The cameras as a ``transforms.json`` has them, names from ``folder``.

    Raises:
        InputError: A camera file is damaged, or there is none.
    """
    cameras, images = next(pair for pair in _PLACES if (folder / "keyframes" / pair[0]).is_dir())
    frames = []
    for path in sorted((folder / "keyframes" / cameras).glob("*.json")):
        values = read_json(path)
        try:
            pose = [[float(values[f"t_{row}{column}"]) for column in range(4)] for row in _ROWS]
            lens = {ours: float(values[theirs]) for ours, theirs in
                    (("fl_x", "fx"), ("fl_y", "fy"), ("cx", "cx"), ("cy", "cy"),
                     ("w", "width"), ("h", "height"))}  # fmt: skip
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise InputError(
                f"{path}: is no camera of Polycam ({type(error).__name__}: {error})",
                "export the raw data again",
            ) from error
        name = f"keyframes/{images}/{path.stem}"
        frames.append({"file_path": name, "transform_matrix": [*pose, [0, 0, 0, 1]], **lens})
    if not frames:
        raise InputError(f"{folder}: keyframes/{cameras} is empty", "export the raw data again")
    return {"frames": frames}
