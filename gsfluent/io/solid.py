"""Solids in files: the splats as a ``.ply``, the volume beside it; ``gf.load`` and ``gf.save``."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsfluent.data.frame import Frame
from gsfluent.data.gaussians import Gaussians
from gsfluent.data.solid import Solid
from gsfluent.errors import InputError
from gsfluent.io.atomic import atomic_path
from gsfluent.io.checked.arrays import read_npz
from gsfluent.io.splats.load import load_splats, save_splats

_VOLUME = ".volume.npz"


def load(path: str | Path) -> Gaussians | Solid:
    """Read what :func:`save` wrote: a solid where its volume lies beside the ``.ply``, else splats.

    Splats of other programs are read, too: see :func:`gsfluent.io.load_splats`.

    Raises:
        InputError: As :func:`gsfluent.io.load_splats` and :func:`load_solid`; or the path is that
            of a volume, which is read with its splats.
    """
    if (name := Path(path).name).lower().endswith(_VOLUME):
        splats = Path(path).with_name(f"{name[: -len(_VOLUME)]}.ply")
        missing = "" if splats.is_file() else ", which is not there: fill it anew"
        raise InputError(
            f"{path}: the volume of a solid, which is read with its splats",
            f"load {splats}{missing}",
        )
    solid = Path(path).suffix.lower() == ".ply" and volume_path(path).is_file()
    return load_solid(path) if solid else load_splats(path)


def save(thing: Gaussians | Solid, path: str | Path) -> None:
    """Write Gaussians or a solid to ``path`` (.ply), so that :func:`load` gives it back.

    A solid's volume goes beside it. One that is left from an earlier solid of that name is
    removed when Gaussians take its place.

    Args:
        thing: What to write.
        path: The ``.ply``.

    Raises:
        InputError: Neither of the two, or values that no stage can work with.
        RunError: The disk is full or the folder cannot be written.
    """
    if isinstance(thing, Solid):
        save_solid(thing, path)
    elif isinstance(thing, Gaussians):
        save_splats(thing, path)
        volume_path(path).unlink(missing_ok=True)
    else:
        raise InputError(
            f"gf.save: got {type(thing).__name__}",
            "give Gaussians or a Solid; for others see gf.io",
        )


def save_solid(solid: Solid, path: str | Path) -> None:
    """Write the splats to ``path`` (.ply) and the volume to ``<name>.volume.npz`` beside it."""
    path = Path(path)
    arrays: dict[str, Any] = {
        "occupancy": np.packbits(solid.occupancy.cpu().numpy()),
        "shape": np.array(solid.occupancy.shape, dtype=np.int64),
        "depth": solid.depth.cpu().numpy(),
        "origin": solid.origin.cpu().numpy(),
        "voxel": np.float64(solid.voxel),
        "report": np.array(json.dumps(_timeless(solid.report))),
        "frame": np.array(json.dumps(None if solid.frame is None else solid.frame.to_dict())),
    }
    if solid.color is not None:
        arrays["color"] = solid.color.cpu().numpy()
    if solid.regions is not None:
        arrays["regions"] = solid.regions.cpu().numpy()
    save_splats(solid.gaussians, path)
    with atomic_path(volume_path(path)) as temporary, open(temporary, "wb") as stream:
        np.savez_compressed(stream, **arrays)


def _timeless(report: Mapping[str, Any]) -> dict[str, Any]:
    """A report without wall times: the same solid is the same file."""
    kept = {key: value for key, value in report.items() if key != "seconds"}
    return {
        key: _timeless(value) if isinstance(value, Mapping) else value
        for key, value in kept.items()
    }


def load_solid(path: str | Path) -> Solid:
    """Read what :func:`save_solid` wrote.

    Raises:
        InputError: The splats or the volume are missing or damaged.
    """
    path = Path(path)
    gaussians = load_splats(path)
    beside = volume_path(path)
    if not beside.is_file():
        raise InputError(
            f"{path}: a solid needs {beside.name} beside it, got none",
            "make both with `gsfluent fill`",
        )
    hint = "make it again with `gsfluent fill`"
    arrays = read_npz(beside, hint=hint)
    try:
        size = tuple(int(count) for count in arrays["shape"])
        if len(size) != 3 or min(size) < 1 or math.prod(size) > 8 * arrays["occupancy"].size:
            raise ValueError(f"a grid of {list(size)} in {arrays['occupancy'].size} bytes")
        bits = np.unpackbits(arrays["occupancy"], count=math.prod(size))
        frame = json.loads(str(arrays["frame"]))
        for name in ("depth", "origin", "color"):
            if name in arrays and not np.isfinite(arrays[name]).all():
                raise ValueError(f"{name} holds NaN or infinity")
        if gaussians.labels is None:
            gaussians = gaussians.replace(labels=torch.zeros(gaussians.count, dtype=torch.int32))
        return Solid(
            gaussians,
            torch.from_numpy(bits.reshape(size).astype(bool)),
            torch.from_numpy(arrays["depth"]),
            torch.from_numpy(arrays["origin"]),
            float(arrays["voxel"]),
            torch.from_numpy(arrays["color"]) if "color" in arrays else None,
            torch.from_numpy(arrays["regions"]) if "regions" in arrays else None,
            json.loads(str(arrays["report"])),
            None if frame is None else Frame.from_dict(frame),
        )
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise InputError(f"{beside}: the volume file is damaged ({error})", hint) from error


def volume_path(path: str | Path) -> Path:
    """Name of the volume file that belongs to a solid ``.ply``."""
    return Path(path).with_suffix(_VOLUME)
