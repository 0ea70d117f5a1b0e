"""The known inside of a demo object as a file: a colour, label and depth volume."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsfluent.demo.catalogue import OBJECTS
from gsfluent.demo.objects import DemoObject
from gsfluent.errors import InputError


def grid_points(lower: Tensor, voxel: float, shape: tuple[int, int, int]) -> Tensor:
    """Voxel centres ``lower + (i + 0.5) * voxel`` in row-major order, float64 [X * Y * Z, 3]."""
    lines = [
        float(lower[k]) + (torch.arange(shape[k], dtype=torch.float64) + 0.5) * voxel
        for k in range(3)
    ]
    return torch.stack(torch.meshgrid(*lines, indexing="ij"), -1).reshape(-1, 3)


def sample_truth(obj: DemoObject, resolution: int = 128) -> dict[str, Any]:
    """Sample an object on a cube of voxels around it.

    Returns:
        ``color`` uint8 [R, R, R, 3], ``parts`` uint16 [R, R, R] (0 outside, 1 rind,
        2 pith, 3 flesh, 4 + k seed k), ``depth`` float32 [R, R, R] metres below the surface
        (0 outside), ``origin`` float64 [3], ``voxel``, ``name``, ``seed``.
    """
    with obj.center.device:
        return _sample_truth(obj, resolution)


def _sample_truth(obj: DemoObject, resolution: int) -> dict[str, Any]:
    lower, upper = obj.bounds()
    extent = float((upper - lower).max()) * 1.02
    origin = 0.5 * (lower + upper) - 0.5 * extent
    voxel = extent / resolution
    points = grid_points(origin, voxel, (resolution,) * 3)
    inside = torch.nonzero(obj.inside(points))[:, 0]
    color = torch.zeros(len(points), 3, dtype=torch.uint8)
    parts = torch.zeros(len(points), dtype=torch.int32)
    depth = torch.zeros(len(points), dtype=torch.float32)
    matter = points[inside]
    color[inside] = (obj.interior(matter) * 255.0).round().to(torch.uint8)
    parts[inside] = obj.parts(matter).to(torch.int32)
    depth[inside] = obj.depth(matter).to(torch.float32).clamp_min(0.0)
    cube = (resolution,) * 3
    return {
        "color": color.view(*cube, 3).cpu().numpy(),
        "parts": parts.view(cube).cpu().numpy().astype(np.uint16),
        "depth": depth.view(cube).cpu().numpy(), "origin": origin.cpu().numpy(),
        "voxel": np.float64(voxel),
        "name": np.array(obj.name), "seed": np.int64(obj.seed),
    }  # fmt: skip


def save_truth(obj: DemoObject, path: str | Path, resolution: int = 128) -> None:
    """Write :func:`sample_truth` to a compressed ``.npz``."""
    np.savez_compressed(path, **sample_truth(obj, resolution))


def load_truth(path: str | Path) -> DemoObject:
    """The object a truth file was sampled from, rebuilt from its name and seed.

    Raises:
        InputError: The file is missing or is no truth file.
    """
    try:
        with np.load(path, allow_pickle=False) as stored:
            name, seed = str(stored["name"]), int(stored["seed"])
    except (OSError, KeyError, ValueError) as error:
        raise InputError(
            f"truth file {path}: {error}", "give the truth.npz that make_capture wrote"
        ) from error
    if name not in OBJECTS:
        raise InputError(
            f"truth file {path} names the object {name!r}",
            f"it must be one of {', '.join(sorted(OBJECTS))}",
        )
    return OBJECTS[name](seed)
