"""A small run as files: a green ball with a red inside that parts into two halves."""

from __future__ import annotations

import json
import math
from pathlib import Path

import torch
from torch import Tensor

from gsfluent.data import INTERIOR, SURFACE, Gaussians
from gsfluent.results.frames import SavedFrame, save_frame

RADIUS = 0.1
SIGMA = 0.007  # of the splats of the skin
FPS = 20.0
FRAMES = 5
GREEN, RED = (0.15, 0.55, 0.2), (0.85, 0.12, 0.12)
SPEED = 0.6  # m/s at which the halves part after frame 2
HEIGHT = 0.12  # of the middle of the ball


def fibonacci(count: int) -> Tensor:
    """Unit vectors [count, 3], evenly spread."""
    index = torch.arange(count) + 0.5
    z = 1 - 2 * index / count
    angle = math.pi * (1 + math.sqrt(5)) * index
    ring = (1 - z**2).sqrt()
    return torch.stack([ring * angle.cos(), ring * angle.sin(), z], -1)


def lattice(spacing: float) -> Tensor:
    """Points [P, 3] of a cubic lattice inside the ball."""
    steps = torch.arange(-RADIUS, RADIUS + spacing, spacing) + 0.37 * spacing
    points = torch.cartesian_prod(steps, steps, steps)
    return points[points.norm(dim=1) < RADIUS]


def frame(index: int) -> SavedFrame:
    """Whole until frame 2; then the halves x < 0 and x > 0 part, each with its number."""
    spacing = 0.0125
    points = lattice(spacing)
    skin = RADIUS * fibonacci(1500)
    inside = lattice(0.011)
    inside = inside[inside.norm(dim=1) < 0.9 * RADIUS]
    means = torch.cat([skin, inside])
    colors = torch.cat(
        [torch.tensor(GREEN).expand(len(skin), 3), torch.tensor(RED).expand(len(inside), 3)]
    )
    labels = torch.full((len(means),), INTERIOR, dtype=torch.int32)
    labels[: len(skin)] = SURFACE
    anchor = torch.cdist(means, points).argmin(1).to(torch.int32)
    side = torch.where(points[:, 0] < 0, -1.0, 1.0)
    parted = max(0, index - 2)
    step = torch.zeros_like(points)
    step[:, 0] = side * SPEED * parted / FPS
    lift = torch.tensor([0.0, 0.0, HEIGHT])
    # the label of a piece is the row of its first point
    pieces = torch.zeros(len(points), dtype=torch.int32)
    broken = torch.zeros(len(points))
    if parted:
        pieces[side > 0] = int((side > 0).nonzero()[0])
        pieces[side < 0] = int((side < 0).nonzero()[0])
        broken[points[:, 0].abs() < 0.6 * spacing] = 1.0
        pieces[broken > 0] = -1
    velocity = torch.zeros_like(points)
    velocity[:, 0] = side * SPEED * float(parted > 0)
    gaussians = Gaussians.from_colors(
        means + step[anchor.long()] + lift,
        torch.cat([torch.full((len(skin),), SIGMA), torch.full((len(inside),), 0.006)]),
        colors,
        opacities=0.98,
    ).replace(labels=labels)
    count = len(points)
    return SavedFrame(
        index=index,
        time=index / FPS,
        gaussians=gaussians,
        groups=torch.full((gaussians.count,), -1, dtype=torch.int32),
        carried=gaussians.count,
        ids=torch.arange(gaussians.count),
        anchor=anchor,
        positions=points + step + lift,
        volumes=torch.full((count,), spacing**3),
        damage=broken,
        fragments=pieces,
        velocity=velocity,
        body=torch.zeros(count, dtype=torch.int32),
        material=(points.norm(dim=1) > 0.8 * RADIUS).to(torch.int32),
        facts={
            "time": index / FPS,
            "kinetic": 1.5 * parted,
            "elastic": 2.0 / (1 + index),
            "dissipated": 0.2 * parted,
            "gravity": 1.0,
            "momentum": [0.0, 0.0, -0.1 * index],
            "fragments": 1 + int(parted > 0),
            "damaged_fraction": float(broken.mean()),
        },
    )


def write_run(out: Path, frames: int = FRAMES, *, finished: bool = True) -> Path:
    """``OUT`` as a run leaves it, or has it while it is at work."""
    folder = out / "stages" / "simulate"
    folder.mkdir(parents=True, exist_ok=True)
    for index in range(frames):
        save_frame(folder, frame(index))
    marker = {"fingerprint": "ball", "complete": finished}
    (folder / "stage.json").write_text(json.dumps(marker), encoding="utf-8")
    if finished:
        holes = [0.01 * index for index in range(frames)]
        record = {"verdict": "clean", "render": {"hole_fraction": holes}}
        (out / "run.json").write_text(json.dumps(record), encoding="utf-8")
    return out
