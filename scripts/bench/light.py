"""Time of a lit picture and of its parts.

    python scripts/bench/light.py                    # 1080p, 1 M Gaussians, GPU if there is one
    python scripts/bench/light.py --device cpu --gaussians 100000 --size 640x360
    python scripts/bench/light.py --read h100.out cpu.out --page docs/measured/light.md

A solid ball of matter breaks in four above a floor, under one soft key light. On the GPU times are
medians of CUDA events around calls that run back to back; on the CPU they are the process's time.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from gsfluent import ops
from gsfluent.data import Camera, Gaussians
from gsfluent.figure.markdown import enter
from gsfluent.pipeline.light.lamps import Lamp, Lighting, pack_lamps
from gsfluent.pipeline.light.normals import grid_for, splat_normals
from gsfluent.pipeline.light.shadow_maps import bulk, faces_of, shadow_maps
from gsfluent.pipeline.render.stage import Render
from gsfluent.pipeline.render.studio import Studio


def scene(count: int, device: torch.device) -> Gaussians:
    """A ball of matter, quarters pulled apart, mildly flat splats as a reconstruction has them."""
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(count, 3, generator=generator)
    points /= points.norm(dim=1, keepdim=True)
    points *= 0.1 * torch.rand(count, 1, generator=generator) ** (1.0 / 3.0)
    apart = 0.03 * torch.sign(points) * torch.tensor([1.0, 1.0, 0.0])
    spacing = 0.1 * (4.0 / 3.0 * math.pi / count) ** (1.0 / 3.0)
    shape = torch.tensor([0.7, 0.6, 0.4]) * spacing
    scales = shape * (0.8 + 0.4 * torch.rand(count, 1, generator=generator))
    colors = 0.3 + 0.5 * torch.rand(count, 3, generator=generator)
    quats = torch.randn(count, 4, generator=generator)
    points = points + apart + torch.tensor([0.0, 0.0, 0.11])
    return Gaussians.from_colors(points, scales, colors, opacities=0.9, quats=quats).to(device)


def clock(work: Callable[[], Any], device: torch.device, repeats: int) -> float:
    """Median time of a call [ms]."""
    for _ in range(3 if device.type == "cuda" else 1):
        work()
    if device.type != "cuda":
        times = []
        for _ in range(repeats):
            start = time.process_time()
            work()
            times.append(1000.0 * (time.process_time() - start))
        return statistics.median(times)
    marks = [torch.cuda.Event(enable_timing=True) for _ in range(repeats + 1)]
    torch.cuda.synchronize()
    marks[0].record()
    for mark in marks[1:]:
        work()
        mark.record()
    torch.cuda.synchronize()
    return statistics.median(a.elapsed_time(b) for a, b in itertools.pairwise(marks))


def measure(
    count: int, size: tuple[int, int], lamps: int, device: torch.device, repeats: int
) -> dict[str, Any]:
    """Times [ms] of the picture and its parts."""
    matter = scene(count, device)
    width, height = size
    camera = Camera.look_at(
        (0.35, -0.75, 0.4), (0.0, 0.0, 0.1), width=width, height=height, fov=22.0
    )
    chosen = [Lamp(), Lamp(position=(-0.4, -0.4, 0.6), intensity=0.3, size=0.05, distance=0.6)]
    lighting = Lighting(lamps=tuple((chosen * lamps)[:lamps]))
    studio = Studio(0.0, (0.0, 0.0), 0.1, 0.2)
    render = Render(camera, lighting, studio=studio)
    plain = Render(camera, studio=None)
    room = render(matter).room
    grid = grid_for(matter)
    drawn = lighting.drawn()
    whole = bulk(matter)
    faces = faces_of(drawn, whole)
    texels = 1024 if max(size) > 800 else 512
    occupied = grid.of(matter, whole.center)
    normals = splat_normals(matter, occupied)
    viewmat, intrinsics = camera.viewmat.to(matter.means), camera.K.to(matter.means)

    def main() -> Any:
        return ops.rasterize(
            matter.means,
            matter.opacities,
            viewmat,
            intrinsics,
            width,
            height,
            quats=matter.quats,
            scales=matter.scales,
            sh=matter.sh,
            normals=normals,
        )

    parts: dict[str, Callable[[], Any]] = {
        "main pass": main,
        "bulk": lambda: bulk(matter),
        "shadow maps": lambda: shadow_maps(matter, drawn, faces, texels, whole),
        "occupancy": lambda: grid.of(matter, whole.center),
        "normals": lambda: splat_normals(matter, occupied),
        "unlit picture": lambda: plain(matter).image,
        "lit picture": lambda: render(matter, room=room).image,
    }
    with torch.no_grad():
        times = {name: clock(work, device, repeats) for name, work in parts.items()}
    whole = times["lit picture"]
    known = sum(times[n] for n in ("main pass", "bulk", "shadow maps", "occupancy", "normals"))
    times["shading and floor (the rest)"] = whole - known
    rows = {name: round(value, 3) for name, value in times.items()}
    lamp_rows = pack_lamps(drawn, faces, matter.means).shape[0]
    return {
        "device": torch.cuda.get_device_name() if device.type == "cuda" else "cpu",
        "gaussians": count,
        "size": list(size),
        "lamps": lamp_rows,
        "shadow_texels": texels,
        "grid_nodes": grid.nodes,
        "milliseconds": rows,
    }


def table(lines: list[dict[str, Any]]) -> str:
    """Markdown of what was measured, one column per line of JSON."""
    heads = [
        f"{line['device']}, {line['gaussians']:,} splats, {line['size'][0]} x {line['size'][1]}, "
        f"{line['lamps']} lamp{'s' if line['lamps'] > 1 else ''}"
        for line in lines
    ]
    rows = [f"| ms | {' | '.join(heads)} |", f"| --- |{' --- |' * len(lines)}"]
    for name in lines[0]["milliseconds"]:
        cells = [f"{line['milliseconds'][name]:.2f}" for line in lines]
        rows.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--gaussians", type=int, default=1_000_000)
    parser.add_argument("--size", default="1920x1080")
    parser.add_argument("--lamps", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--read", type=Path, nargs="+", help="outputs of earlier runs, for --page")
    parser.add_argument("--page", type=Path, help="enter the table of --read into this page")
    options = parser.parse_args()
    if options.read:
        texts = [path.read_text(encoding="utf-8") for path in options.read]
        lines = [
            json.loads(line) for text in texts for line in text.splitlines() if line[:1] == "{"
        ]
        print(table(lines))
        if options.page:
            page = options.page.read_text(encoding="utf-8")
            options.page.write_text(enter(page, "light speed", table(lines)), encoding="utf-8")
        return
    width, height = (int(side) for side in options.size.split("x"))
    for lamps in options.lamps:
        found = measure(
            options.gaussians,
            (width, height),
            lamps,
            torch.device(options.device),
            options.repeats,
        )
        print(json.dumps(found))
        for name, value in found["milliseconds"].items():
            print(f"  {name:32s} {value:10.3f} ms")


if __name__ == "__main__":
    main()
