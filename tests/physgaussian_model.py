"""A small model folder as the INRIA trainer leaves it: a filled ball, one camera."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch

from gsfluent.data import Gaussians
from gsfluent.io import save_splats

RADIUS, CENTER = 1.5, (0.1, -0.2, 0.3)


def write_model(folder: Path, count: int = 1500, *, far: bool = False) -> Path:
    """Write the model; with ``far`` also a wall of Gaussians at x = 5 and faint ones far away."""
    generator = torch.Generator().manual_seed(0)
    way = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    means = RADIUS * way * torch.rand(count, 1, generator=generator) ** (1 / 3)
    means[:6] = RADIUS * torch.cat([torch.eye(3), -torch.eye(3)])  # its bounds are known exactly
    means += torch.tensor(CENTER)
    opacities = torch.full((count,), 0.9)
    if far:
        wall = torch.rand(50, 3, generator=generator) + torch.tensor([5.0, 0.0, 0.0])
        faint = torch.full((20, 3), -50.0)
        means = torch.cat([means, wall, faint])
        opacities = torch.cat([opacities, torch.full((50,), 0.8), torch.full((20,), 0.01)])
    total = means.shape[0]
    colors = torch.rand(total, 3, generator=generator)
    splats = Gaussians.from_colors(means, torch.full((total,), 0.14), colors, opacities=opacities)
    for iteration in (7, 30):
        place = folder / "point_cloud" / f"iteration_{iteration}"
        place.mkdir(parents=True)
        save_splats(splats if iteration == 30 else splats.select(torch.arange(1)),
                    place / "point_cloud.ply")  # fmt: skip
    camera: dict[str, Any] = {
        "id": 0, "img_name": "r_0", "width": 97, "height": 64, "fx": 90.0, "fy": 90.0,
        "position": [0.1, -7.0, 0.3], "rotation": [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
    }  # fmt: skip
    (folder / "cameras.json").write_text(json.dumps([camera]))
    (folder / "cfg_args").write_text("Namespace(sh_degree=3)")
    return folder


def config(path: Path, **keys: Any) -> Path:
    """Write a config: a ball of jelly in their box, with keys replaced or added."""
    values: dict[str, Any] = {
        "material": "jelly", "E": 2e4, "nu": 0.3, "density": 200, "g": [0, 0, -9.8], "n_grid": 40,
        "substep_dt": 1e-4, "frame_dt": 0.02, "frame_num": 10,
    }  # fmt: skip
    path.write_text(json.dumps(values | keys))
    return path
