"""The reference ensemble of FractureBench's case ``shatter``, and settings compared with it.

    python scripts/fracturebench/shatter.py record [-o FILE] [--device cpu|cuda]
    python scripts/fracturebench/shatter.py compare [-o FILE.jsonl] [--quick] [--device cpu|cuda]
    python scripts/fracturebench/shatter.py page [-o FILE.jsonl]

``record`` writes the figures of eight runs at dx = R / 10 in float64 (2 minutes on one core).
``compare`` runs ensembles over dx, CFL, precision and return map (4 minutes on one core): one line
per setting, and what is there is not run again. ``page`` enters the table into
docs/measured/fracturebench_fracture.md and draws docs/images/shatter.png from those lines.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsfluent.figure.markdown import enter
from gsfluent.figure.style import COLORS, OURS, new_figure, save_png
from gsfluent.fracturebench.registry import find
from gsfluent.fracturebench.run import Run
from gsfluent.fracturebench.scene import Scene
from gsfluent.fracturebench.scenes.shatter import RADIUS, RECORD, SEEDS, reference
from gsfluent.fracturebench.statistics import MEASURES, Figures, distance, ensemble
from gsfluent.io.atomic import atomic_path
from gsfluent.lab.frozen.answer import run_case

ROOT = Path(__file__).resolve().parents[2]
CELLS, CFL = 10, 0.3
LINES = ROOT / "docs" / "measured" / "data" / "shatter.jsonl"
PAGE = ROOT / "docs" / "measured" / "fracturebench_fracture.md"
PICTURE = ROOT / "docs" / "images" / "shatter.png"
SETTINGS: tuple[dict[str, Any], ...] = (
    *({"cells": n, "cfl": 0.5, "dtype": "float32"} for n in (4, 5, 6, 7, 8)),
    {"cells": 6, "cfl": 0.25, "dtype": "float32"},
    {"cells": 6, "cfl": 0.8, "dtype": "float32"},
    {"cells": 6, "cfl": 0.5, "dtype": "float64"},
    {"cells": 6, "cfl": 0.5, "dtype": "float32", "explicit": True},
)


def player(device: str, cfl: float, dtype: str, explicit: bool = False) -> Callable[[Scene], Run]:
    """How a scene is run."""
    more: dict[str, Any] = {}
    if explicit:  # a fixed centre and the explicit alpha
        more = {"k": float("inf"), "epsilon": 0.0, "implicit": False}
    return partial(run_case, device=device, cfl=cfl, dtype=getattr(torch, dtype), **more)


def record(out: Path, device: str) -> None:
    """Run the reference and write its figures."""
    members = ensemble(find("shatter"), RADIUS / CELLS, 8, SEEDS, player(device, CFL, "float64"))
    header = {"dx": RADIUS / CELLS, "cfl": CFL, "dtype": "float64", "seeds": list(SEEDS)}
    runs = [m.figures.plain() for m in members]
    with atomic_path(out) as file:
        file.write_text(json.dumps(header | {"runs": runs}) + "\n", encoding="utf-8")


def name_of(settings: dict[str, Any]) -> str:
    """A setting in words."""
    more = ", fixed centre, explicit" if settings.get("explicit") else ""
    return f"R / {settings['cells']}, CFL {settings['cfl']}, {settings['dtype']}{more}"


def read(path: Path) -> list[dict[str, Any]]:
    """Lines of a file, none if it is not there."""
    if not path.exists():
        return []
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def figures_of(row: dict[str, Any]) -> list[Figures]:
    """Figures of the runs of a line."""
    return [Figures.of_plain(p) for p in row["runs"]]


def compare(out: Path | None, device: str, quick: bool) -> None:
    """Run every setting that is not there yet, and say how far each is from the record."""
    done = {json.dumps(row["settings"]): row for row in read(out)} if out else {}
    chosen = SETTINGS[:2] if quick else SETTINGS
    for i, setting in enumerate(chosen, 1):
        settings = {**setting, "device": device, "seeds": 2 if quick else len(SEEDS)}
        row = done.get(json.dumps(settings))
        if row is None:
            options = {k: v for k, v in setting.items() if k != "cells"}
            members = ensemble(
                find("shatter"), RADIUS / setting["cells"], 8, range(settings["seeds"]),
                player(device, **options),
            )  # fmt: skip
            runs = [m.figures.plain() for m in members]
            row = {"case": "shatter", "method": "gsfluent", "settings": settings, "runs": runs}
            if out is not None:
                out.parent.mkdir(parents=True, exist_ok=True)
                with out.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(row) + "\n")
        found = distance(reference(), figures_of(row))
        sys.stderr.write(f"{i}/{len(chosen)} {name_of(settings)}\n")
        for measure in MEASURES:
            sys.stderr.write(f"    {measure:24} {found[measure]}\n")


def page(lines: Path) -> int:
    """Enter the table into the page and draw the picture."""
    rows = read(lines)
    if not rows:
        sys.stderr.write(f"{lines}: no lines; run `shatter.py compare -o {lines}` first\n")
        return 1
    ours = reference()
    bands = distance(ours, ours)
    head = "| setting | " + " | ".join(MEASURES) + " | pieces above 1 % |"
    table = [head, "|" + "---|" * (len(MEASURES) + 2)]
    table.append(
        "| run-to-run band | " + " | ".join(f"{bands[m].band:.3f}" for m in MEASURES)
        + f" | {median_count(ours):.0f} |"
    )  # fmt: skip
    for row in rows:
        runs = figures_of(row)
        found = distance(ours, runs)
        cells = [
            "within the band" if found[m].within else f"{found[m].value:.3f}" for m in MEASURES
        ]
        name = name_of(row["settings"])
        table.append(f"| {name} | " + " | ".join(cells) + f" | {median_count(runs):.0f} |")
    text = enter(PAGE.read_text(encoding="utf-8"), "shatter", "\n".join(table))
    with atomic_path(PAGE) as file:
        file.write_text(text, encoding="utf-8")
    draw(rows, ours)
    return 0


def median_count(runs: list[Figures]) -> float:
    """Median number of pieces above a hundredth of the mass."""
    return float(np.median([(f.pieces > 0.01).sum() for f in runs]))


def draw(rows: list[dict[str, Any]], ours: list[Figures]) -> None:
    """Momentum over time and mass over pieces, the reference as a band."""
    places = np.geomspace(1e-4, 0.7, 200)

    def below(f: Figures) -> np.ndarray:
        return np.array([f.pieces[f.pieces <= m].sum() for m in places])

    steps = np.arange(1, ours[0].momentum.shape[0] + 1) * 30.0 / ours[0].momentum.shape[0]
    ladder = [r for r in rows if r["settings"]["cfl"] == 0.5 and r["settings"]["dtype"] == "float32"
              and not r["settings"].get("explicit")]  # fmt: skip
    with new_figure(9.0, 3.4) as figure:
        left, right = figure.subplots(1, 2)
        for axes, along, of in (
            (left, steps, lambda f: f.momentum[:, 2]),
            (right, places, below),
        ):
            reach = np.array([of(f) for f in ours])
            axes.fill_between(along, reach.min(0), reach.max(0), color=OURS, alpha=0.35, lw=0,
                              label="reference, 8 runs")  # fmt: skip
            for color, row in zip(COLORS, ladder, strict=False):
                runs = [of(f) for f in figures_of(row)]
                axes.plot(along, np.median(runs, axis=0), color=color, lw=1.2,
                          label=f"R / {row['settings']['cells']}")  # fmt: skip
        left.set(xlabel="time [R / c]", ylabel="momentum over the first, upward", title="Momentum")
        right.set(xlabel="mass of a piece over the whole", xscale="log",
                  ylabel="mass in lighter pieces", title="Mass over pieces")  # fmt: skip
        left.legend()
        save_png(figure, PICTURE)


def main(argv: list[str] | None = None) -> int:
    """Parse the command line and run it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("record", "compare", "page"))
    parser.add_argument("-o", "--out", type=Path)
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--quick", action="store_true", help="two settings, two seeds")
    args = parser.parse_args(argv)
    if args.what == "record":
        record(args.out or RECORD, args.device)
    elif args.what == "compare":
        compare(args.out, args.device, args.quick)
    else:
        return page(args.out or LINES)
    return 0


if __name__ == "__main__":
    sys.exit(main())
