"""Materials learnt from tracks: error and bands on random scenes, truth by the whole simulation.

python scripts/study/fit/tracks.py --scenes 10 --jobs 16 --minutes 8  # a process a core; goes on
python scripts/study/fit/tracks.py --device cuda --jobs 6 --truths DIR  # truths are kept for later

Ellipsoids fall on a floor. The truth is simulated as `gsfluent run` does it (float32, shaken
points, its own time steps) at half the spacing of the finer grid of the fit; 150 of its points are
the tracks, each coordinate seen with a noise of 0.1 mm. Ranges lie
about the objects of PAC-NeRF; elastic and Newtonian matter starts as in its files. One JSON line
per scene.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import os
import sys
import time as clock
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsfluent.data import SURFACE, Gaussians, Particles, Solid
from gsfluent.figure.markdown import enter
from gsfluent.materials import Material
from gsfluent.pipeline import Fit, Simulate
from gsfluent.pipeline.fit.forward import Forward
from gsfluent.pipeline.fit.solve import Problem, linearise
from gsfluent.pipeline.fit.stage import Found
from gsfluent.pipeline.fit.task import RATIO, Task, one_by_one
from gsfluent.pipeline.fit.together import together
from gsfluent.scene.scene import Scene
from gsfluent.targets import Points

DATA = Path(__file__).resolve().parents[3] / "docs" / "measured" / "data"
PAGE = DATA.parent / "fit.md"
FPS, FRAMES, TRACKS, SIDE, GAP = 24.0, 12, 150, 0.3, 0.25
VOXELS = 48
NOISE = 1e-4
"""Of a coordinate of a track [m]: without it bands of velocities would have nothing to hold."""


@dataclasses.dataclass(frozen=True)
class Kind:
    """Matter: its law, ranges of the truth (of moduli, stresses and viscosities log10), starts."""

    law: str
    truth: dict[str, tuple[float, float]]
    start: dict[str, float]
    given: dict[str, float] = dataclasses.field(default_factory=dict)


KINDS = {
    "elastic": Kind(
        "elastic",
        {"young_modulus": (5.0, 6.0), "poisson_ratio": (0.15, 0.4)},
        {"young_modulus": 10**5.5, "poisson_ratio": 0.25},
    ),
    "plasticine": Kind(
        "von_mises",
        {"young_modulus": (5.3, 6.3), "poisson_ratio": (0.2, 0.4), "yield_stress": (3.5, 4.3)},
        {"young_modulus": 10**5.5, "poisson_ratio": 0.25, "yield_stress": 1e3},
    ),
    "newtonian": Kind(
        "fluid",
        {"viscosity": (1.5, 2.5), "bulk_modulus": (4.7, 5.3)},
        {"viscosity": 10.0, "bulk_modulus": 1e4},
    ),
    "non-newtonian": Kind(
        "von_mises",
        {
            "young_modulus": (4.5, 5.5), "poisson_ratio": (0.3, 0.45), "yield_stress": (2.0, 3.5),
            "plastic_viscosity": (0.7, 1.3),
        },
        {
            "young_modulus": 1e5, "poisson_ratio": 0.35, "yield_stress": 100.0,
            "plastic_viscosity": 3.0,
        },
    ),
    "sand": Kind(
        "drucker_prager",
        {"friction_angle": (25.0, 45.0)},
        {"friction_angle": 15.0},
        {"young_modulus": 10**5.5, "poisson_ratio": 0.3},
    ),
}  # fmt: skip
NUMBERS = {
    "young_modulus": "log10 E", "poisson_ratio": "nu", "yield_stress": "log10 tau_Y",
    "viscosity": "log10 mu", "bulk_modulus": "log10 kappa", "plastic_viscosity": "log10 eta",
    "friction_angle": "angle [deg]", "velocity": "v [m/s]",
}  # fmt: skip
BARS = {
    ("elastic", "young_modulus"): "0.02", ("elastic", "poisson_ratio"): "0.02",
    ("plasticine", "young_modulus"): "0.2", ("plasticine", "yield_stress"): "0.03",
    ("newtonian", "viscosity"): "0.03", ("newtonian", "bulk_modulus"): "flagged",
    ("non-newtonian", "yield_stress"): "0.02", ("non-newtonian", "plastic_viscosity"): "0.2",
    ("sand", "friction_angle"): "0.5",
}  # fmt: skip
"""Of the specification, tracks; of velocities 0.002 m/s."""
PUBLISHED = {
    ("elastic", "young_modulus"): (0.189, 0.087), ("elastic", "poisson_ratio"): (0.123, 0.106),
    ("plasticine", "young_modulus"): (1.597, 0.892), ("plasticine", "yield_stress"): (0.327, 0.132),
    ("newtonian", "viscosity"): (0.103, 0.071), ("newtonian", "bulk_modulus"): (3.18, 1.90),
    ("non-newtonian", "yield_stress"): (0.069, 0.032),
    ("non-newtonian", "plastic_viscosity"): (0.519, 0.507),
    ("sand", "friction_angle"): (6.79, 0.90),
}  # fmt: skip
"""GIC (Cai et al. 2024) and ProJo4D (TMLR 2026), both from 3 views, as ProJo4D's page has them."""
PLAIN = ("poisson_ratio", "friction_angle")
"""Numbers that are no logarithms."""
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


def scene_of(kind: Kind, solid: Solid, values: dict[str, float], velocity: Any) -> Scene:
    """The thing over the floor."""
    scene = Scene()
    material = Material("it", density=1000.0, law=kind.law, **kind.given, **values)  # type: ignore[arg-type]
    scene.add(solid, material, velocity=[float(v) for v in velocity], name="it")
    scene.lift(GAP)
    return scene


def thing(kind: Kind, random: np.random.Generator) -> tuple[Solid, np.ndarray, dict[str, float]]:
    """A thing, its velocity and numbers."""
    solid = ellipsoid(0.5 * SIDE * random.uniform(0.7, 1.0, 3))
    velocity = np.array([*random.uniform(-0.3, 0.3, 2), random.uniform(-1.5, -0.5)])
    drawn = {name: random.uniform(*ends) for name, ends in kind.truth.items()}
    return solid, velocity, {k: v if k in PLAIN else 10**v for k, v in drawn.items()}


def fall(
    kind: Kind, number: int, cells: int, random: np.random.Generator, device: str = "cpu"
) -> tuple[Solid, np.ndarray, dict[str, float], list[Particles]]:
    """A thing, its velocity and numbers, its points at the frames of its fall."""
    solid, velocity, true = thing(kind, random)
    dx = SIDE / (cells * RATIO * 2.0)
    run = Simulate(dx=dx, seed=100 + number, repair=False, device=device)(
        scene_of(kind, solid, true, velocity), fps=FPS, seconds=FRAMES / FPS
    )
    return solid, velocity, true, [frame.particles.to("cpu") for frame in run]


def seen(
    kind: Kind, number: int, cells: int, random: np.random.Generator, device: str = "cpu"
) -> tuple[Solid, np.ndarray, dict[str, float], np.ndarray, int]:
    """A thing, its velocity and numbers, tracks of its fall, how many points moved."""
    solid, velocity, true, frames = fall(kind, number, cells, random, device)
    places = [frame.position.double().numpy() for frame in frames]
    rows = random.choice(len(places[0]), TRACKS, replace=False)
    return solid, velocity, true, np.stack([place[rows] for place in places]), len(places[0])


def keep(task: Task, found: dict[str, Any], path: Path) -> None:
    """Residuals and Jacobian where a search has ended, so that other bands may be tried on them."""
    times = list(task.target.times)
    forward = Forward(task.scene, times, task.dx, device=task.device)
    problem = Problem(
        forward, task.target.observe(forward.setting()), task.unknowns, task.target.step
    )
    free = np.asarray(found["free"])
    finer = Forward(task.scene, times, task.dx / RATIO, device=task.device)
    problem.refine(finer, free, len(times))
    here = linearise(problem, free, len(times))
    np.savez_compressed(
        path, labels=task.unknowns.labels(), free=free, start=task.unknowns.start,
        spread=task.unknowns.spread, slope=task.unknowns.slope(free), trust=problem.trust,
        residual=here.residual.astype(np.float16), jacobian=here.jacobian.astype(np.float32),
        scale=here.scale, frame=here.frame.astype(np.int16),
        covariance=np.asarray(found["covariance"]),
    )  # fmt: skip


def errors_of(found: Found, true: dict[str, float], velocity: np.ndarray) -> list[dict[str, Any]]:
    """What was found against the truth, a row for each number."""
    errors = []
    for key, learnt in found.report["parameters"].items():
        name = key.partition(".")[2]
        if name not in true and name != "velocity":
            continue
        for k, value in enumerate(np.ravel(learnt["value"])):
            want = velocity[k] if name == "velocity" else true[name]
            log = name not in ("velocity", *PLAIN)
            error = math.log10(value / want) if log else float(value - want)
            errors.append({"name": name, "error": error, "sd": float(np.ravel(learnt["sd"])[k]),
                           "sd_noise": learnt["sd_noise"][k],
                           "grid": learnt["grid"][k], "unidentified": key in found.unidentified,
                           "truth": float(want)})  # fmt: skip
    return errors


def record(
    kind: str, number: int, cells: int, kept: Path | None = None, device: str = "cpu",
    truth: str = "cpu", truths: Path | None = None,
) -> dict[str, Any]:  # fmt: skip
    """One scene: truth, fit, errors."""
    torch.set_num_threads(1)
    return fitted(shown(kind, number, cells, truth, truths), kept, device)


@dataclasses.dataclass(frozen=True)
class Shown:
    """A scene and what was seen of it."""

    kind: str
    number: int
    cells: int
    true: dict[str, float]
    velocity: np.ndarray
    guess: Scene
    tracks: np.ndarray
    points: int
    seconds: float


def shown(kind: str, number: int, cells: int, device: str, truths: Path | None = None) -> Shown:
    """Simulate the truth of a scene, or read what was seen of it another time."""
    here = KINDS[kind]
    random = np.random.default_rng([number, len(kind)])
    begun = clock.perf_counter()
    path = None if truths is None else truths / f"{kind}_{number}_{cells}.npz"
    if path is not None and path.is_file():
        with np.load(path) as file:
            known = {name: file[name] for name in file.files}
        solid, velocity, true = thing(here, random)
        guess = known["guess"]
        tracks, points, seconds = known["tracks"], int(known["points"]), float(known["seconds"])
    else:
        solid, velocity, true, tracks, points = seen(here, number, cells, random, device)
        guess = velocity + random.uniform(-0.2, 0.2, 3)
        seconds = clock.perf_counter() - begun
        if path is not None:
            np.savez_compressed(path, tracks=tracks, points=points, seconds=seconds, guess=guess)
    start = scene_of(here, solid, here.start, guess)
    noise = np.random.default_rng([number, len(kind), 9]).normal(scale=NOISE, size=tracks.shape)
    return Shown(kind, number, cells, true, velocity, start, tracks + noise, points, seconds)


def fitted(made: Shown, kept: Path | None, device: str) -> dict[str, Any]:
    """Fit to what was seen; errors."""
    begun = clock.perf_counter()
    learn = [f"it.{name}" for name in (*made.true, "velocity")]
    searches: list[tuple[Task, dict[str, Any]]] = []

    def runner(function: Callable[[Any], Any], items: Iterable[Any]) -> list[Any]:
        tasks = list(items)
        done = one_by_one(function, tasks)
        searches.extend(zip(tasks, done, strict=True))
        return done

    fit = Fit(learn, starts=1, cells=made.cells, runner=runner, device=device)
    found = fit(made.guess, Points(made.tracks, fps=FPS))
    end = clock.perf_counter()
    if kept is not None:
        keep(*searches[-1], kept / f"{made.kind}_{made.number}.npz")
    return {
        "kind": made.kind, "scene": made.number, "cells": made.cells,
        "rows": errors_of(found, made.true, made.velocity),
        "rms_mm": found.report["rms"] * 2**0.5, "truth_points": made.points,
        "grid": {k: found.values[k] for k in ("floor.offset", "grid.extrapolation")},
        "runs": [g["runs"] for g in found.report["grids"]],
        "points": [g["points"] for g in found.report["grids"]],
        "truth_seconds": made.seconds, "fit_seconds": end - begun, "device": device,
    }  # fmt: skip


def noted(
    judge: Callable[[Any], dict[str, Any]], made: list[Any], path: Path
) -> list[dict[str, Any]]:
    """What a function makes of scenes beside each other; each is added to a file at its end."""

    def one(scene: Any) -> dict[str, Any] | None:
        try:
            row = judge(scene)
        except Exception as error:  # the others go on
            print(f"{scene}: {error!r}"[-500:], file=sys.stderr, flush=True)
            return None
        with path.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps(row) + "\n")
        return row

    return [row for row in together(one, made) if row is not None]


def beside(
    kind: str, numbers: list[int], cells: int, kept: Path | None, device: str, truth: str,
    truths: Path | None, path: Path,
) -> list[dict[str, Any]]:  # fmt: skip
    """Scenes of one matter, whose fits wait for each other."""
    torch.set_num_threads(1)
    begun = clock.perf_counter()
    made = [shown(kind, number, cells, truth, truths) for number in numbers]
    middle = clock.perf_counter()
    rows = noted(lambda one: fitted(one, kept, device), made, path)
    print(f"{kind}: {len(rows)} scenes, truth {middle - begun:.1f} s, fits "
          f"{clock.perf_counter() - middle:.1f} s", flush=True)  # fmt: skip
    return rows


def table(records: list[dict[str, Any]]) -> str:
    """Mean absolute errors, and how often bands of 80 % hold the truth."""
    head = ["matter", "number", "scenes", "mean abs. error", "bar", "GIC, 3 views",
            "ProJo4D, 3 views", "80 % bands hold", "unidentified"]  # fmt: skip
    lines = ["| " + " | ".join(head) + " |", "| --- " * len(head) + "|"]
    inside = outside = 0
    for kind, here in KINDS.items():
        mine = [r for r in records if r["kind"] == kind]
        for name in (*here.truth, "velocity"):
            rows = [row for r in mine for row in r["rows"] if row["name"] == name]
            if not rows:
                continue
            errors = np.abs([row["error"] for row in rows])
            held = sum(e <= SURE * row["sd"] for e, row in zip(errors, rows, strict=True))
            inside, outside = inside + held, outside + len(rows) - held
            bar = "0.002" if name == "velocity" else BARS.get((kind, name), "-")
            theirs = PUBLISHED.get((kind, name), ("-", "-"))
            lines.append(
                f"| {kind} | {NUMBERS[name]} | {len(mine)} | {errors.mean():.2g} | {bar} | "
                f"{theirs[0]} | {theirs[1]} | {held} of {len(rows)} | "
                f"{sum(row['unidentified'] for row in rows)} |"
            )
    seconds = [r["fit_seconds"] for r in records]
    runs = np.array([r["runs"] for r in records])
    lines += [
        "",
        f"Bands of 80 % hold {inside} of {inside + outside} numbers "
        f"({inside / (inside + outside):.0%}; bar 70 to 90 %).",
        f"A fit takes {np.median(seconds):.0f} s beside others (longest {max(seconds):.0f} s): "
        f"{np.median(runs[:, 0]):.0f} runs on the coarser grid, {np.median(runs[:, 1]):.0f} on the "
        "finer (medians).",
    ]
    return "\n".join(lines)


def read(path: Path) -> list[dict[str, Any]]:
    """What has been done."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    return [json.loads(line) for line in lines]


def patiently(function: Callable[..., Any], *task: Any) -> Any:
    """Call it; once more after a while where the driver was not ready (a server that starts)."""
    try:
        return function(*task)
    except RuntimeError as error:
        if "cuda" not in str(error).lower():
            raise
    clock.sleep(8.0)
    return function(*task)


def in_pool(
    function: Callable[..., Any],
    tasks: list[tuple[Any, ...]],
    path: Path,
    jobs: int,
    minutes: float,
) -> list[dict[str, Any]]:
    """Call a function with each of the tasks, and add what comes to a file, until time is up.

    A process has one thread. What fails is told, and the others go on. A function that gives a list
    has added it by itself.
    """
    end, records = clock.monotonic() + 60.0 * minutes, []
    os.environ.update({f"{kind}_NUM_THREADS": "1" for kind in ("OMP", "MKL", "OPENBLAS")})
    with ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
        calls = {pool.submit(patiently, function, *task): task for task in tasks}
        try:
            for call in as_completed(calls, timeout=max(end - clock.monotonic(), 0.0)):
                if (error := call.exception()) is not None:
                    print(f"{calls[call]}: {error!r}", file=sys.stderr, flush=True)
                    continue
                if isinstance(made := call.result(), list):
                    records += made
                    continue
                records.append(made)
                with path.open("a", encoding="utf-8") as stream:
                    stream.write(json.dumps(records[-1]) + "\n")
        except TimeoutError:
            for process in pool._processes.values():
                process.terminate()
            pool.shutdown(wait=False, cancel_futures=True)
    return records


def entered(page: Path, name: str, part: str, heading: str = "") -> None:
    """Enter a table into the page of fits, which is begun where there is none."""
    text = page.read_text(encoding="utf-8") if page.is_file() else "# Materials from tracks\n"
    page.write_text(enter(text, name, part, heading), encoding="utf-8")


def main() -> None:
    """Do what is left, then enter the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=10, help="of each matter")
    parser.add_argument("--cells", type=int, default=8, help="along the thing, coarser grid")
    parser.add_argument("--only", nargs="*", default=list(KINDS), choices=list(KINDS))
    parser.add_argument("--device", default="cpu", choices=["cpu", "cuda"])
    parser.add_argument("--truth", choices=["cpu", "cuda"], help="its device; that of the fit")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--beside", type=int, default=1, help="scenes whose fits are one run")
    parser.add_argument(
        "--minutes", type=float, default=1e6, help="what is not done by then is left"
    )
    parser.add_argument("--out", type=Path, default=DATA / "fit_tracks.jsonl")
    parser.add_argument("--truths", type=Path, help="folder of what was seen, for another time")
    parser.add_argument("--keep", type=Path, help="folder for residuals and Jacobians of scenes")
    parser.add_argument("--markdown", type=Path, default=PAGE)
    options = parser.parse_args()
    path: Path = options.out
    for folder in (options.keep, options.truths):
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
    records = read(path)
    done = {(r["kind"], r["scene"]) for r in records}
    kept, device, cells = options.keep, options.device, options.cells
    truth, size, truths = options.truth or device, options.beside, options.truths
    slow_first = [k for k in reversed(KINDS) if k in options.only]
    if size > 1:
        groups = [
            (k, left, cells, kept, device, truth, truths, path)
            for i in range(0, options.scenes, size)
            for k in slow_first
            if (left := [n for n in range(i, min(i + size, options.scenes)) if (k, n) not in done])
        ]
        in_pool(beside, groups, path, options.jobs, options.minutes)
    else:
        wanted = [(k, n) for n in range(options.scenes) for k in slow_first if (k, n) not in done]
        tasks = [(k, n, cells, kept, device, truth, truths) for k, n in wanted]
        in_pool(record, tasks, path, options.jobs, options.minutes)
    records = read(path)
    if records:
        entered(options.markdown, "fit", table(records))


if __name__ == "__main__":
    main()
