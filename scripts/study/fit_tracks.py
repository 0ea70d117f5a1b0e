"""Materials learnt from tracks: error and bands on random scenes, truth by the whole simulation.

python scripts/study/fit_tracks.py --scenes 10 --cells 8  # one core; goes on

Balls and ellipsoids of an elastic thing or of plasticine fall on a floor. The truth is simulated as
`gsfluent run` does it (float32, shaken points, its own time steps) at half the spacing of the finer
grid of the fit; 150 of its points are the tracks. One JSON line per scene.
"""

from __future__ import annotations

import argparse
import json
import math
import time as clock
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsfluent.data import SURFACE, Gaussians, Solid
from gsfluent.figure.markdown import enter
from gsfluent.materials import Material
from gsfluent.pipeline import Fit, Simulate
from gsfluent.scene.scene import Scene
from gsfluent.targets import Points

DATA = Path(__file__).resolve().parents[2] / "docs" / "measured" / "data"
PAGE = DATA.parent / "fit.md"
FPS, FRAMES, TRACKS, SIDE = 24.0, 12, 150, 0.3
VOXELS = 48
BARS = {"log10 E": 0.02, "nu": 0.02, "log10 yield": 0.03, "v [m/s]": 0.002}
"""Of the specification, tracks, elastic; plasticine's E 0.2."""
START = {
    "elastic": {"young_modulus": 10**5.5, "poisson_ratio": 0.25},
    "plasticine": {"young_modulus": 10**5.5, "poisson_ratio": 0.25, "yield_stress": 1e3},
}
SURE = 1.2816
"""Standard deviations on either side that hold 80 % of a normal."""


def ellipsoid(half: np.ndarray) -> Solid:
    """Solid with these half axes, its lowest point at z = 0."""
    voxel = 2.0 * float(half.max()) / VOXELS
    axis = (torch.arange(VOXELS) + 0.5) * voxel - float(half.max())
    grid = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1)
    full = (grid / torch.from_numpy(half).float()).norm(dim=-1) < 1.0
    lift = torch.tensor([0.0, 0.0, float(half[2])])
    some = grid[full][::200] + lift
    splats = Gaussians.from_colors(
        some, torch.full((len(some),), voxel), torch.full((len(some), 3), 0.5), label=SURFACE
    )
    origin = torch.full((3,), -float(half.max())) + lift
    return Solid(splats, full, torch.zeros(full.shape), origin, voxel)


def scene_of(kind: str, solid: Solid, values: dict[str, Any], velocity: Any) -> Scene:
    """The thing at 5 cm over the floor."""
    law = "elastic" if kind == "elastic" else "von_mises"
    scene = Scene()
    material = Material("it", density=1000.0, law=law, **values)
    scene.add(solid, material, velocity=[float(v) for v in velocity], name="it")
    scene.lift(0.05)
    return scene


def record(kind: str, number: int, cells: int) -> dict[str, Any]:
    """One scene: truth, fit, errors."""
    random = np.random.default_rng([number, len(kind)])
    half = 0.5 * SIDE * np.array([1.0, 1.0, 1.0 if number % 2 else random.uniform(0.8, 1.0)])
    true: dict[str, Any] = {
        "young_modulus": 10 ** random.uniform(5.0, 6.0),
        "poisson_ratio": random.uniform(0.15, 0.4),
    }
    if kind == "plasticine":
        true["yield_stress"] = 10 ** random.uniform(3.5, 4.3)
    velocity = np.array([*random.uniform(-0.5, 0.5, 2), random.uniform(-3.0, -1.5)])
    solid = ellipsoid(half)
    truth = scene_of(kind, solid, true, velocity)
    dx = SIDE / (cells * 1.5 * 2.0)
    begun = clock.process_time()
    run = Simulate(dx=dx, seed=100 + number, repair=False)(truth, fps=FPS, seconds=FRAMES / FPS)
    frames = [frame.particles.position.double().numpy() for frame in run]
    rows = random.choice(len(frames[0]), TRACKS, replace=False)
    tracks = np.stack([frame[rows] for frame in frames])
    middle = clock.process_time()
    guess = scene_of(kind, solid, START[kind], velocity + random.uniform(-0.2, 0.2, 3))
    learn = [f"it.{name}" for name in (*true, "velocity")]
    found = Fit(learn, starts=1, cells=cells)(guess, Points(tracks, fps=FPS))
    rows_ = []
    for key, number_ in found.report["parameters"].items():
        name = key.partition(".")[2]
        if name not in true and name != "velocity":
            continue
        for k, value in enumerate(np.ravel(number_["value"])):
            want = velocity[k] if name == "velocity" else true[name]
            log = name not in ("velocity", "poisson_ratio")
            error = math.log10(value / want) if log else float(value - want)
            rows_.append({"name": name, "error": error, "sd": float(np.ravel(number_["sd"])[k]),
                          "grid": number_["grid"][k], "unidentified": key in found.unidentified,
                          "truth": float(want)})  # fmt: skip
    return {
        "kind": kind, "scene": number, "cells": cells, "rows": rows_,
        "rms_mm": found.report["rms"] * 2**0.5,
        "offset": found.values.get("floor.offset"), "truth_points": len(frames[0]),
        "runs": [g["runs"] for g in found.report["grids"]],
        "truth_seconds": middle - begun, "fit_seconds": clock.process_time() - middle,
    }  # fmt: skip


NAMES = {"young_modulus": "log10 E", "poisson_ratio": "nu", "yield_stress": "log10 yield",
         "velocity": "v [m/s]"}  # fmt: skip


def table(records: list[dict[str, Any]]) -> str:
    """Mean absolute errors, and how often bands of 80 % hold the truth."""
    head = ["material", "number", "scenes", "mean abs. error", "bar", "80 % bands hold",
            "unidentified", "median rms [mm]", "fit [CPU s]"]  # fmt: skip
    lines = ["| " + " | ".join(head) + " |", "| --- " * len(head) + "|"]
    for kind in START:
        mine = [r for r in records if r["kind"] == kind]
        for name, said in NAMES.items():
            rows = [row for r in mine for row in r["rows"] if row["name"] == name]
            if not rows:
                continue
            errors = np.abs([row["error"] for row in rows])
            held = sum(e <= SURE * row["sd"] for e, row in zip(errors, rows, strict=True))
            bar = 0.2 if (kind, name) == ("plasticine", "young_modulus") else BARS[said]
            if (kind, name) == ("plasticine", "poisson_ratio"):
                bar = math.nan
            lines.append(
                f"| {kind} | {said} | {len(mine)} | {errors.mean():.3g} | "
                f"{'-' if math.isnan(bar) else bar} | {held} of {len(rows)} | "
                f"{sum(row['unidentified'] for row in rows)} | "
                f"{np.median([r['rms_mm'] for r in mine]):.2g} | "
                f"{np.median([r['fit_seconds'] for r in mine]):.0f} |"
            )
    return "\n".join(lines)


def main() -> None:
    """Do what is left, then enter the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=10, help="of each material")
    parser.add_argument(
        "--cells", type=int, default=8, help="across the thing, on the coarser grid"
    )
    parser.add_argument("--only", nargs="*", default=list(START), choices=list(START))
    parser.add_argument("--out", type=Path, default=DATA / "fit_tracks.jsonl")
    parser.add_argument("--markdown", type=Path, default=DATA.parent / "fit.md")
    options = parser.parse_args()
    torch.set_num_threads(1)
    path: Path = options.out
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    records = [json.loads(line) for line in lines]
    done = {(r["kind"], r["scene"]) for r in records}
    for number in range(options.scenes):
        for kind in options.only:
            if (kind, number) in done:
                continue
            records.append(record(kind, number, options.cells))
            with path.open("a", encoding="utf-8") as stream:
                stream.write(json.dumps(records[-1]) + "\n")
    if records:
        page: Path = options.markdown
        text = page.read_text(encoding="utf-8") if page.is_file() else "# Materials from tracks\n"
        page.write_text(enter(text, "fit", table(records)), encoding="utf-8")


if __name__ == "__main__":
    main()
