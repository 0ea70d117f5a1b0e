"""A pane of glass that falls onto a ball and a bowl of porcelain that lands, by both laws.

    python scripts/study/phase_field/film.py OUT [--cells 64] [--device cuda] [--only pane,bowl]

Writes OUT/laws.mp4 (where imageio-ffmpeg is installed) and OUT/laws.jpg, four moments of it, seen
from above. With --enter the picture goes to docs/images/phase_field_laws.jpg. Points are coloured
by piece; grey is what has come off as powder.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsfluent import materials
from gsfluent.data import SURFACE, Frame, Gaussians, Solid
from gsfluent.pipeline.simulate.stage import Simulate
from gsfluent.scene.scene import Scene

PICTURE = Path(__file__).resolve().parents[3] / "docs" / "images" / "phase_field_laws.jpg"
LAWS = ("nacc", "phase_field")
FPS, SECONDS = 800, 0.016
BALL = 0.02
"""Radius of what the pane falls onto [m]."""
MOMENTS = (0.15, 0.35, 0.6, 1.0)


def solid(half: tuple[float, float, float], inside: Any, voxel: float) -> Solid:
    """A body where ``inside(points)`` says so, with a few splats."""
    counts = [math.ceil(2.0 * h / voxel) + 2 for h in half]
    origin = torch.tensor([-0.5 * n * voxel for n in counts])
    axes = [float(origin[d]) + (torch.arange(counts[d]) + 0.5) * voxel for d in range(3)]
    grid = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1)
    filled = inside(grid)
    places = grid[_skin(filled)]  # or what lies far from every splat takes long to colour
    splats = Gaussians.from_colors(
        places, torch.full_like(places, voxel), torch.full_like(places, 0.5), opacities=0.9
    )
    splats = splats.replace(labels=torch.full((len(places),), SURFACE, dtype=torch.int32))
    depth = filled.float() * voxel
    return Solid(splats, filled, depth, origin, voxel, grid * 0.0 + 0.5, None, {}, None)


def _skin(filled: torch.Tensor) -> torch.Tensor:
    """Voxels of a body that have an empty neighbour; nothing lies at the rim of the grid."""
    inner = filled.clone()
    for axis in range(3):
        inner &= filled.roll(1, axis) & filled.roll(-1, axis)
    return filled & ~inner


def turned(angle: float, axis: int) -> Frame:
    """A frame turned about an axis."""
    c, s = math.cos(angle), math.sin(angle)
    a, b = [i for i in range(3) if i != axis]
    turn = torch.eye(3)
    turn[a, a], turn[b, b], turn[a, b], turn[b, a] = c, c, -s, s
    return Frame(turn, torch.zeros(3), 1.0)


@dataclasses.dataclass(frozen=True)
class Fall:
    """A body that falls, of the same matter by both laws.

    Attributes:
        material: Preset.
        strength: In tension [Pa]; both laws keep it, and so give up the toughness.
        softening: Of the preset: it breaks at a strain of its root times that of real matter.
        speed: At which it lands [m/s].
        walls: Thickness [cells].
    """

    material: str
    strength: float
    softening: float
    speed: float
    walls: float

    def ware(self, law: str) -> materials.Material:
        """Its matter under a law; a phase field is driven by tension alone."""
        split = {"split": "rankine"} if law == "phase_field" else {}
        return materials.get(self.material).override(
            law=law, prefer="strength", softening=self.softening, tensile_strength=self.strength,
            **split,
        )  # fmt: skip


FALLS = {
    "pane": Fall("glass", 2.8e7, 300.0, 6.3, 4.0),
    "bowl": Fall("ceramic", 3e7, 300.0, 5.0, 4.0),
}


def pane(cells: int, law: str, fall: Fall) -> tuple[Scene, float]:
    """A pane of 0.3 m that falls flat onto a ball, and the size of a cell."""
    dx = 0.3 / cells
    half = (0.15, 0.1, 0.5 * fall.walls * dx)
    body = solid(half, lambda x: (x.abs() <= torch.tensor(half)).all(dim=-1), 0.5 * dx)
    scene = Scene()
    scene.add(body, fall.ware(law))
    scene.add_collider("sphere", at=(0.03, -0.015, BALL), radius=BALL)
    scene.drop(2.0 * BALL + 0.002)
    scene.throw((0.0, 0.0, -fall.speed), spin=(4.0, 5.0, 0.0))
    return scene, dx


def bowl(cells: int, law: str, fall: Fall) -> tuple[Scene, float]:
    """A bowl of 0.16 m that lands on its bottom, and the size of a cell."""
    dx = 0.16 / cells
    wall = fall.walls * dx

    def inside(x: torch.Tensor) -> torch.Tensor:
        radius = x.norm(dim=-1)
        return (radius <= 0.08) & (radius >= 0.08 - wall) & (x[..., 2] <= 0.0)

    body = solid((0.08, 0.08, 0.08), inside, 0.5 * dx)
    scene = Scene()
    scene.add(body, fall.ware(law), frame=turned(0.25, 1))
    scene.drop(0.002)
    scene.throw((0.0, 0.0, -fall.speed))
    return scene, dx


def run(
    make: Any, cells: int, law: str, fall: Fall, device: str
) -> tuple[list[np.ndarray], list[np.ndarray], dict[str, Any]]:
    """Positions and pieces of every frame, and figures of the last."""
    scene, dx = make(cells, law, fall)
    simulation = Simulate(dx=dx, device=device)(scene, fps=FPS, seconds=SECONDS)
    places, pieces = [], []
    for frame in simulation:
        places.append(frame.particles.position.cpu().numpy())
        pieces.append(frame.fragments.cpu().numpy())
        last = frame
    number, size = np.unique(pieces[-1][pieces[-1] >= 0], return_counts=True)
    share = np.sort(size)[::-1] / len(pieces[-1])
    told = {
        "points": len(places[0]), "pieces over 1 %": int((share > 0.01).sum()),
        "largest": float(share[0]) if len(share) else 0.0, "pieces": len(number),
        "powder": float((pieces[-1] < 0).mean()), "broken": float(last.broken.float().mean()),
        "steps": simulation.report["substeps"], "verdict": simulation.report["verdict"],
        "seconds": simulation.report["seconds"],
    }  # fmt: skip
    return places, pieces, told


def draw(axis: Any, place: np.ndarray, piece: np.ndarray, name: str) -> None:
    """One frame, from above: what lies highest hides the rest."""
    from matplotlib import colormaps

    order = np.argsort(place[:, 2])
    every = [colormaps["tab20"](i)[:3] for i in range(20)]
    colors = [c for c in every if max(c) - min(c) > 0.05]  # no greys
    shade = np.random.default_rng(1).permutation(len(colors))
    color = np.where(piece >= 0, shade[np.maximum(piece, 0) % len(colors)], -1)
    axis.set_facecolor("#1c1c20")
    tints = np.array([(0.54, 0.54, 0.54), *colors])
    axis.scatter(place[order, 0], place[order, 1], s=3.0, lw=0, c=tints[color[order] + 1])
    axis.set_title(name, fontsize=9)
    axis.set_xticks([])
    axis.set_yticks([])
    axis.set_aspect("equal")


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path, metavar="OUT")
    parser.add_argument("--cells", type=int, default=64, help="along the longest side")
    for name, unit in (("speed", "m/s"), ("walls", "cells"), ("strength", "Pa")):
        parser.add_argument(f"--{name}", type=float, help=f"another than that of FALLS [{unit}]")
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--only", default="pane,bowl", metavar="BODY,...")
    parser.add_argument("--enter", action="store_true", help="the picture becomes that of the docs")
    args = parser.parse_args()
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    args.out.mkdir(parents=True, exist_ok=True)
    made = {"pane": pane, "bowl": bowl}
    other = {name: getattr(args, name) for name in ("speed", "walls", "strength")}
    other = {name: value for name, value in other.items() if value is not None}
    shown: dict[tuple[str, str], Any] = {}
    for body in args.only.split(","):
        fall = dataclasses.replace(FALLS[body], **other)
        for law in LAWS:
            shown[body, law] = run(made[body], args.cells, law, fall, args.device)
            sys.stderr.write(f"{body} {law}: {json.dumps(shown[body, law][2])}\n")
    told = {f"{body} {law}": value[2] for (body, law), value in shown.items()}
    (args.out / "laws.json").write_text(json.dumps(told, indent=1), encoding="utf-8")
    bodies = list(dict.fromkeys(body for body, _ in shown))
    limits = {}
    for body in bodies:
        every = np.concatenate([p for law in LAWS for p in shown[body, law][0][::6]])
        limits[body] = 1.05 * np.abs(every[:, :2]).max(axis=0)
    frames = min(len(value[0]) for value in shown.values())

    def panel(axis: Any, body: str, law: str, index: int, name: str) -> None:
        places, pieces, _ = shown[body, law]
        draw(axis, places[index], pieces[index], name)
        axis.set_xlim(-limits[body][0], limits[body][0])
        axis.set_ylim(-limits[body][1], limits[body][1])

    figure, axes = pyplot.subplots(
        2 * len(bodies), len(MOMENTS), figsize=(12, 5.0 * len(bodies)), squeeze=False
    )
    for row, (body, law) in enumerate(shown):
        for column, part in enumerate(MOMENTS):
            index = round(part * (frames - 1))
            name = f"{body}, {law}, {1e3 * index / FPS:.0f} ms"
            panel(axes[row, column], body, law, index, name)
    figure.tight_layout()
    picture = args.out / "laws.jpg"
    figure.savefig(picture, dpi=80, pil_kwargs={"quality": 85})
    pyplot.close(figure)
    if args.enter:
        shutil.copy(picture, PICTURE)
    for index in range(frames):
        figure, axes = pyplot.subplots(len(bodies), 2, figsize=(8, 4 * len(bodies)), squeeze=False)
        for row, body in enumerate(bodies):
            for column, law in enumerate(LAWS):
                panel(axes[row, column], body, law, index, f"{body}, {law}")
        figure.tight_layout()
        figure.savefig(args.out / f"frame_{index:03d}.png", dpi=80)
        pyplot.close(figure)
    try:
        import imageio_ffmpeg
    except ImportError:
        return 0
    command = [
        imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-loglevel", "error", "-framerate", "12", "-i",
        str(args.out / "frame_%03d.png"), "-pix_fmt", "yuv420p", str(args.out / "laws.mp4"),
    ]  # fmt: skip
    return subprocess.run(command, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
