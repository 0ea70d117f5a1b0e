"""The speed from which things break: the plan's estimate against drops of small bodies.

python scripts/study/breaks_from.py                       # one core, half an hour; the page
python scripts/study/breaks_from.py --only plaster ice    # some presets

Balls of ten cells fall side by side on a floor, as ``drop_heights.py`` lets them: a
ladder of heights around the estimate, then several specimens in steps of root two around the height
that parts one. One JSON line per preset and shape; what is there is not run again.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time as clock
from pathlib import Path
from typing import Any

from drop_heights import DATA, GRAVITY, LADDER, Case, Drop, median, records, search
from drop_shapes import ball

from gsfluent import materials
from gsfluent.figure.markdown import enter
from gsfluent.stages.breaking import breaks_from

PAGE = DATA.parent / "breaks_from.md"
PRESETS = (
    "plaster", "ceramic", "bone", "rock", "ice", "chocolate", "concrete", "glass",
    "fruit.apple", "fruit.watermelon", "fruit.orange", "snow",
)  # fmt: skip
SHAPES = {
    "ball": lambda: ball(0.1),
    "large ball": lambda: ball(0.3),
}
"""The estimate was fitted to the first; the other is its test."""
CELLS = 10.0
TRAVERSALS = 16.0
"""How long a fall is followed, in traversals of the body by the wave."""
GOOD = 0.25
"""Error of the height that counts as right."""


def study(preset: str, shape: str, seeds: int) -> dict[str, Any]:
    """The record of one preset in one shape."""
    begun = clock.perf_counter()
    case = Case(preset, SHAPES[shape](), CELLS, TRAVERSALS)
    drop = Drop(case, {"preset": preset}, "preset", "cpu", False)
    search(drop, height_of(preset, 2.0 * max(case.shape.half), drop.dx), LADDER, seeds, 3e5)
    middle, low, high = median(drop.falls)
    return {
        "preset": preset, "shape": shape, "dx": drop.dx, "points": drop.points,
        "length": 2.0 * max(case.shape.half), "height": middle, "low": low,
        "high": None if math.isinf(high) else high, "specimens": len(drop.falls),
        "seconds": clock.perf_counter() - begun,
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
                 f"{planned:.3g}", f"{ratio:.2f}", str(row["specimens"])]  # fmt: skip
        lines.append(f"| {' | '.join(cells)} |")
    said = [
        f"{shape}: {len(names)} of {sum(r['shape'] == shape for r in rows)}"
        for shape, names in right.items()
    ]
    return "\n".join([*lines, "", f"Within {GOOD:.0%} of the simulated height: {', '.join(said)}."])


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="+", choices=PRESETS, default=list(PRESETS))
    parser.add_argument("--shapes", nargs="+", choices=list(SHAPES), default=list(SHAPES))
    parser.add_argument("--seeds", type=int, default=3, help="specimens at a height")
    parser.add_argument("-o", "--output", type=Path, default=DATA / "breaks_from.jsonl")
    parser.add_argument("--markdown", type=Path, default=PAGE, help="page to enter the table into")
    parser.add_argument("--only-table", action="store_true", help="run nothing")
    options = parser.parse_args(arguments)
    done = {(row["preset"], row["shape"]) for row in records(options.output)}
    for shape in [] if options.only_table else options.shapes:
        for preset in options.only:
            if (preset, shape) in done:
                continue
            row = study(preset, shape, options.seeds)
            options.output.parent.mkdir(parents=True, exist_ok=True)
            with options.output.open("a", encoding="utf-8") as file:
                file.write(json.dumps(row) + "\n")
            sys.stdout.write(f"{preset} {shape}: {row['height']}, {row['seconds']:.0f} s\n")
            sys.stdout.flush()
    page = options.markdown
    text = page.read_text(encoding="utf-8") if page.is_file() else ""
    page.write_text(enter(text, "breaks_from", table(records(options.output))), "utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
