"""The speed from which things break: the plan's estimate against drops of small bodies.

python scripts/study/breaks_from.py --jobs 16             # five minutes of 16 cores; the page
python scripts/study/breaks_from.py --only plaster ice    # some presets

Balls fall side by side on a floor, as ``drop_heights.py`` lets them: a ladder of heights around the
estimate, then several specimens in steps of root two around the height that parts one, then in
steps of a fifth. One JSON line per preset and shape; what is there is not run again.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import multiprocessing
import sys
import time as clock
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import torch
from drop_heights import DATA, GRAVITY, LADDER, Case, Drop, median, records, search
from drop_shapes import ball

from gsfluent import materials
from gsfluent.figure.markdown import enter
from gsfluent.stages.breaking import breaks_from

PAGE = DATA.parent / "breaks_from.md"
PRESETS = (
    "plaster", "ceramic", "bone", "rock", "ice", "chocolate", "concrete", "glass",
    "fruit.apple", "fruit.watermelon", "fruit.orange", "snow", "fruit.pumpkin",
)  # fmt: skip
SHAPES = {
    "ball": (0.1, 10.0),
    "large ball": (0.3, 10.0),
    "small ball": (0.04, 10.0),
    "ball of 16 cells": (0.1, 16.0),
    "ball of 18 cm": (0.18, 12.0),
}
"""Diameter [m] and cells across it. The estimate was fitted to all but the last."""
TRAVERSALS = 16.0
"""How long a fall is followed, in traversals of the body by the wave."""
GOOD = 0.25
"""Error of the height that counts as right."""


def study(preset: str, shape: str, seeds: int) -> dict[str, Any]:
    """The record of one preset in one shape."""
    begun = clock.perf_counter()
    torch.set_num_threads(1)
    diameter, cells = SHAPES[shape]
    case = Case(preset, ball(diameter), cells, TRAVERSALS)
    drop = Drop(case, {"preset": preset}, "preset", "cpu", False)
    search(drop, height_of(preset, 2.0 * max(case.shape.half), drop.dx), LADDER, seeds, 3e5)
    middle = median(drop.falls)[0]
    if middle is not None:
        closer = [middle * 2.0 ** (k / 8.0) for k in (-3, -1, 1, 3)]
        drop.fall([(height, seed) for height in closer for seed in range(seeds + 1)], 3e5)
    middle, low, high = median(drop.falls)
    return {
        "preset": preset, "shape": shape, "dx": drop.dx, "points": drop.points,
        "length": 2.0 * max(case.shape.half), "height": middle, "low": low,
        "high": None if math.isinf(high) else high, "specimens": len(drop.falls),
        "seconds": clock.perf_counter() - begun,
        "falls": [dataclasses.asdict(fall) for fall in drop.falls],
    }  # fmt: skip


def height_of(preset: str, length: float, dx: float) -> float:
    """Height from which the plan says that it breaks [m]."""
    return breaks_from(materials.get(preset), length, dx) ** 2 / (2.0 * GRAVITY)


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown: every preset and shape, and how many are right."""
    head = ("preset", "shape", "simulated m", "whole below, broken above m", "plan m", "ratio",
            "specimens")  # fmt: skip
    lines = [f"| {' | '.join(head)} |", f"|{' --- |' * len(head)}"]
    right: dict[str, set[str]] = {shape: set() for shape in SHAPES}
    for row in sorted(
        rows, key=lambda r: ([*SHAPES].index(r["shape"]), PRESETS.index(r["preset"]))
    ):
        planned = height_of(row["preset"], row["length"], row["dx"])
        found = row["height"]
        ratio = planned / found if found else math.nan
        if abs(ratio - 1.0) <= GOOD:
            right[row["shape"]].add(row["preset"])
        ends = f"{row['low']:.3g}, {row['high']:.3g}" if row["high"] else f"{row['low']:.3g}, -"
        cells = [row["preset"], row["shape"], f"{found:.3g}" if found else "-", ends,
                 f"{planned:.3g}", f"{ratio:.2f}" if found else "-",
                 str(row["specimens"])]  # fmt: skip
        lines.append(f"| {' | '.join(cells)} |")
    said = [
        f"{shape}: {len(names)} of {sum(r['shape'] == shape for r in rows)}"
        for shape, names in right.items()
        if any(row["shape"] == shape for row in rows)
    ]
    return "\n".join([*lines, "", f"Within {GOOD:.0%} of the simulated height: {', '.join(said)}."])


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="+", choices=PRESETS, default=list(PRESETS))
    parser.add_argument("--shapes", nargs="+", choices=list(SHAPES), default=list(SHAPES))
    parser.add_argument("--jobs", type=int, default=1, help="processes of one thread each")
    parser.add_argument("--seeds", type=int, default=3, help="specimens at a height")
    parser.add_argument("-o", "--output", type=Path, default=DATA / "breaks_from.jsonl")
    parser.add_argument("--markdown", type=Path, default=PAGE, help="page to enter the table into")
    parser.add_argument("--only-table", action="store_true", help="run nothing")
    options = parser.parse_args(arguments)
    done = {(row["preset"], row["shape"]) for row in records(options.output)}
    wanted = [
        (preset, shape) for shape in options.shapes for preset in options.only
        if (preset, shape) not in done and not options.only_table
    ]  # fmt: skip
    wanted.sort(key=lambda pair: -SHAPES[pair[1]][1])  # what takes longest first
    if wanted:
        options.output.parent.mkdir(parents=True, exist_ok=True)
        fresh = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(min(options.jobs, len(wanted)), mp_context=fresh) as pool:
            found = [pool.submit(study, *pair, options.seeds) for pair in wanted]
            for row in (each.result() for each in as_completed(found)):
                with options.output.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(row) + "\n")
                sys.stdout.write(
                    f"{row['preset']} {row['shape']}: {row['height']}, {row['seconds']:.0f} s\n"
                )
                sys.stdout.flush()
    page = options.markdown
    text = page.read_text(encoding="utf-8") if page.is_file() else ""
    page.write_text(enter(text, "breaks_from", table(records(options.output))), "utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
