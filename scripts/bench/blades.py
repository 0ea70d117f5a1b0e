"""CPU time of a cut by a blade against that of a drop; docs/measured/blades.md.

    python scripts/bench/blades.py [--cells 22] [--seconds 0.8] [--materials NAME ...]
        [--composed] [--out FILE] [--write]

The same melon-shaped solid is dropped, or stands and is cut in two from above, for the same
simulated time at the same frames. A drop from 2 cm is on the grid from the start, as what is cut;
one from half a metre flies for 0.3 s, which costs nothing. With --composed the same cut is also
taken step by step by the composed operators. Times are CPU seconds of the process on one thread:
simulation, pieces and figures of every frame, no film.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import torch
from live import melon

from gsfluent.figure.markdown import enter
from gsfluent.io.atomic import atomic_path
from gsfluent.pipeline.matter.points import build_matter
from gsfluent.pipeline.simulate.engine import SolverOptions
from gsfluent.pipeline.simulate.run import Run
from gsfluent.scene.scene import Scene

PAGE = Path(__file__).resolve().parents[2] / "docs" / "measured" / "blades.md"
DROPS = {"drop from 2 cm": 0.02, "drop from 50 cm": 0.5}
CUTS = {"thin blade": 0.0, "blade of 1 cm": 0.01}
COMPOSED = ", step by step"
LENGTH = 0.25
"""Of the melon [m]."""


def measured(
    case: str, material: str, cells: int, seconds: float, fps: float = 30.0
) -> dict[str, Any]:
    """Simulate one case, and what it took."""
    scene = Scene()
    scene.add(melon(3000, 64), material, name="melon")
    name = case.removesuffix(COMPOSED)
    if name in DROPS:
        scene.drop(DROPS[name])
    else:
        scene.blade(
            [(0, 0, 0.23), (0, 0, -0.01)], width=0.4, edge=(0, 1, 0), speed=2.0, at=0.02,
            thickness=CUTS[name],
        )  # fmt: skip
    matter = build_matter(scene, LENGTH / cells)
    run = Run(scene, matter, fps, SolverOptions(resident=name == case))
    begun = time.process_time()
    for frame in range(1, round(seconds * fps) + 1):
        if not run.advance_to(frame, None):
            break
        run.record(frame)
    spent = time.process_time() - begun
    report = run.report()
    return {
        "case": case,
        "material": material,
        "points": matter.particles.count,
        "cpu_s": spent,
        "steps": report["substeps"],
        "rollbacks": report["rollbacks"],
        "pieces": report["per_frame"]["pieces"][-1],
        "verdict": report["verdict"],
    }


def table(rows: list[dict[str, Any]]) -> str:
    """Times, and their ratio to each drop of the same material."""
    heads = ["material", "case", "points", "CPU [s]", "steps", "roll-backs", "pieces", "verdict"]
    heads += [f"times a {name}" for name in DROPS]
    lines = ["| " + " | ".join(heads) + " |", "|" + " --- |" * len(heads)]
    for row in rows:
        drops = {
            other["case"]: other["cpu_s"] for other in rows if other["material"] == row["material"]
        }
        cells = [row["material"], row["case"], str(row["points"]), f"{row['cpu_s']:.1f}"]
        cells += [str(row[key]) for key in ("steps", "rollbacks", "pieces", "verdict")]
        cells += [f"{row['cpu_s'] / drops[name]:.2f}" for name in DROPS]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cells", type=int, default=22, help="along the melon")
    parser.add_argument("--seconds", type=float, default=0.8, help="simulated")
    parser.add_argument("--materials", nargs="+", default=["fruit.watermelon", "bread"])
    parser.add_argument("--composed", action="store_true", help="the reference, too; slow")
    parser.add_argument("--out", type=Path, help="JSON lines")
    parser.add_argument("--write", action="store_true", help="enter the table into the page")
    args = parser.parse_args()
    torch.set_num_threads(1)
    cases = [*DROPS, *CUTS]
    if args.composed:
        cases += [name + COMPOSED for name in CUTS]
    rows = []
    measured("drop from 2 cm", args.materials[0], 8, 0.05)  # what the first run loads costs no drop
    for material in args.materials:
        for case in cases:
            rows.append(measured(case, material, args.cells, args.seconds))
            print(json.dumps(rows[-1]), flush=True)
    if args.out is not None:
        with atomic_path(args.out) as path:
            path.write_text("".join(json.dumps(row) + "\n" for row in rows), encoding="utf-8")
    print(table(rows))
    if args.write:
        text = enter(PAGE.read_text(encoding="utf-8"), "blades", table(rows))
        with atomic_path(PAGE) as path:
            path.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
