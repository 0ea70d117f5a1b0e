"""Time the crack repair of a frame against the rendering of it; docs/measured/cracks.md.

    python scripts/bench/repair.py [--device cuda] [--splats 1000000] [--cells 40]
        [--size 1920x1080] [--frames 12] [--json FILE] [--write]

A ball of a million splats on material points is split by a plane and part of it crushed, by moving
its points by formula: the gap opens over the first half of the frames and stays open. Each frame
the repair sees what has parted, cuts splats and finds faces (only where something changed), and
moves the faces that show; that is set against rasterizing the frame. On the CPU the times are those
of the process.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gsfluent import geometry, materials, ops
from gsfluent.data import INTERIOR, SURFACE, Gaussians, Solid
from gsfluent.figure.markdown import enter
from gsfluent.pipeline.cracks.stage import Repair
from gsfluent.pipeline.matter.carry import Carry, Points
from gsfluent.pipeline.matter.points import build_matter
from gsfluent.scene.scene import Scene

PAGE = Path(__file__).resolve().parents[2] / "docs" / "measured" / "cracks.md"
RADIUS = 0.1


def ball(splats: int, voxels: int) -> Solid:
    """A coloured ball with splats on its skin and all through it."""
    half = voxels // 2 + 1
    axis = (torch.arange(-half, half) + 0.5) * (2 * RADIUS / voxels)
    grid = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1)
    far = grid.norm(dim=-1)
    draw = torch.Generator().manual_seed(0)
    direction = torch.randn(splats, 3, generator=draw)
    direction = torch.nn.functional.normalize(direction, dim=1)
    inner = torch.arange(splats) >= splats // 4
    share = torch.rand(splats, 1, generator=draw) ** (1 / 3)
    means = RADIUS * direction * torch.where(inner[:, None], share, 1.0)
    size = 0.45 * RADIUS * (4.19 / (0.75 * splats)) ** (1 / 3)
    gaussians = Gaussians.from_colors(
        means,
        torch.full((splats,), size),
        0.5 + 0.4 * torch.sin(60.0 * means),
        opacities=0.98,
    )
    labels = torch.where(inner, INTERIOR, SURFACE).to(torch.int32)
    voxel = 2 * RADIUS / voxels
    origin = torch.full((3,), float(-half) * voxel)
    color = 0.5 + 0.4 * torch.sin(60.0 * grid)
    depth = (RADIUS - far).clamp(min=0.0)
    return Solid(gaussians.replace(labels=labels), far < RADIUS, depth, origin, voxel, color)


def moment(carry: Carry, share: float) -> Points:
    """The points when the gap is ``share`` of its full width, 2 cm; a fifth of them is debris."""
    rest, spacing = carry.matter.rest, carry.matter.spacing[0]
    side = torch.sign(rest[:, :1])
    bottom = rest[:, 2] < -0.4 * RADIUS
    gap = torch.tensor([0.01, 0.0, 0.0], device=rest.device) * share * side
    # debris spreads from the middle of the bottom
    spread = (rest - rest.new_tensor([0.0, 0.0, -0.4 * RADIUS])) * (1.5 * share)
    position = rest + torch.where(bottom[:, None], spread, gap)
    eye = torch.eye(3, device=rest.device).expand(rest.shape[0], 3, 3).contiguous()
    debris = bottom & (share > 0.02 * spacing)
    piece = torch.where(debris, -1, (rest[:, 0] > 0).to(torch.int32)).to(torch.int32)
    return Points(position, eye, eye, piece, debris)


def clock(device: torch.device) -> float:
    """Seconds: of the process on the CPU, of the wall once a GPU is done."""
    if device.type == "cuda":
        torch.cuda.synchronize()
        return time.perf_counter()
    return time.process_time()


def timed(device: torch.device, work: Callable[[], Any], repeats: int) -> tuple[float, Any]:
    """Median milliseconds of some calls, and what the last one returned."""
    times, result = [], None
    for _ in range(repeats):
        start = clock(device)
        result = work()
        times.append(1e3 * (clock(device) - start))
    return sorted(times)[len(times) // 2], result


def measure(given: argparse.Namespace, device: torch.device) -> dict[str, Any]:
    """Times of one device [ms]."""
    width, height = (int(n) for n in given.size.split("x"))
    scene = Scene(floor=None)
    scene.add(ball(given.splats, given.voxels), materials.get("glass"))
    carry = Carry.bind(scene, build_matter(scene, 2 * RADIUS / given.cells, device=device))
    view = geometry.look_at(torch.tensor([0.25, 0.35, 0.1]), torch.zeros(3), torch.eye(3)[2])
    view = view.to(device, torch.float32)
    K = torch.tensor([[1.2 * height, 0, width / 2], [0, 1.2 * height, height / 2], [0, 0, 1]])
    K = K.to(device)

    def picture(splats: Gaussians) -> Tensor:
        return ops.rasterize(
            splats.means, splats.opacities, view, K, width, height, quats=splats.quats,
            scales=splats.scales, sh=splats.sh, depth=False,
        ).image  # fmt: skip

    history = Repair().begin(carry)
    rows = []
    with torch.no_grad():
        # the first opening also places the sites; it is a second run that is timed
        history.step(moment(carry, 1.0))
        history.restore({})
        for index in range(given.frames):
            share = min(1.0, index / (0.5 * given.frames))
            points = moment(carry, share)
            start = clock(device)
            cracks = history.step(points)
            first = 1e3 * (clock(device) - start)
            assert cracks is not None  # method gap
            still, cracks = timed(device, lambda p=points: history.step(p), given.repeats)
            move, motion = timed(
                device, lambda c=cracks: c.carry.apply(c.carry.follow(c.points, c.rest), c.rest), 1
            )
            splats = motion.replace(normals=None)
            if cracks.births is not None:
                born = cracks.births.gaussians.replace(normals=None)
                splats = Gaussians.cat([splats, born])
            picture(splats)
            draw, _ = timed(device, lambda s=splats: picture(s), given.repeats)
            rows.append(
                {
                    "opened": share, "born": splats.count - carry.gaussians.count, "repair": first,
                    "repair_still": still, "carry": move, "render": draw,
                }
            )  # fmt: skip
    return {
        "device": torch.cuda.get_device_name() if device.type == "cuda" else "CPU, one thread",
        "splats": carry.gaussians.count,
        "points": carry.matter.particles.count,
        "size": given.size,
        "frames": rows,
    }


def table(found: dict[str, Any]) -> Iterator[str]:
    """One device as lines of Markdown."""
    yield (
        f"**{found['device']}**: {found['splats']} splats on {found['points']} points, "
        f"{found['size']}; milliseconds"
    )
    yield ""
    yield "| gap | born | repair | unchanged again | share of render | carry | render |"
    yield "| --- | --- | --- | --- | --- | --- | --- |"
    for row in found["frames"]:
        yield (
            f"| {row['opened']:.2f} | {row['born']} | {row['repair']:.2f} | "
            f"{row['repair_still']:.2f} | {100 * row['repair_still'] / row['render']:.0f} % | "
            f"{row['carry']:.1f} | {row['render']:.2f} |"
        )
    mean = {k: sum(r[k] for r in found["frames"]) for k in ("repair", "repair_still", "render")}
    yield ""
    yield (
        f"Over all frames the repair takes {100 * mean['repair'] / mean['render']:.0f} % of the "
        f"render's time, {100 * mean['repair_still'] / mean['render']:.0f} % where nothing changes."
    )


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", nargs="*", default=["cpu"], choices=["cpu", "cuda"])
    parser.add_argument("--splats", type=int, default=1_000_000)
    parser.add_argument("--cells", type=int, default=40, help="grid cells across")
    parser.add_argument("--voxels", type=int, default=128, help="voxels of the colours across")
    parser.add_argument("--size", default="1920x1080", help="picture [px]")
    parser.add_argument("--frames", type=int, default=12)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--write", action="store_true", help=f"enter the table into {PAGE.name}")
    given = parser.parse_args()
    torch.set_num_threads(1)  # waiting threads would count as work
    found = [measure(given, torch.device(name)) for name in given.device]
    text = "\n\n".join("\n".join(table(one)) for one in found)
    sys.stdout.write(text + "\n")
    if given.json:
        given.json.write_text(json.dumps(found, indent=1))
    if given.write:
        PAGE.write_text(enter(PAGE.read_text(encoding="utf-8"), "repair", text))
    return 0


if __name__ == "__main__":
    sys.exit(main())
