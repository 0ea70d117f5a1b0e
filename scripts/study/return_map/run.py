"""Which return mapping is the default, settled by measurement.

    python scripts/study/return_map/run.py --markdown docs/measured/return-mapping.md

Every variant (fixed centre; the paper's k = 2; algorithm D with its epsilon; explicit and implicit
alpha) on: the two order-sensitivity tests of the specification (equations.md 7.6, solver.md 0.6),
one-particle paths (equations.md 7.4), dt-consistency of damage, speed. What is measured is kept in
``--results`` after every job; a run that was stopped goes on where it was.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch
from cases import (
    DEFAULT,
    ELASTIC,
    PATHS,
    SCENES,
    VARIANTS,
    Run,
    Variant,
    apart,
    broken,
    path,
    points,
    speed,
    throw,
)

from gsfluent.figure.markdown import enter

PRECISIONS = {"float32": torch.float32, "float64": torch.float64}
# Scene, precision, places against the grid, other orders at each place: in float32 the ball that
# breaks scatters from place to place.
ORDER_SCENES = [
    ("ball", "float32", 4, 1),
    ("ball", "float64", 1, 2),
    ("ball-weak", "float32", 4, 1),
    ("ball-weak", "float64", 1, 2),
    ("block-weak", "float32", 1, 2),
    ("block-weak", "float64", 1, 2),
    ("block", "float32", 1, 2),
]
REFINE = (1, 2, 4)
PATH_STEPS = (150, 600, 2400)
Result = dict[str, Any]


def order_job(scene: str, variant: Variant, precision: str, places: int, orders: int) -> Result:
    """The same particles in other orders, at several places against the grid."""
    dtype, pairs, share = PRECISIONS[precision], [], []
    for place in range(places):
        given = throw(SCENES[scene], variant, dtype, place=place)
        share.append(broken(given))
        for seed in range(5, 5 + orders):
            other = throw(SCENES[scene], variant, dtype, seed=seed, place=place)
            pairs.append(apart(given, other))
    return {"pairs": pairs, "broken": statistics.mean(share)}


def time_job(scene: str, variant: Variant) -> Result:
    """Dt, dt / 2 and dt / 4 against dt / 4, float64."""
    runs: list[Run] = [
        throw(SCENES[scene], variant, torch.float64, refine=refine) for refine in REFINE
    ]
    return {
        "broken": [broken(run) for run in runs],
        "apart": [apart(run, runs[-1]) for run in runs[:-1]],
    }


def path_job(name: str, variant: Variant) -> Result:
    return {str(steps): path(name, variant, steps) for steps in PATH_STEPS}


def speed_job(precision: str) -> Result:
    """All variants on one state: they differ by tens of nanoseconds, so they are timed together."""
    run = throw(SCENES["ball"], DEFAULT, PRECISIONS[precision], part=0.6)
    found: Result = {}
    for variant in (ELASTIC, *VARIANTS):
        found[variant.name] = {
            "yielding": speed(run.state, run.dt, variant, strong=False),
            "elastic": speed(run.state, run.dt, variant, strong=True),
        }
    return found


def jobs() -> dict[str, Callable[[], Result]]:
    """Every measurement by its name in the results."""
    todo: dict[str, Callable[[], Result]] = {}
    for precision in PRECISIONS:
        todo[f"speed/{precision}/{len(VARIANTS)}"] = partial(speed_job, precision)
    for variant in VARIANTS:
        for name in PATHS:
            todo[f"path/{name}/{variant.name}"] = partial(path_job, name, variant)
    for scene, precision, places, orders in ORDER_SCENES:
        for variant in (ELASTIC, *VARIANTS):
            key = f"order/{scene}/{precision}/{places} x {orders}/{variant.name}"
            todo[key] = partial(order_job, scene, variant, precision, places, orders)
    for scene in ("ball", "ball-weak"):
        for variant in (ELASTIC, *VARIANTS):
            todo[f"time/{scene}/{variant.name}"] = partial(time_job, scene, variant)
    return todo


def measure(results: Path) -> dict[str, Result]:
    """Run what is not in ``results`` yet; written after every job."""
    torch.set_num_threads(1)
    done: dict[str, Result] = json.loads(results.read_text()) if results.exists() else {}
    todo = jobs()
    begin = time.perf_counter()
    for i, (name, job) in enumerate(todo.items()):
        if name in done:
            continue
        done[name] = job()
        results.parent.mkdir(parents=True, exist_ok=True)
        scratch = results.with_suffix(".part")
        scratch.write_text(json.dumps(done, indent=1) + "\n")
        scratch.replace(results)
        sys.stderr.write(f"{i + 1}/{len(todo)} {time.perf_counter() - begin:.0f} s {name}\n")
    return {name: done[name] for name in todo}


def grid(head: list[str], rows: list[list[str]]) -> list[str]:
    """A markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return ["| " + " | ".join(line) + " |" for line in lines] + [""]


def order_part(done: dict[str, Result]) -> list[str]:
    head = ["map"]
    for scene, precision, places, orders in ORDER_SCENES:
        head.append(f"{scene}, {precision} ({places * orders})")
    rows = []
    for variant in (ELASTIC, *VARIANTS):
        row = [variant.name]
        for scene, precision, places, orders in ORDER_SCENES:
            pairs = done[f"order/{scene}/{precision}/{places} x {orders}/{variant.name}"]["pairs"]
            far = [p["rms"] for p in pairs]
            alpha = max(p["alpha"] for p in pairs)
            cell = f"{statistics.median(far):.0e}"
            if places > 1 and variant.law:
                cell += f" to {max(far):.0e}"
            row.append(f"{cell}, {alpha:.0e}" if variant.law else cell)
        rows.append(row)
    count = {s: len(points(SCENES[s].shape)) for s in SCENES}
    share = {
        scene: done[f"order/{scene}/{precision}/{places} x {orders}/{DEFAULT.name}"]["broken"]
        for scene, precision, places, orders in ORDER_SCENES
    }
    text = (
        "**Order of the particles.** Runs that differ only in the numbering of the particles "
        "(number of pairs in brackets; four are at four places of the solid against the grid): "
        "root mean square difference of positions in dx (median; of four, to the largest), largest "
        "difference of alpha. `ball`: equations.md "
        f"7.6, {count['ball']} particles, E = 166, t = 0.103; `block`: solver.md 0.6, "
        f"{count['block']} particles, 400 steps, E = 2000 (the material is not recorded there). "
        f"beta = 0.6, weak: 0.1. Broken at the end: {share['ball']:.0%}, {share['ball-weak']:.0%} "
        f"(ball), {share['block']:.0%}, {share['block-weak']:.0%} (block)."
    )
    return [text, "", *grid(head, rows)]


def path_part(done: dict[str, Result]) -> list[str]:
    def cell(result: Result) -> str:
        texts = []
        for steps in PATH_STEPS:
            fails = result[str(steps)]["fails"]
            texts.append("never" if fails is None else f"{fails:.3f}")
        return texts[0] if len(set(texts)) == 1 else " / ".join(texts)

    rows = []
    for variant in VARIANTS:
        cells = [done[f"path/{name}/{variant.name}"] for name in PATHS]
        last = cells[-1]["600"]
        row = [cell(c) for c in cells[:-1]] + [f"{last['q']:.2f}, {last['alpha']:.3f}"]
        rows.append([variant.name, *row])
    text = (
        "**One particle** (beta = 0.6, strain 0.6, float64): strain at which alpha reaches 0 in "
        f"{' / '.join(map(str, PATH_STEPS))} steps (one number: the same to 0.001); for "
        "compression the last q / mu and alpha in 600."
    )
    return [text, "", *grid(["map", *PATHS], rows)]


def time_part(done: dict[str, Result]) -> list[str]:
    rows = []
    for variant in (ELASTIC, *VARIANTS):
        row = [variant.name]
        for scene in ("ball", "ball-weak"):
            result = done[f"time/{scene}/{variant.name}"]
            if variant.law:
                row.append(" / ".join(f"{100 * b:.1f}" for b in result["broken"]))
            else:
                row.append("")
            row.append(" / ".join(f"{a['rms']:.2f}" for a in result["apart"]))
            row.append(
                " / ".join(f"{a['mean_alpha']:.4f}" for a in result["apart"]) if variant.law else ""
            )
        rows.append(row)
    head = ["map"]
    for scene in ("ball", "ball-weak"):
        head += [f"{scene}: broken, %", "position, dx", "alpha"]
    text = (
        "**Time step** (float64): broken particles at dt / dt/2 / dt/4; root mean square "
        "difference of positions and mean difference of alpha, dt and dt/2 against dt/4. The "
        "elastic row is what the transfers alone do."
    )
    return [text, "", *grid(head, rows)]


def speed_part(done: dict[str, Result]) -> list[str]:
    rows = []
    for variant in (ELASTIC, *VARIANTS):
        row = [variant.name]
        for precision in PRECISIONS:
            found = done[f"speed/{precision}/{len(VARIANTS)}"][variant.name]
            row += [f"{found['elastic']['ns']:.0f}", f"{found['yielding']['ns']:.0f}"]
        rows.append(row)
    found = done[f"speed/float32/{len(VARIANTS)}"]
    share = found[DEFAULT.name]["yielding"]["yielding"]
    head = ["map"]
    for precision in PRECISIONS:
        head += [f"{precision}, all elastic", f"{precision}, {share:.0%} yielding"]
    text = (
        "**Speed**: process time per particle [ns] of `return_mapping`, one core of the "
        "development machine under load, least of nine; the ball in mid-impact."
    )
    return [text, "", *grid(head, rows)]


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--results", type=Path, default=Path("build/return_map_study.json"))
    parser.add_argument("--markdown", type=Path, help="enter the tables into this page")
    options = parser.parse_args(arguments)
    done = measure(options.results)
    parts = [order_part(done), path_part(done), time_part(done), speed_part(done)]
    text = "\n".join(line for part in parts for line in part).rstrip()
    sys.stdout.write(text + "\n")
    if options.markdown:
        page = options.markdown
        page.write_text(enter(page.read_text() if page.exists() else "", "return_map_study", text))
    return 0


if __name__ == "__main__":
    sys.exit(main())
