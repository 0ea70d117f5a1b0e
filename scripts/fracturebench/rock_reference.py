"""Work out what FractureBench compares with from the tables of Rae et al., and store it.

    GSFLUENT_DATA=... python scripts/fracturebench/rock_reference.py [-o FILE]

Reads ``reference/rock_fracture_rae`` in the data folder: strengths and strain rates of the samples
that failed in the split Hopkinson bar, sieve curves of their fragments, aspect ratios of the
fragments above 2 mm on photographs. Marble is not among the sieve curves used, granite and gneiss
have no photographs.
"""

from __future__ import annotations

import argparse
import csv
import math
import os
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np

from gsfluent.fracturebench.scenes.rock import EXPERIMENT, rosin_rammler
from gsfluent.io.atomic import write_json

ROCKS = {"sandstone": "SeeSst__Sheet1", "quartzite": "TaQu__TaQu", "limestone": "SaLi__SaLi"}


def table(path: Path) -> list[list[str]]:
    """Rows of a CSV file."""
    with path.open(encoding="utf-8-sig", newline="") as file:
        return list(csv.reader(file))


def strength(folder: Path, name: str) -> tuple[dict[str, float], dict[str, float]]:
    """Power law of strength over strain rate, and the rate of every failed test by its name."""
    failed = [
        (row[0], float(row[10]), 1e6 * float(row[6]))
        for row in table(folder / f"{name}.csv")
        if len(row) > 10 and row[1] == "SHPB" and row[5].startswith("Y")
    ]
    rate, value = np.log([f[1] for f in failed]), np.log([f[2] for f in failed])
    exponent, start = np.polyfit(rate, value, 1)
    scatter = float(np.std(value - exponent * rate - start))
    fit = {"exponent": float(exponent), "at_1_per_s": math.exp(start), "scatter": scatter,
           "tests": len(failed)}  # fmt: skip
    return fit, {f[0]: f[1] for f in failed}


def moduli(folder: Path, tests: set[str]) -> list[float]:
    """Rosin-Rammler modulus of the fragments of every test with a sieve curve."""
    found, sieves = [], np.zeros(0)
    for row in table(folder / "AllSieveData_without_Carrara.csv"):
        heads = [re.search(r"([\d.]+) *< s|s *> *([\d.]+)", cell) for cell in row]
        if any(heads):
            sieves = np.array([float(h.group(1) or h.group(2)) for h in heads if h])
        elif row and row[0] in tests:
            kept = np.array([float(cell or 0.0) for cell in row[7 : 7 + sieves.size]]) / 100.0
            found.append(rosin_rammler(sieves, 1.0 - np.cumsum(kept))[0])
    return [n for n in found if math.isfinite(n)]


def aspects(folder: Path) -> list[float]:
    """Mean aspect ratio of the fragments above 2 mm of every photographed sample."""
    return [
        float(row[8])
        for row in table(folder / "SampleList__Sheet1.csv")
        if re.match(r"(SeeSst|TaQu|SaLi)_\d", row[0])
    ]


def main(argv: list[str] | None = None) -> int:
    """Parse the command line and run it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, default=EXPERIMENT)
    args = parser.parse_args(argv)
    folder = Path(os.environ.get("GSFLUENT_DATA", "")) / "reference" / "rock_fracture_rae"
    if not folder.is_dir():
        print(f"{folder}: no such folder; set GSFLUENT_DATA", file=sys.stderr)
        return 1
    found: dict[str, Any] = {"source": "Rae et al., github.com/ASprae (see SOURCE.md of the data)"}
    every = []
    for rock, name in ROCKS.items():
        fit, tests = strength(folder, name)
        n = moduli(folder, set(tests))
        every += n
        found[rock] = {"strength": fit, "modulus": [min(n), float(np.median(n)), max(n)]}
    shape = aspects(folder)
    found["pieces"] = {
        "modulus": [min(every), max(every)], "modulus_median": float(np.median(every)),
        "aspect": [min(shape), max(shape)], "aspect_median": float(np.median(shape)),
        "samples": [len(every), len(shape)],
    }  # fmt: skip
    write_json(args.out, found)
    return 0


if __name__ == "__main__":
    sys.exit(main())
