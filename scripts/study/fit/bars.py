"""Two bars of fits: the time of one, and how much of a block of two laws is told apart.

python scripts/study/fit/bars.py --only time block
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import time as clock
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tracks import DATA, FPS, PAGE, SIDE, entered

from gsfluent.data import SURFACE, Gaussians, Solid
from gsfluent.materials import Material
from gsfluent.pipeline import Fit, Simulate
from gsfluent.pipeline.fit.forward import Forward
from gsfluent.scene.parts import Part
from gsfluent.scene.scene import Scene
from gsfluent.targets import Points

TRACKS, VOXELS = 150, 48
FALL = (0.2, 0.0, -2.0)


def block() -> Solid:
    """A cube with its lower side at z = 0."""
    voxel = SIDE / VOXELS
    full = torch.ones(VOXELS, VOXELS, VOXELS, dtype=torch.bool)
    origin = torch.tensor([-0.5 * SIDE, -0.5 * SIDE, 0.0])
    some = origin + (torch.rand(50, 3, generator=torch.Generator().manual_seed(0)) * SIDE)
    splats = Gaussians.from_colors(
        some, torch.full((50,), voxel), torch.full((50, 3), 0.5), label=SURFACE
    )
    return Solid(splats, full, torch.zeros(full.shape), origin, voxel)


def falling(material: Material, parts: tuple[Part, ...] = (), velocity: Any = FALL) -> Scene:
    """The block over the floor."""
    scene = Scene()
    scene.add(block(), material, velocity=velocity, name="it")
    scene.bodies[0] = dataclasses.replace(scene.bodies[0], parts=parts)
    scene.lift(0.06)
    return scene


def tracks(truth: Scene, dx: float, frames: int) -> np.ndarray:
    """Tracked points of a simulation on this grid, float32, shaken points."""
    run = Simulate(dx=dx, seed=11, repair=False)(truth, fps=FPS, seconds=frames / FPS)
    seen = [frame.particles.position.double().numpy() for frame in run]
    rows = np.random.default_rng(1).choice(len(seen[0]), TRACKS, replace=False)
    return np.stack([frame[rows] for frame in seen])


def rubber(young: float, nu: float = 0.3) -> Material:
    """What does not yield."""
    return Material("rubber", young, nu, 1000.0, law="elastic")


def place(device: str) -> str:
    """What did the work."""
    if device == "cuda":
        return torch.cuda.get_device_name()
    return f"{torch.get_num_threads()} threads of a CPU"


def time(device: str) -> dict[str, Any]:
    """E, nu and velocity of 10,000 points, on one grid and on two; truth at half the spacing."""
    cells, frames = 11, 11
    dx = SIDE / cells
    seen = tracks(falling(rubber(1e5)), 0.5 * dx, frames)
    guess = falling(rubber(10**4.5, 0.25), velocity=(0.0, 0.0, -1.8))
    learn = ["it.young_modulus", "it.poisson_ratio", "it.velocity"]
    rows = {}
    if device == "cuda":
        torch.zeros(1, device=device)  # the driver starts once, whatever is done afterwards
    for grids in (1, 2):
        begun = clock.perf_counter()
        fit = Fit(learn, starts=1, cells=cells, grids=grids, offset=False, device=device)
        found = fit(guess, Points(seen, fps=FPS))
        seconds = clock.perf_counter() - begun
        forward = Forward(found.scene, [k / FPS for k in range(frames)], dx)
        rows[str(grids)] = {
            "seconds": seconds, "points": forward.count,
            "steps": math.ceil((frames - 1) / FPS / forward.step(found.values)),
            "runs": [g["runs"] for g in found.report["grids"]],
            "log10 E": math.log10(found.values["it.young_modulus"] / 1e5),
            "nu": found.values["it.poisson_ratio"] - 0.3,
            "v": float(np.abs(np.subtract(found.values["it.velocity"], FALL)).max()),
        }  # fmt: skip
    return {"on": place(device), "grids": rows}


def blocks(device: str) -> dict[str, Any]:
    """Rubber on clay, the law of every point by two grids; truth at half the finer spacing."""
    cells, frames = 6, 9
    low = [[-1.0, -1.0, -1.0], [1.0, 1.0, 0.5 * SIDE]]
    clay = Part("low", {"box": low}, {"law": "von_mises", "yield_stress": 1e3})
    truth = falling(rubber(1e5), (clay,))
    seen = tracks(truth, SIDE / (4 * cells), frames)
    begun = clock.perf_counter()
    fit = Fit(["it.velocity"], laws=["elastic", "von_mises"], per="point", nodes=3, cells=cells,
              device=device)  # fmt: skip
    found = fit(falling(rubber(5e4)), Points(seen, fps=FPS))
    solid = found.scene.bodies[0].solid
    assert solid is not None and solid.regions is not None
    inside = solid.occupancy
    under = (solid.voxel_centers(inside.nonzero())[:, 2] < 0.5 * SIDE).int()
    right = float((solid.regions[inside] == under).double().mean())
    return {
        "on": place(device), "right": right, "seconds": clock.perf_counter() - begun,
        "rms": found.report["rms"],
        "values": found.values, "laws": found.laws,
        "runs": [g["runs"] for g in found.report["grids"]],
    }  # fmt: skip


def text(found: dict[str, Any]) -> str:
    """What was measured, in lines."""
    lines = []
    if times := [found[key] for key in ("time", "time cuda") if key in found]:
        lines += ["| on | grids | points | steps | runs | seconds | log10 E | nu | v [m/s] |",
                  "| --- " * 9 + "|"]  # fmt: skip
        for made in times:
            for grids, row in made["grids"].items():
                runs = " + ".join(str(n) for n in row["runs"])
                errors = " | ".join(f"{row[k]:+.2g}" for k in ("log10 E", "nu", "v"))
                lines.append(
                    f"| {made['on']} | {grids} | {row['points']} | {row['steps']} | {runs} | "
                    f"{row['seconds']:.0f} | {errors} |"
                )
        lines += ["", "Five numbers; bar 240 s on two cores, 30 s on a GPU.", ""]
    for key in ("block", "block cuda"):
        if key in found:
            row = found[key]
            lines.append(
                f"A block, rubber on clay: {row['right']:.1%} of it under the right law "
                f"(bar 95 %), in {row['seconds']:.0f} s on {row['on']}."
            )
    return "\n".join(lines)


def main() -> None:
    """Measure, and enter what is known."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="*", default=["time", "block"], choices=["time", "block"])
    parser.add_argument("--device", default="cpu", choices=["cpu", "cuda"])
    parser.add_argument("--out", type=Path, default=DATA / "fit_bars.json")
    parser.add_argument("--markdown", type=Path, default=PAGE)
    options = parser.parse_args()
    path: Path = options.out
    found = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    for name in options.only:
        key = name if options.device == "cpu" else f"{name} {options.device}"
        found[key] = {"time": time, "block": blocks}[name](options.device)
        path.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
        print(json.dumps(found[key]), flush=True)
    entered(options.markdown, "bars", text(found), "## Time, and two laws")


if __name__ == "__main__":
    main()
