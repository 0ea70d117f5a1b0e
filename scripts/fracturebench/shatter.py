"""Run the reference ensemble of FractureBench's case ``shatter``, store it, and compare with it.

    python scripts/fracturebench/shatter.py record [-o FILE] [--device cpu|cuda]
    python scripts/fracturebench/shatter.py compare [-o FILE.jsonl] [--quick] [--device cpu|cuda]

``record`` writes the figures of eight runs at dx = R / 10 in float64 (4 minutes on one core).
``compare`` runs ensembles over dx, CFL and precision and prints how far each is from the record,
in every measure beside its run-to-run band; a line of ``-o`` per setting, and what is there is not
run again.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch

from gsfluent.fracturebench.fracture_shatter import RADIUS, RECORD, SEEDS, reference
from gsfluent.fracturebench.registry import find
from gsfluent.fracturebench.run import Run
from gsfluent.fracturebench.scene import Scene
from gsfluent.fracturebench.statistics import distance, ensemble
from gsfluent.io.atomic import atomic_path
from gsfluent.lab.frozen import play

CELLS, CFL = 10, 0.3
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
    if explicit:  # the map as published for a fixed centre
        more = {"k": float("inf"), "epsilon": 0.0, "implicit": False}
    return partial(play, device=device, cfl=cfl, dtype=getattr(torch, dtype), **more)


def record(out: Path, device: str) -> None:
    """Run the reference and write its figures."""
    members = ensemble(find("shatter"), RADIUS / CELLS, 8, SEEDS, player(device, CFL, "float64"))
    header = {"dx": RADIUS / CELLS, "cfl": CFL, "dtype": "float64", "seeds": list(SEEDS)}
    runs = [m.figures.plain() for m in members]
    with atomic_path(out) as file:
        file.write_text(json.dumps(header | {"runs": runs}) + "\n", encoding="utf-8")


def compare(out: Path | None, device: str, quick: bool) -> None:
    """Print and store the distance of every setting to the record."""
    done: dict[str, dict[str, Any]] = {}
    if out is not None and out.exists():
        lines = out.read_text(encoding="utf-8").splitlines()
        done = {json.dumps(row["settings"]): row for row in map(json.loads, lines)}
    for setting in SETTINGS[:2] if quick else SETTINGS:
        settings = {**setting, "device": device, "seeds": 2 if quick else len(SEEDS)}
        row = done.get(json.dumps(settings))
        if row is None:
            chosen = {k: v for k, v in setting.items() if k != "cells"}
            members = ensemble(
                find("shatter"), RADIUS / setting["cells"], 8, range(settings["seeds"]),
                player(device, **chosen),
            )  # fmt: skip
            found = distance(reference(), members)
            row = {
                "case": "shatter", "method": "gsfluent", "settings": settings,
                "distance": {k: [d.value, d.band] for k, d in found.items()},
                "pieces": [int((m.figures.pieces > 0.01).sum()) for m in members],
            }  # fmt: skip
            if out is not None:
                with out.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(row) + "\n")
        print(" ".join(f"{k} {v}" for k, v in row["settings"].items()))
        for name, (value, band) in row["distance"].items():
            said = "within the band" if value <= band else f"{value / band:.1f} bands"
            print(f"    {name:24} {value:.3f}, band {band:.3f}: {said}")


def main(argv: list[str] | None = None) -> int:
    """Parse the command line and run it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("record", "compare"))
    parser.add_argument("-o", "--out", type=Path)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--quick", action="store_true", help="two settings, two seeds")
    args = parser.parse_args(argv)
    if args.what == "record":
        record(args.out or RECORD, args.device)
    else:
        compare(args.out, args.device, args.quick)
    return 0


if __name__ == "__main__":
    sys.exit(main())
