"""Statistics of fragments of three materials: how far runs differ, and how they go with dx.

    python scripts/fracturebench/fragments.py [-o FILE.jsonl] [--device cuda] [--cells 4,6,8]
    python scripts/fracturebench/fragments.py --page        # table and picture from the lines

Balls of presets are thrown on a plane, on three grids, several times each: seeds move the grid by
less than a cell, so that nothing physical changes. One line per material and grid; what is there is
not run again. Pieces are found from positions alone (gsfluent.fracturebench.pieces). Enters its
table into docs/measured/fracturebench_fracture.md and draws docs/images/fragments.png. Six minutes
on one core.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "study"))
from fracture_resolution import thrown
from rows import numbers

from gsfluent.figure.markdown import enter
from gsfluent.figure.style import COLORS, OURS, new_figure, save_png
from gsfluent.fracturebench.registry import Case
from gsfluent.fracturebench.scene import SceneError
from gsfluent.fracturebench.statistics import Figures, ensemble, mass_ks
from gsfluent.io.atomic import atomic_path
from gsfluent.lab.charts.record import commit, machine
from gsfluent.lab.frozen.answer import run_case

ROOT = Path(__file__).resolve().parents[2]
LINES = ROOT / "docs" / "measured" / "data" / "fragments.jsonl"
PAGE = ROOT / "docs" / "measured" / "fracturebench_fracture.md"
PICTURE = ROOT / "docs" / "images" / "fragments.png"
LEAST = 0.01
"""Share of the mass from which a piece counts; what is in lighter ones is loose."""
Row = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Throw:
    """A ball of a preset."""

    preset: str
    radius: float  # [m]
    speed: float  # over the one at which its material breaks


THROWS = {
    "watermelon": Throw("fruit.watermelon", 0.12, 3.4),
    "glass": Throw("glass", 0.003, 6.5),
    "ceramic": Throw("ceramic", 0.005, 5.5),
}


@dataclasses.dataclass(frozen=True)
class Fragments:
    """What is drawn of one run."""

    count: int  # pieces of at least LEAST of the mass
    largest: float  # share of the mass in the largest
    loose: float  # share of the mass in pieces below LEAST

    @classmethod
    def of(cls, figures: Figures) -> Fragments:
        """Of the figures of a run."""
        big = figures.pieces >= LEAST
        return cls(int(big.sum()), float(figures.pieces[-1]), float(figures.pieces[~big].sum()))


def finer(figures: Figures, masses: np.ndarray) -> np.ndarray:
    """Share of the mass in pieces no heavier than each of some masses, [M]."""
    sums = np.concatenate([[0.0], np.cumsum(figures.pieces)])
    return np.asarray(sums[np.searchsorted(figures.pieces, masses, side="right")])


def run(name: str, cells: int, seeds: int, device: str) -> Row:
    """The line of a material on a grid."""
    throw = THROWS[name]
    build = partial(thrown, throw.preset, throw.radius, speed=throw.speed)
    case = Case(f"thrown {name}", "fracture", "", throw.radius / cells, build, lambda *_: (), ())
    begun = time.perf_counter()
    members = ensemble(
        case, throw.radius / cells, 8, range(seeds), partial(run_case, device=device)
    )
    return {
        **key_of(name, cells, seeds, device), "points": members[0].scene.count,
        "thrown_at": float(-members[0].scene.v[0, 2]), "machine": machine(device),
        "commit": commit(), "wall": round(time.perf_counter() - begun, 2),
        "runs": [m.figures.plain() for m in members],
    }  # fmt: skip


def key_of(name: str, cells: int, seeds: int, device: str) -> Row:
    """What a line is known by: a throw that has changed is run again."""
    throw = dataclasses.asdict(THROWS[name])
    return {"name": name, "cells": cells, "seeds": seeds, "device": device, **throw}


def read(path: Path) -> list[Row]:
    """Lines of a file, none if it is not there; one that was cut off is left out."""
    rows = []
    for line in path.read_text(encoding="utf-8").splitlines() if path.exists() else ():
        try:
            rows.append(json.loads(line))
        except json.JSONDecodeError:
            sys.stderr.write(f"{path}: a line was cut off and is left out\n")
    return rows


def run_all(path: Path, cells: Sequence[int], seeds: int, device: str) -> None:
    """Run what is not there yet, coarse grids first."""
    jobs = [(name, n) for n in cells for name in THROWS]
    path.parent.mkdir(parents=True, exist_ok=True)
    for i, (name, n) in enumerate(jobs, 1):
        key = key_of(name, n, seeds, device)
        if any(all(row.get(k) == v for k, v in key.items()) for row in read(path)):
            sys.stderr.write(f"{i}/{len(jobs)} {name}, R / {n}: there\n")
            continue
        row = run(name, n, seeds, device)
        whole = path.exists() and path.read_bytes()[-1:] not in (b"", b"\n")
        with path.open("a", encoding="utf-8") as file:
            file.write("\n" * whole + json.dumps(row) + "\n")
        found = [Fragments.of(f) for f in figures_of(row)]
        sys.stderr.write(
            f"{i}/{len(jobs)} {name}, R / {n}: {row['points']} points, {row['wall']:.0f} s, pieces "
            f"{[f.count for f in found]}, loose {[round(f.loose, 2) for f in found]}\n"
        )


def figures_of(row: Row) -> list[Figures]:
    """Figures of the runs of a line."""
    return [Figures.of_plain(p) for p in row["runs"]]


def ladders(rows: Sequence[Row], device: str) -> dict[str, list[Row]]:
    """Lines of every material as it is thrown now, coarse to fine; of the same grid the latest."""
    found: dict[str, list[Row]] = {}
    for name in THROWS:
        key = key_of(name, 0, 0, device)
        mine = {
            r["cells"]: r
            for r in rows
            if all(r.get(k) == v for k, v in key.items() if k not in ("cells", "seeds"))
        }
        if mine:
            found[name] = [mine[n] for n in sorted(mine)]
    return found


def spread(values: Sequence[float], form: str) -> str:
    """Mean and range."""
    return f"{np.mean(values):{form}} ({min(values):{form}} to {max(values):{form}})"


def table(found: dict[str, list[Row]]) -> str:
    """Means over seeds with their range, and the distance from the finest grid."""
    lines = [
        "| material | dx | points | runs | pieces over 1 % | largest | loose | mass over pieces, "
        "KS to the finest |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, rows in found.items():
        finest = figures_of(rows[-1])
        for row in rows:
            runs = figures_of(row)
            each = [Fragments.of(f) for f in runs]
            last = row is rows[-1]
            # a run of the finest grid is compared with its other runs
            away = [
                mass_ks(f.pieces, np.concatenate([o.pieces for j, o in enumerate(finest)
                                                  if not last or j != i]))
                for i, f in enumerate(runs)
            ]  # fmt: skip
            lines.append(
                f"| {name} | R / {row['cells']} | {row['points']} | {len(runs)} | "
                f"{spread([e.count for e in each], '.1f')} | "
                f"{spread([e.largest for e in each], '.2f')} | "
                f"{spread([e.loose for e in each], '.2f')} | "
                f"{spread(away, '.2f')}{', band' if last else ''} |"
            )
    machines = {f"{r['machine']} ({r['device']})" for rows in found.values() for r in rows}
    speeds = ", ".join(
        f"{name} of radius {1e3 * rows[-1]['radius']:g} mm at {rows[-1]['thrown_at']:.3g} m/s"
        for name, rows in found.items()
    )
    return "\n".join([f"{', '.join(sorted(machines))}; {speeds}.", "", *lines])


def draw(found: dict[str, list[Row]], path: Path) -> None:
    """Per material: mass over pieces with the band over seeds, and three figures over the grid."""
    places = np.geomspace(1e-4, 1.0, 300)
    shades = (COLORS[0], COLORS[1], OURS, COLORS[2], COLORS[4])
    most = max(
        Fragments.of(f).count for rows in found.values() for r in rows for f in figures_of(r)
    )
    with new_figure(3.2 * len(found), 7.6) as figure:
        grid = figure.subplots(3, len(found), squeeze=False, sharey="row")
        for column, (name, rows) in enumerate(found.items()):
            upper, middle, lower = (grid[i][column] for i in range(3))
            for color, row in zip(shades, rows, strict=False):
                curves = np.array([finer(f, places) for f in figures_of(row)])
                upper.fill_between(places, curves.min(0), curves.max(0), color=color, alpha=0.18,
                                   lw=0)  # fmt: skip
                upper.plot(places, curves.mean(0), color=color, lw=1.4, label=f"R / {row['cells']}")
            upper.set(
                title=name.capitalize(), xscale="log", xlim=(places[0], 1.0), ylim=(0.0, 1.02),
                xlabel="mass of a piece over the whole",
            )  # fmt: skip
            upper.legend(title="dx; band: all runs", title_fontsize=8.0, loc="upper left")
            cells = [row["cells"] for row in rows]
            each = [[Fragments.of(f) for f in figures_of(row)] for row in rows]
            for axes, what, color, label in (
                (middle, "count", OURS, "pieces over 1 %"),
                (lower, "largest", COLORS[1], "largest piece"),
                (lower, "loose", COLORS[0], "loose: pieces below 1 %"),
            ):
                values = [[getattr(e, what) for e in line] for line in each]
                low, high = [min(v) for v in values], [max(v) for v in values]
                axes.fill_between(cells, low, high, color=color, alpha=0.18, lw=0)
                axes.plot(cells, [np.mean(v) for v in values], "o-", color=color, lw=1.4, ms=4,
                          label=label)  # fmt: skip
                axes.set(xlabel="cells along the radius", xticks=cells)
            middle.set_ylim(0.0, 1.05 * most)
            lower.set_ylim(0.0, 1.0)
            if column == 0:
                upper.set_ylabel("share of the mass in lighter pieces")
                middle.set_ylabel("pieces over 1 % of the mass")
                lower.set_ylabel("share of the mass")
            lower.legend(loc="upper center")
        save_png(figure, path)


def page(lines: Path, device: str) -> int:
    """Enter the table into the page and draw the picture."""
    found = ladders(read(lines), device)
    if not found:
        sys.stderr.write(f"{lines}: no lines of {device}; run without --page first\n")
        return 1
    text = enter(PAGE.read_text(encoding="utf-8"), "fragments", table(found))
    with atomic_path(PAGE) as file:
        file.write_text(text, encoding="utf-8")
    draw(found, PICTURE)
    return 0


def main(argv: list[str] | None = None) -> int:
    """Parse the command line and run it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("-o", "--out", type=Path, default=LINES, metavar="FILE")
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--cells", type=numbers, default=(4, 6, 8), help="along the radius")
    parser.add_argument("--seeds", type=int, default=5, help="runs of each")
    parser.add_argument("--page", action="store_true", help="only table and picture")
    args = parser.parse_args(argv)
    if args.seeds < 2:
        parser.error(f"--seeds: a band needs two runs, got {args.seeds}")
    try:
        if not args.page:
            run_all(args.out, args.cells, args.seeds, args.device)
    except (SceneError, OSError) as error:
        sys.stderr.write(f"fragments.py: {error}\n")
        return 2
    return page(args.out, args.device) if args.page or args.out == LINES else 0


if __name__ == "__main__":
    sys.exit(main())
