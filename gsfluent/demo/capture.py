"""Photographs of a demo object: ray casting, cameras, and the capture folder.

The images come from intersecting rays with the object itself, never from splats, so a
reconstruction made from them is tested against something it did not make.
"""

from __future__ import annotations

import copy
import json
import math
import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsfluent.demo.catalogue import OBJECTS
from gsfluent.demo.noise import SolidNoise, mix, smoothstep
from gsfluent.demo.objects import DemoObject
from gsfluent.demo.truth import save_truth
from gsfluent.errors import InputError
from gsfluent.geometry import look_at
from gsfluent.progress import Progress, report_progress

_KEY_LIGHT = (0.45, -0.35, 0.82)
_RINGS = ((38.0, 0.40), (6.0, 0.35), (-32.0, 0.25))  # elevation [deg], share of the views
_RINGS_ABOVE = ((55.0, 0.25), (33.0, 0.40), (14.0, 0.35))
_FIELD_OF_VIEW = 40.0
_CHUNK = 8192  # rays evaluated at a time, so that they stay in the cache


@dataclass(frozen=True)
class DemoPaths:
    """Files of a demo capture.

    Attributes:
        root: The capture folder, what ``gsfluent reconstruct`` takes.
        transforms: Cameras (nerfstudio's ``transforms.json``).
        images: Photographs in the order of the cameras.
        truth: Colours, labels and depths of the inside, a 128^3 volume (``.npz``).
        cut: Photograph of a cut through a fruit of the same kind, RGBA: the exemplar.
    """

    root: Path
    transforms: Path
    images: list[Path]
    truth: Path
    cut: Path


def make_object(name: str = "watermelon", seed: int = 0) -> DemoObject:
    """The demo object ``name`` (a key of ``catalogue.OBJECTS``), drawn from ``seed``.

    Raises:
        InputError: There is no such object.
    """
    if name not in OBJECTS:
        raise InputError(
            f"demo object {name!r} does not exist", f"choose one of {', '.join(sorted(OBJECTS))}"
        )
    return OBJECTS[name](seed)


def moved(value: Any, device: torch.device) -> Any:
    """An object of this room, or a list or tuple of them, with its tensors on a device."""
    if isinstance(value, Tensor):
        return value.to(device)
    if isinstance(value, list | tuple):
        return type(value)(moved(one, device) for one in value)
    if isinstance(value, DemoObject | SolidNoise | Table):
        there = copy.copy(value)
        vars(there).update({name: moved(one, device) for name, one in vars(value).items()})
        return there
    return value


def ring_cameras(obj: DemoObject, views: int, *, on_table: bool) -> list[Tensor]:
    """World-to-camera matrices on three rings, one of them below the object unless ``on_table``.

    Views of the middle ring of an object with level faces graze these by turns: a silhouette from
    elsewhere leaves a cone on a face, and nothing else shows a plain one flat.
    """
    rings = _RINGS_ABOVE if on_table else _RINGS
    distance = 1.12 * max(obj.axes) / math.sin(math.radians(0.5 * _FIELD_OF_VIEW))
    distance *= 1.5 if on_table else 1.0
    counts = [max(1, round(share * views)) for _, share in rings]
    counts[0] += views - sum(counts)
    cameras = []
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    for ring, ((elevation, _), count) in enumerate(zip(rings, counts, strict=True)):
        middle = ring == 1 and obj.level_faces and not on_table
        grazing = math.asin(obj.axes[2] / distance)
        for step in range(count):
            height = (1 - step % 2 * 2) * grazing if middle else math.radians(elevation)
            turn = 2.0 * math.pi * (step + 0.37 * ring) / count
            unit = [
                math.cos(turn) * math.cos(height),
                math.sin(turn) * math.cos(height),
                math.sin(height),
            ]
            eye = obj.center + distance * torch.tensor(unit, dtype=torch.float64)
            cameras.append(look_at(eye, obj.center, up))
    return cameras


def photograph(
    obj: DemoObject, view: Tensor, size: int, *, supersample: int = 2, table: Table | None = None
) -> tuple[Tensor, Tensor]:
    """One photograph by ray casting with box-filter anti-aliasing.

    Args:
        obj: What is photographed; on the device on which it is drawn (:func:`moved`).
        view: World-to-camera matrix, shape [4, 4].
        size: Width and height [px].
        supersample: Rays per pixel and axis.
        table: A table and a room around the object; without one the object floats before nothing.

    Returns:
        Image [size, size, 3] sRGB and coverage of the object [size, size], both float32 in [0, 1].
        Without a table the colour is that of the covered part of the pixel (straight alpha).
    """
    with obj.center.device:
        return _photograph(obj, view.to(obj.center), size, supersample, table)


def _photograph(
    obj: DemoObject, view: Tensor, size: int, supersample: int, table: Table | None
) -> tuple[Tensor, Tensor]:
    fine = size * supersample
    focal = 0.5 * fine / math.tan(math.radians(0.5 * _FIELD_OF_VIEW))
    rotation, eye = view[:3, :3], -(view[:3, :3].T @ view[:3, 3])
    axis = (torch.arange(fine, dtype=torch.float32) + 0.5 - 0.5 * fine) / focal
    color = torch.zeros(fine, fine, 3)
    cover = torch.zeros(fine, fine)
    turn = rotation.to(torch.float32)
    rows = max(1, _CHUNK // fine) if view.device.type == "cpu" else fine
    for top in range(0, fine, rows):
        y, x = torch.meshgrid(axis[top : top + rows], axis, indexing="ij")
        direction = torch.stack([x, y, torch.ones_like(x)], -1).reshape(-1, 3) @ turn
        index, hit = obj.intersect(eye, direction)
        seen = torch.zeros(len(direction), 3) if table is None else table.color(obj, eye, direction)
        seen[index] = obj.surface_color(hit) * shade(obj.normal(hit))[:, None]
        color[top : top + rows] = seen.view(-1, fine, 3)
        cover[top : top + rows].view(-1)[index] = 1.0

    def box(value: Tensor) -> Tensor:
        return value.view(size, supersample, size, supersample, -1).mean(dim=(1, 3))

    coverage = box(cover)
    image = box(color) if table is not None else box(color) / coverage.clamp_min(1e-6)
    return image.clamp(0.0, 1.0), coverage[..., 0]


def shade(normal: Tensor) -> Tensor:
    """Mild Lambert shading: sky light from above, a key light, [N]; at most 1."""
    key = torch.tensor(_KEY_LIGHT, dtype=normal.dtype)
    key = key / key.norm()
    return 0.66 + 0.10 * normal[:, 2] + 0.26 * (normal @ key).clamp_min(0.0)


class Table:
    """A wooden table top at z = 0 with a contact shadow, in a plain room."""

    def __init__(self, seed: int) -> None:
        self._noise = SolidNoise(seed * 104729 + 5, channels=3)

    def color(self, obj: DemoObject, eye: Tensor, direction: Tensor) -> Tensor:
        """Colour seen along rays that miss the object, shape [N, 3]."""
        reach = max(obj.axes)
        unit = direction / direction.norm(dim=1, keepdim=True)
        room = self._noise.fractal(unit, 2.2, 3)
        color = mix(
            torch.tensor([0.62, 0.62, 0.58]),
            torch.tensor([0.42, 0.47, 0.53]),
            smoothstep(-0.5, 0.5, room[:, 0]),
        )
        t = -float(eye[2]) / unit[:, 2].clamp_max(-1e-6)
        point = eye.to(torch.float32) + t[:, None] * unit
        on = (unit[:, 2] < -1e-6) & (point[:, :2].norm(dim=1) < 4.0 * reach)
        p = point[on]
        grain = self._noise.fractal(p * torch.tensor([1.0, 9.0, 1.0]) / reach, 0.8, 4)
        wood = mix(
            torch.tensor([0.45, 0.27, 0.15]),
            torch.tensor([0.70, 0.49, 0.30]),
            smoothstep(-0.6, 0.6, grain[:, 0]),
        )
        wood = wood + 0.05 * self._noise(p / reach, 5.0)[:, 1:2]
        offset = (p - obj.center.to(p.dtype))[:, :2] / torch.tensor(obj.axes[:2], dtype=p.dtype)
        shadow = 1.0 - 0.55 * smoothstep(1.25, 0.2, offset.norm(dim=1))
        color[on] = wood * (0.92 * shadow)[:, None]
        return color

    def points(self, obj: DemoObject, rng: np.random.Generator) -> tuple[Tensor, Tensor]:
        """Sparse points as structure from motion finds them, and their colours, [P, 3] each."""
        normal = torch.from_numpy(rng.normal(size=(1500, 3)))
        start = obj.center + 3.0 * max(obj.axes) * normal / normal.norm(dim=1, keepdim=True)
        hits = torch.cat([obj.intersect(s, (obj.center - s)[None])[1] for s in start])
        flat = torch.from_numpy(rng.uniform(-3.0, 3.0, size=(1500, 3)) * max(obj.axes))
        flat[:, 2] = 0.0
        eye = torch.tensor([0.0, 0.0, 10.0], dtype=torch.float64)
        color = torch.cat(
            [obj.surface_color(hits), self.color(obj, eye, (flat - eye).to(torch.float32))]
        )
        points = torch.cat([hits, flat])
        return points + 0.002 * max(obj.axes) * torch.from_numpy(
            rng.normal(size=points.shape)
        ), color


def cut_photograph(
    obj: DemoObject, size: int = 384, *, axis: int = 0, supersample: int = 3
) -> tuple[Tensor, Tensor]:
    """A straight-on photograph of the object cut through its middle, across ``axis``.

    Returns:
        Image [size, size, 3] and mask [size, size], float32 in [0, 1], where the object is.
    """
    with obj.center.device:
        return _cut_photograph(obj, size, axis, supersample)


def _cut_photograph(
    obj: DemoObject, size: int, axis: int, supersample: int
) -> tuple[Tensor, Tensor]:
    fine = size * supersample
    others = [k for k in range(3) if k != axis]
    reach = 1.04 * max(obj.axes[k] for k in others) * (1.0 + obj.bump_amplitude)
    line = ((torch.arange(fine, dtype=torch.float64) + 0.5) / fine * 2.0 - 1.0) * reach
    down, across = torch.meshgrid(-line, line, indexing="ij")
    points = obj.center.repeat(fine * fine, 1)
    points[:, others[0]] += across.reshape(-1)
    points[:, others[1]] += down.reshape(-1)
    inside = torch.nonzero(obj.inside(points))[:, 0]
    color, cover = torch.zeros(fine * fine, 3), torch.zeros(fine * fine)
    color[inside] = obj.interior(points[inside])
    cover[inside] = 1.0
    mask = cover.view(size, supersample, size, supersample).mean(dim=(1, 3))
    image = (
        color.view(size, supersample, size, supersample, 3).mean(dim=(1, 3))
        / mask.clamp_min(1e-6)[..., None]
    )
    return image.clamp(0.0, 1.0), mask


@contextmanager
def one_thread_per_operation() -> Iterator[None]:
    """Run torch operations on the calling thread alone, and restore the setting.

    Photographs are made beside each other on threads of their own; nested thread teams that spin at
    their barriers cost fifty times the work itself on a busy machine (measured).
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def make_capture(
    name: str = "watermelon",
    out_dir: str | Path = "demo",
    *,
    views: int = 42,
    size: int = 256,
    seed: int = 0,
    support: str = "none",
    masks: bool = True,
    device: torch.device | str = "cpu",
    progress: Progress | None = None,
) -> DemoPaths:
    """Photograph a demo object into a capture folder, with the truth about its inside beside it.

    The world frame of the capture is the scene frame: metres, +z up, the object resting on z = 0.
    With the default 42 views every eighth is held out by the reconstruction, which leaves 37.

    Args:
        name: "watermelon", "orange", "bread", "cake" or "melons" (two, side by side).
        out_dir: Folder to write; made when missing.
        views: Photographs, at least 3.
        size: Width and height [px], 32 to 4096.
        seed: Draws the object. The same seed writes the same bytes on the same kind of device.
        support: "none" (floating, seen from below too, RGBA images) or "table" (on a wooden table
            in a room, RGB images, sparse points beside them).
        masks: With a table, also write masks to ``masks/``.
        device: Where they are drawn.
        progress: Called as ``progress(done, total, message)``.

    Returns:
        The files written.

    Raises:
        InputError: An unknown object, or a size, view count or support out of range.
    """
    obj = make_object(name, seed)
    if views < 3:
        raise InputError(f"views must be at least 3, got {views}", "ask for more views")
    if not 32 <= size <= 4096:
        raise InputError(f"size must be 32 to 4096 pixels, got {size}", "choose another size")
    if support not in ("none", "table"):
        raise InputError(f"support {support!r} is not known", 'choose "none" or "table"')
    root = Path(out_dir)
    (root / "images").mkdir(parents=True, exist_ok=True)
    table = Table(seed) if support == "table" else None
    focal = 0.5 * size / math.tan(math.radians(0.5 * _FIELD_OF_VIEW))
    frames, images = [], []
    cameras = ring_cameras(obj, views, on_table=table is not None)
    mask_dir = root / "masks" if table is not None and masks else None
    if mask_dir is not None:
        mask_dir.mkdir(exist_ok=True)

    there = torch.device(device)
    drawn, around = moved(obj, there), moved(table, there)

    def shoot(number: int) -> None:
        image, mask = photograph(drawn, cameras[number], size, table=around)
        _write_png(root / "images" / f"{number:03d}.png", image, mask if table is None else None)
        if mask_dir is not None:
            _write_png(mask_dir / f"{number:03d}.png", mask[..., None].expand(-1, -1, 3), None)

    with one_thread_per_operation():
        with ThreadPoolExecutor(max_workers=min(8, os.cpu_count() or 1)) as pool:
            for done, _ in enumerate(pool.map(shoot, range(len(cameras))), 1):
                report_progress(progress, done, len(cameras), "photographs")
        # The exemplar is another fruit of the same kind: nobody can cut the photographed one and
        # keep it whole.
        sibling = moved(OBJECTS[name](seed + 1000).one(), there)
        _write_png(root / "cut.png", *cut_photograph(sibling, axis=sibling.cut_axis))
        save_truth(drawn, root / "truth.npz")
    for number, view in enumerate(cameras):
        images.append(root / "images" / f"{number:03d}.png")
        frame: dict[str, object] = {
            "file_path": f"images/{number:03d}.png",
            "transform_matrix": _opengl(view),
        }
        if mask_dir is not None:
            frame["mask_path"] = f"masks/{number:03d}.png"
        frames.append(frame)
    document: dict[str, object] = {
        "camera_model": "PINHOLE",
        "w": size,
        "h": size,
        "fl_x": focal,
        "fl_y": focal,
        "cx": 0.5 * size,
        "cy": 0.5 * size,
        "frames": frames,
    }
    if table is not None:
        import trimesh

        points, color = table.points(obj, np.random.default_rng([seed, 3]))
        rgb = (color.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
        cloud = trimesh.PointCloud(points.to(torch.float32).numpy(), colors=rgb)
        (root / "sparse.ply").write_bytes(cloud.export(file_type="ply"))
        document["ply_file_path"] = "sparse.ply"
    transforms = root / "transforms.json"
    transforms.write_text(json.dumps(document, indent=1))
    return DemoPaths(root, transforms, images, root / "truth.npz", root / "cut.png")


def _opengl(view: Tensor) -> list[list[float]]:
    """Camera-to-world with OpenGL axes, as ``transforms.json`` wants it."""
    pose = torch.linalg.inv(view)
    pose[:3, 1:3] *= -1.0
    return pose.tolist()


def _write_png(path: Path, image: Tensor, mask: Tensor | None) -> None:
    from PIL import Image

    value = (
        image if mask is None else torch.cat([image * (mask > 0)[..., None], mask[..., None]], -1)
    )
    Image.fromarray((value * 255.0).round().to(torch.uint8).cpu().numpy()).save(
        path, compress_level=3
    )
