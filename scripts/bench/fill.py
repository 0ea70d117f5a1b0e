"""Time filling: a shell of many Gaussians to a solid, with and without its photographs.

    python scripts/bench/fill.py [--gaussians 1000000] [--resolution 128] [--device cuda] [--json F]

The shell is a bumpy ellipsoid of splats of all sizes and turns, ten of them degenerate (no size,
needles, sheets as large as a house, zero quaternions). Its photographs are drawn from it, with
masks. Medians of three runs after one that is not counted.
"""

from __future__ import annotations

import argparse
import json
import math
import platform
import statistics
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from gsfluent.data import Camera, Capture, Gaussians
from gsfluent.draw import draw
from gsfluent.io.images import load_view
from gsfluent.pipeline import Fill

AXES = (0.13, 0.11, 0.10)
SIZE = 400  # pixels of the photographs


def shell(count: int, device: torch.device, seed: int = 0) -> Gaussians:
    """Splats on a bumpy ellipsoid."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    direction = torch.nn.functional.normalize(normal(count, 3), dim=1)
    bumps = 1 + 0.03 * torch.sin(6 * direction[:, :1]) * torch.cos(5 * direction[:, 1:2])
    means = direction * torch.tensor(AXES) * bumps + 5e-4 * normal(count, 3)
    spacing = 0.35 / math.sqrt(count)
    scales = spacing * torch.exp(0.5 * normal(count, 3))
    quats = normal(count, 4)
    scales[:4], scales[4:7, 0], scales[7:10, 1] = 0.0, 1e-15, 1e9
    quats[:2] = 0.0
    opacities = 0.3 + 0.6 * torch.rand(count, generator=generator)
    opacities[7:10] = 0.002  # a sheet of that size would otherwise cover every picture
    colors = 0.5 + 0.3 * torch.sin(40 * means)
    made = Gaussians.from_colors(
        means, scales.clamp(min=1e-20), colors, opacities=opacities, quats=quats
    )
    return made.to(device)


def photographs(gaussians: Gaussians, folder: Path, count: int) -> Capture:
    """Pictures with masks from all around, on disk as a capture has them."""
    from PIL import Image

    cameras = []
    for number in range(count):
        height = 1.0 - 2.0 * (number + 0.5) / count
        turn = number * math.pi * (3.0 - math.sqrt(5.0))
        out = math.sqrt(1.0 - height * height)
        eye = (0.5 * out * math.cos(turn), 0.5 * out * math.sin(turn), 0.5 * height)
        path = folder / f"{number:03d}.png"
        looking = Camera.look_at(eye, (0.0, 0.0, 0.0), width=SIZE, height=SIZE, fov=37.0)
        camera = replace(looking, image_path=path)
        picture = draw(gaussians, camera)
        assert picture.alpha is not None
        rgba = torch.cat([picture.image, picture.alpha[..., None]], dim=-1)
        pixels = (rgba.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
        Image.fromarray(pixels, "RGBA").save(path)
        cameras.append(camera)
    return Capture(
        cameras, torch.zeros(0, 3, dtype=torch.float64), torch.zeros(0, 3), folder, load_view
    )


def timed(work: Any, device: torch.device, repeats: int) -> tuple[float, float, Any]:
    """Median wall and process seconds, and the last result."""
    walls, busy, result = [], [], None
    for run in range(repeats + 1):
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        wall, process = time.perf_counter(), time.process_time()
        result = work()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        if run:
            walls.append(time.perf_counter() - wall)
            busy.append(time.process_time() - process)
    return statistics.median(walls), statistics.median(busy), result


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--gaussians", type=int, default=1_000_000)
    parser.add_argument("--resolution", type=int, default=128, help="voxels along the object")
    parser.add_argument("--views", type=int, default=24, help="photographs")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--json", type=Path, help="append the figures to this file, one line")
    options = parser.parse_args()
    device = torch.device(options.device)
    name = torch.cuda.get_device_name() if device.type == "cuda" else platform.machine()
    gaussians = shell(options.gaussians, device)
    row: dict[str, Any] = {
        "gaussians": options.gaussians, "resolution": options.resolution, "device": name,
        "threads": torch.get_num_threads(),
    }  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        capture = photographs(gaussians, Path(folder), options.views)
        for label, given in (("splats alone", None), ("with photographs", capture)):
            wall, busy, solid = timed(
                lambda given=given: Fill(resolution=options.resolution)(gaussians, given),
                device,
                options.repeats,
            )
            row[label] = {"wall_s": round(wall, 3), "cpu_s": round(busy, 3)}
            inner = solid.report["interior_gaussians"]
            print(
                f"{label}: {wall:.2f} s wall, {busy:.2f} s CPU, volume {solid.volume:.4g}, "
                f"{inner} interior Gaussians, {solid.report['method']}"
            )
    if device.type == "cuda":
        row["peak_mib"] = torch.cuda.max_memory_allocated(device) >> 20
    print(json.dumps(row))
    if options.json is not None:
        with options.json.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")


if __name__ == "__main__":
    main()
