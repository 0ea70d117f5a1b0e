"""Small inputs under the names that README and guide use."""

from __future__ import annotations

import importlib.util
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
import yaml
from PIL import Image

from gsfluent.data import SURFACE, Gaussians
from gsfluent.demo import make_capture
from gsfluent.io import save

TESTS = Path(__file__).resolve().parents[1]
SHOT: dict[str, Any] = {
    "capture": "captures/apple",
    "size": 0.16,
    "reconstruct": {"iterations": 40, "max_gaussians": 900, "image_size": 48},
    "fill": {"resolution": 24},
    "texture": {"method": "color_copy"},
    "objects": {"apple": {"material": "fruit.apple"}},
    "events": [{"type": "drop", "height": 0.02}],
    "solve": {"cells": 8},
    "output": {"fps": 20, "seconds": 0.25, "size": [96, 64]},
}
PHYSGAUSSIAN: dict[str, Any] = {
    "material": "jelly", "E": 2e4, "nu": 0.3, "density": 200, "g": [0, 0, -9.8], "n_grid": 40,
    "substep_dt": 1e-4, "frame_dt": 0.02, "frame_num": 3,
}  # fmt: skip
CAMERA: dict[str, Any] = {
    "id": 0, "img_name": "r_0", "width": 97, "height": 64, "fx": 90.0, "fy": 90.0,
    "position": [0.0, -0.6, 0.1], "rotation": [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
}  # fmt: skip


def shell(count: int = 1500) -> Gaussians:
    """Splats over an ellipsoid 0.26 m long, striped so that there is a texture to look at."""
    index = torch.arange(count) + 0.5
    polar = torch.acos(1 - 2 * index / count)
    turn = math.pi * (1 + math.sqrt(5)) * index
    unit = torch.stack([turn.cos() * polar.sin(), turn.sin() * polar.sin(), polar.cos()], dim=-1)
    size = torch.full((count,), 0.078 * math.sqrt(4 * math.pi / count))
    stripe = (unit[:, :1] * 20).sin() > 0
    colors = torch.where(stripe, torch.tensor([0.1, 0.4, 0.1]), torch.tensor([0.5, 0.7, 0.3]))
    means = unit * torch.tensor([0.13, 0.06, 0.06])
    return Gaussians.from_colors(means, size, colors, opacities=0.95, label=SURFACE)


def write_cut(path: Path) -> None:
    """A cut of a round fruit before white: green rind, red flesh."""
    y, x = np.mgrid[-1:1:96j, -1:1:96j]
    radius = np.hypot(x, y)[..., None]
    flesh = np.array([0.85, 0.25, 0.2]) + 0.05 * np.sin(40 * x * y)[..., None]
    rind = np.array([0.2, 0.5, 0.15])
    pixels = np.where(radius < 0.75, flesh, np.where(radius < 0.85, rind, 1.0))
    Image.fromarray((255 * pixels.clip(0, 1)).astype(np.uint8)).save(path, quality=95)


def write_box(path: Path, edge: float = 0.1) -> None:
    """A closed cube of triangles."""
    corners = [(x, y, z) for x in (0, edge) for y in (0, edge) for z in (0, edge)]
    faces = [(1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4)]
    lines = [f"v {x} {y} {z}" for x, y, z in corners]
    lines += [f"f {a} {b} {c}\nf {a} {c} {d}" for a, b, c, d in faces]
    path.write_text("\n".join(lines) + "\n")


def write_model(folder: Path) -> None:
    """A model folder as the INRIA trainer leaves it: the shell, one camera."""
    place = folder / "point_cloud" / "iteration_30"
    place.mkdir(parents=True)
    save(shell(800), place / "point_cloud.ply")
    (folder / "cameras.json").write_text(json.dumps([CAMERA]))


def write_parts(folder: Path, capture: Path) -> None:
    """A mask and a label image per photograph: the upper half of each is both."""
    (folder / "parts" / "stem").mkdir(parents=True)
    (folder / "segmentation").mkdir()
    for photograph in sorted((capture / "images").iterdir()):
        width, height = Image.open(photograph).size
        half = np.zeros((height, width), dtype=np.uint8)
        half[: height // 2] = 255
        name = f"{photograph.stem}.png"
        Image.fromarray(half).save(folder / "parts" / "stem" / name)
        Image.fromarray(half // 255).save(folder / "segmentation" / name)
    (folder / "segmentation" / "labels.json").write_text(json.dumps({"1": "leaf"}))


def helper(path: str) -> Any:
    """A module of other tests."""
    spec = importlib.util.spec_from_file_location(Path(path).stem, TESTS / path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def write_diffusion(folder: Path) -> None:
    """An inpainting pipeline with random weights, as the tests of the texture stage make it."""
    helper("pipeline/texture/tiny_diffusers.py").save_sdxl(folder)


def write_photographs(folder: Path) -> None:
    """Photographs without poses."""
    corner = helper("posing/papered_corner.py")
    folder.mkdir()
    for number, eye in enumerate(corner.eyes()):
        picture = corner.photograph(eye, corner.walls())
        Image.fromarray(picture).save(folder / f"{number}.png")


def write_moving(folder: Path) -> None:
    """Points around the shell that turn, as arrays, as a file per frame and as a mesh."""
    rest = shell(200).means.double().numpy()
    turns = [np.array([[1, 0, 0], [0, math.cos(a), -math.sin(a)], [0, math.sin(a), math.cos(a)]])
             for a in (0.0, 0.2)]  # fmt: skip
    frames = np.stack([rest @ turn.T for turn in turns])
    np.savez(folder / "cloth.npz", positions=frames, fps=24.0)
    (folder / "frames").mkdir()
    for number, points in enumerate(frames):
        np.save(folder / "frames" / f"frame_{number}.npy", points)


def write_inputs(folder: Path) -> None:
    """Everything that a user brings."""
    save(shell(), folder / "melon.ply")
    write_cut(folder / "cut.jpg")
    write_box(folder / "scan.obj")
    trimesh.creation.box((0.06, 0.14, 0.06)).export(folder / "vase.glb")
    make_capture("orange", folder / "captures" / "apple", views=9, size=64)
    write_photographs(folder / "photos")
    write_parts(folder, folder / "captures" / "apple")
    if importlib.util.find_spec("transformers"):  # of the extra `inpaint`
        write_diffusion(folder / "models" / "sdxl-inpainting")
    write_moving(folder)
    write_model(folder / "model")
    (folder / "phys.json").write_text(json.dumps(PHYSGAUSSIAN))
    (folder / "shot.yaml").write_text(yaml.safe_dump(SHOT, sort_keys=False))
    fruit = {key: SHOT[key] for key in ("fill", "texture", "solve")}
    fruit |= {"splats": "melon.ply", "size": 0.25, "events": [{"type": "drop", "height": 0.02}]}
    fruit["output"] = {"fps": 20, "seconds": 0.1, "size": [64, 48]}
    (folder / "fruit.yaml").write_text(yaml.safe_dump(fruit))
    (folder / "fruits.yaml").write_text(
        yaml.safe_dump({"shot": "fruit.yaml", "vary": {"seed": [3]}})
    )
