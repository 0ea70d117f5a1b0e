"""How fast a live session is: real-time factor, latency of a frame, and where the time goes.

A melon is shot at twice while it stands; every frame is simulated, carried, repaired and drawn at
1280x720. Times are wall seconds on a GPU (synchronised) and seconds of CPU time of the process on
the CPU, where the machine may be shared.

  python scripts/bench/live.py --device cuda
  python scripts/bench/live.py --device cpu --points 6000 30000 --frames 12
"""

from __future__ import annotations

import argparse
import cProfile
import json
import pstats
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from gsfluent.data import INTERIOR, SURFACE, Camera, Gaussians, Solid
from gsfluent.figure.markdown import enter
from gsfluent.live.session import LiveSession
from gsfluent.pipeline.light.normals import occupancy_cell
from gsfluent.pipeline.matter.points import POINTS_PER_CELL
from gsfluent.pipeline.render.camera import Action, orbit
from gsfluent.pipeline.render.stage import Render
from gsfluent.pipeline.render.studio import Studio
from gsfluent.pipeline.simulate.stage import frame_of
from gsfluent.scene.scene import Scene
from gsfluent.stages.simulate import saved

RADII = (0.125, 0.105, 0.105)
PARTS = ("simulate", "pieces and figures", "carry", "repair", "frame", "draw")


def melon(splats: int, voxels: int) -> Solid:
    """A melon of green skin and red flesh; a third of the splats lie on the skin."""
    half = torch.tensor(RADII)
    voxel = float(2 * half.max()) / voxels
    counts = torch.ceil(2 * half / voxel).long() + 2
    origin = -0.5 * counts * voxel
    axes = [origin[d] + (torch.arange(int(counts[d])) + 0.5) * voxel for d in range(3)]
    grid = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1)
    level = (grid / half).norm(dim=-1)
    depth = ((1 - level) * half.min()).clamp(min=0)
    green, red = torch.tensor([0.15, 0.45, 0.15]), torch.tensor([0.85, 0.15, 0.15])
    color = torch.where((depth < 0.012)[..., None], green, red)
    torch.manual_seed(0)
    skin = torch.nn.functional.normalize(torch.randn(splats // 3, 3), dim=1) * half
    inside = torch.nn.functional.normalize(torch.randn(splats - splats // 3, 3), dim=1)
    inside = inside * torch.rand(len(inside), 1) ** (1 / 3) * 0.93 * half
    means = torch.cat([skin, inside])
    size = (4.19 * float(half.prod()) / len(inside)) ** (1 / 3)
    scales = torch.full((len(means), 3), 0.6 * size)
    colors = torch.cat([green.expand(len(skin), 3), red.expand(len(inside), 3)])
    labels = torch.full((len(means),), INTERIOR, dtype=torch.int32)
    labels[: len(skin)] = SURFACE
    made = Gaussians.from_colors(means, scales, colors, opacities=0.95).replace(labels=labels)
    return Solid(made, level <= 1, depth, origin, voxel, color, None, {}, None)


class Watch:
    """Adds up what the parts of a frame take.

    Args:
        device: What is timed.
    """

    def __init__(self, device: torch.device) -> None:
        self.cuda = device.type == "cuda"
        self.spent: dict[str, list[float]] = {part: [] for part in PARTS}

    def now(self) -> float:
        """Seconds of the wall on a GPU, of this process on the CPU."""
        if self.cuda:
            torch.cuda.synchronize()
            return time.perf_counter()
        return time.process_time()

    def timed(self, part: str, act: Callable[[], Any]) -> Any:
        """Do something as a part of a frame."""
        start = self.now()
        result = act()
        self.spent[part].append(self.now() - start)
        return result


def measured(points: int, frames: int, slow: float, device: torch.device) -> dict[str, Any]:
    """Shoot a melon of about so many points."""
    scene = Scene()
    scene.add(melon(min(max(points, 30_000), 300_000), 96), "fruit.watermelon", name="melon")
    dx = (scene.bodies[0].volume * POINTS_PER_CELL / points) ** (1 / 3)
    begun = time.perf_counter()
    session = LiveSession(scene, dx=dx, device=device, slow=slow)
    prepared = time.perf_counter() - begun
    first = session.frame()
    action = Action.of([first.positions])
    camera: Camera = orbit(action, (1280, 720))[0]
    x, y = action.center[0, :2].tolist()
    studio = Studio(0.0, (x, y), float(action.radius[0]), 3.0 * float(action.radius[0]))
    render = Render(studio=studio, normal_cell=occupancy_cell(first.gaussians))
    watch = Watch(device)
    begun = time.perf_counter()
    session.shoot((1.0, 0.0, 0.12), (-1.0, 0.0, 0.0), 80.0, 0.015)
    poke = time.perf_counter() - begun
    pieces = 1
    for index in range(frames + 2):
        if index == frames // 2:
            session.shoot((0.0, 1.0, 0.12), (0.0, -1.0, 0.0), 80.0, 0.015)
        if index == 2:  # what is made once has been made
            for part in PARTS:
                watch.spent[part].clear()
            begun, start = watch.now(), session.time
        if not watch.timed("simulate", session._advance):
            break
        whole = watch.timed(
            "pieces and figures",
            lambda: frame_of(session.run, session.index, session._history, session.time),
        )
        watch.timed("carry", lambda whole=whole: whole.carried)
        watch.timed("repair", lambda whole=whole: whole.repaired)
        frame = watch.timed("frame", lambda whole=whole: saved(whole, session.scene))
        watch.timed(
            "draw",
            lambda frame=frame: render(frame.gaussians, camera, groups=frame.groups).image.cpu(),
        )
        pieces = frame.facts["fragments"]
    wall = watch.now() - begun
    done = len(watch.spent["draw"])
    watch.spent = {part: times[:done] for part, times in watch.spent.items()}
    ms = {part: 1e3 * statistics.mean(watch.spent[part]) for part in PARTS}
    total = [sum(row) for row in zip(*watch.spent.values(), strict=True)]
    return {
        "points": session.run.matter.particles.count,
        "cells": session.cells,
        "splats": frame.gaussians.count,
        "slow": slow,
        "prepare_s": prepared,
        "poke_ms": 1e3 * poke,
        "steps_per_frame": session.report()["substeps"] / (frames + 2),
        "parts_ms": ms,
        "worst_frame_ms": 1e3 * max(total),
        "pictures_per_second": done / wall,
        "real_time_factor": (session.time - start) / wall,
        "fragments": pieces,
        "verdict": session.report()["verdict"],
        "reason": session.report()["reason"],
    }


def table(measure: dict[str, Any]) -> str:
    """A measurement as a table of a page; frame times are means [ms]."""
    head = ["points", "cells", "splats", "slow motion", "pictures/s", "x real time", "frame"]
    head += ["worst", *PARTS, "pieces", "verdict"]
    lines = [f"{measure['device']}:", "", "| " + " | ".join(head) + " |"]
    lines.append("|" + " --- |" * len(head))
    for row in measure["rows"]:
        parts = row["parts_ms"]
        cells = [f"{row['points']}", f"{row['cells']}", f"{row['splats']}", f"{row['slow']:g}"]
        cells += [f"{row['pictures_per_second']:.1f}", f"{row['real_time_factor']:.3f}"]
        cells += [f"{sum(parts.values()):.0f}", f"{row['worst_frame_ms']:.0f}"]
        cells += [f"{parts[part]:.1f}" for part in PARTS]
        cells += [f"{row['fragments']}", row["verdict"]]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def entered(page: Path, files: list[Path]) -> None:
    """Enter measurements into a page; a later one of the same device takes the place of another."""
    found: dict[str, dict[str, Any]] = {}
    for file in files:
        for line in file.read_text(encoding="utf-8").splitlines():
            if line.startswith("{") and '"rows"' in line:
                measure = json.loads(line)
                found[measure["device"]] = measure
    text = "\n\n".join(table(found[name]) for name in sorted(found, reverse=True))
    page.write_text(enter(page.read_text(encoding="utf-8"), "live", text), encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--points", type=int, nargs="+", default=[30_000, 100_000, 300_000])
    parser.add_argument(
        "--slow", type=float, nargs="+", default=[4.0, 20.0, 50.0], help="slow motions"
    )
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--out", type=Path, help="JSON file")
    parser.add_argument("--profile", type=int, help="profile a scene of so many points, too")
    parser.add_argument("--page", type=Path, help="enter what --read holds into this page, and end")
    parser.add_argument("--read", type=Path, nargs="+", help="files with what was printed")
    args = parser.parse_args()
    if args.page is not None:
        entered(args.page, args.read or [])
        return
    device = torch.device(args.device)
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else "one CPU core"
    rows = [
        measured(points, args.frames, slow, device) for points in args.points for slow in args.slow
    ]
    if args.profile:
        profile = cProfile.Profile()
        profile.enable()
        measured(args.profile, args.frames, args.slow[0], device)
        profile.disable()
        pstats.Stats(profile).sort_stats("tottime").print_stats(30)
    measure = {"device": name, "rows": rows}
    print(table(measure))
    print(json.dumps(measure))
    if args.out is not None:
        args.out.write_text(json.dumps(measure, indent=1), encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
