"""What FractureBench's fracture cases depend on, measured and entered into docs.

    python scripts/fracturebench/loads.py [--quick]

Speed of the notch's crack with light and heavy grips at two CFL numbers and two speeds of
tearing, energy that the cantilever's crack takes at three speeds of opening, shapes of the pieces
of struck rock on three grids (a minute on one core).
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from gsfluent.figure.markdown import enter
from gsfluent.fracturebench.registry import find, judge
from gsfluent.fracturebench.scenes.cantilever import cantilever
from gsfluent.fracturebench.scenes.plane import notch
from gsfluent.fracturebench.scenes.rock import experiment
from gsfluent.io.atomic import atomic_path
from gsfluent.lab.frozen.answer import run_case

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "measured" / "fracturebench_fracture.md"


def speeds(quick: bool) -> list[str]:
    """Rows of the table of the notch."""
    rows = ["| grips | speed of a grip | CFL 0.5 | CFL 0.25 |", "|---|---|---|---|"]
    for weight, pull in ((1.0, 5e-5), (30.0, 3e-5), (30.0, 6e-6))[: 1 if quick else 3]:
        found = []
        for cfl in (0.5, 0.25):
            scene = notch(1 / 32, 8, pull, weight)
            fastest, mean, _ = judge(scene, run_case(scene, cfl=cfl))
            found.append(f"{mean.value:.2f}, fastest tenth {fastest.value:.2f}")
        rows.append(f"| {weight:g} times as heavy | {pull:g} c | {found[0]} | {found[1]} |")
    return rows


def energies(quick: bool) -> list[str]:
    """Rows of the table of the cantilever."""
    rows = ["| speed of an arm | energy gone per area | that of the row |", "|---|---|---|"]
    for speed, seconds in ((0.004, 8.0), (0.002, 10.0), (0.001, 14.0))[: 1 if quick else 3]:
        scene = cantilever(1 / 32, 8, speed, seconds)
        (energy,) = judge(scene, run_case(scene))
        rows.append(f"| {speed:g} c | {energy.value:.0f} J/m^2 | {energy.reference:.0f} J/m^2 |")
    return rows


def shapes(quick: bool) -> list[str]:
    """Rows of the table of struck rock."""
    found = experiment()["pieces"]
    rows = ["| points | Rosin-Rammler modulus | mean aspect ratio |", "|---|---|---|"]
    case = find("struck_rock")
    for dx in case.ladder[: 1 if quick else None]:
        scene = case.build(dx, 8)
        modulus, aspect = judge(scene, run_case(scene))
        rows.append(f"| {scene.count} | {modulus.value:.2f} | {aspect.value:.2f} |")
    (a, b), (c, d) = found["modulus"], found["aspect"]
    rows.append(f"| rocks | {a:.2f} to {b:.2f} | {c:.2f} to {d:.2f} |")
    return rows


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="one row of each, printed only")
    quick = parser.parse_args().quick
    tables = {"notch_loads": speeds(quick), "cantilever_loads": energies(quick),
              "rock_shapes": shapes(quick)}  # fmt: skip
    if quick:
        for rows in tables.values():
            sys.stdout.write("\n".join(rows) + "\n\n")
        return 0
    text = PAGE.read_text(encoding="utf-8")
    for name, rows in tables.items():
        text = enter(text, name, "\n".join(rows))
    with atomic_path(PAGE) as file:
        file.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
