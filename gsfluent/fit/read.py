"""Targets from files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from gsfluent.config import Shot
from gsfluent.data import Frame
from gsfluent.errors import InputError
from gsfluent.io.capture import load_poses
from gsfluent.io.checked.files import read_text
from gsfluent.io.images import IMAGE_SUFFIXES, mask_of, read_array
from gsfluent.io.sequences import read_clouds, read_sequence
from gsfluent.targets.force import Force
from gsfluent.targets.masks import Masks
from gsfluent.targets.points import Clouds, Points
from gsfluent.targets.target import Target

FPS = 24.0
"""Frames per second of clouds that do not say."""


def read_target(
    kind: str, path: Path, *, sigma: float | None, fps: float | None, shot: Shot
) -> Target:
    """Read what was seen.

    Args:
        kind: ``points``: a sequence [T, K, 3] of the same points. ``clouds``: a folder of ``.ply``
            or ``.npy`` clouds or splats, which need no common order. ``force``: a CSV with the
            columns displacement [m] and force [N].
        path: The file or folder.
        sigma: Standard deviation, see the target; its default when None.
        fps: Frames per second where the file has no times.
        shot: Has the collider that a force acts on.

    Raises:
        InputError: Not such a file, or what it holds is no target.
    """
    more: dict[str, Any] = {} if sigma is None else {"sigma": sigma}
    if kind == "points":
        seen = read_sequence(path, fps)
        return Points(seen.positions, times=seen.times.tolist(), **more)
    if kind == "clouds":
        return Clouds(read_clouds(path), fps=fps or FPS, **more)
    moving = [c for c in shot.colliders if any(getattr(c, "velocity", (0.0,)))]
    if len(moving) != 1:
        raise InputError(f"--force: the shot has {len(moving)} moving colliders", "give it one")
    table = _table(path)
    speed = float(np.linalg.norm(getattr(moving[0], "velocity", (0.0,))))
    return Force(table[:, 0].tolist(), table[:, 1].tolist(), speed=speed, **more)


def read_masks(
    path: Path, cameras: Path, frame: Frame, *, sigma: float | None, fps: float | None,
    colors: bool = False,
) -> Masks:  # fmt: skip
    """Read films of masks from posed cameras that stand still.

    Args:
        path: A folder with a folder of pictures for each camera, named as its image without the
            suffix; pictures in the order of their names, white or opaque where the object is.
        cameras: A COLMAP model or ``transforms.json``, as of the capture of the splats; more
            cameras than films are no harm.
        frame: From the world of the cameras to the scene.
        sigma: Standard deviation of a pixel.
        fps: Frames per second; 24 when None.
        colors: Pictures are opaque where the object is, and have its colours.

    Raises:
        InputError: A film without a camera, films of unlike length or size, or a lens that bends.
    """
    posed = {Path(camera.name).stem: camera for camera in load_poses(cameras)}
    films = sorted(p for p in path.iterdir() if p.is_dir()) if path.is_dir() else []
    if not films:
        raise InputError(f"{path}: no films", "a folder for each camera, with a picture per frame")
    stray = [film.name for film in films if film.name not in posed]
    if stray:
        few = ", ".join(sorted(posed)[:4])
        raise InputError(f"{path}: no camera {stray[0]!r} in {cameras}", f"there are {few}, ...")
    used = [posed[film.name] for film in films]
    if any(any(camera.distortion) for camera in used):
        raise InputError(f"{cameras}: the lenses bend", "undistort the films and their cameras")
    seen, painted = [], []
    for film in films:
        files = sorted(p for p in film.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES)
        arrays = [read_array(file) for file in files]
        pictures = [mask_of(array) for array in arrays]
        if len({picture.shape for picture in pictures}) != 1:
            raise InputError(f"{film}: no pictures, or of several sizes", "one size for a film")
        seen.append(np.stack(pictures))
        if colors:
            if any(array.shape[2] != 4 for array in arrays):
                raise InputError(
                    f"{film}: --colors needs pictures with transparency",
                    "PNG, opaque where the object is; or leave out --colors",
                )
            painted.append(np.stack([array[..., :3] for array in arrays]))
    if len({film.shape for film in seen}) != 1:
        shapes = ", ".join(f"{f.name} {list(s.shape)}" for f, s in zip(films, seen, strict=True))
        raise InputError(f"{path}: films are unlike: {shapes}", "as many frames of one size each")
    more: dict[str, Any] = {} if sigma is None else {"sigma": sigma}
    moved = [camera.transformed(frame) for camera in used]
    paint = np.stack(painted) if painted else None
    return Masks(moved, np.stack(seen), colors=paint, fps=fps or FPS, **more)


def _table(path: Path) -> np.ndarray:
    """Numbers of the columns displacement and force, [T, 2].

    Raises:
        InputError: No such columns, or no numbers.
    """
    lines = [line for line in read_text(path, noun="table").splitlines() if line.strip()]
    head = [word.strip().lower() for word in lines[0].split(",")] if lines else []
    try:
        columns = [head.index("displacement"), head.index("force")]
        rows = [[float(line.split(",")[c]) for c in columns] for line in lines[1:]]
        return np.asarray(rows, np.float64).reshape(-1, 2)
    except (ValueError, IndexError) as error:
        raise InputError(
            f"{path}: no table of displacement and force ({error})",
            "a first line displacement,force, then numbers in metres and newtons",
        ) from error
