"""How a body that lands whole rebounds, on grids from 12 to 32 cells, against the literature.

python scripts/study/restitution.py                   # twenty minutes of one core; resumable
python scripts/study/restitution.py --only apple --cells 12 16    # some of it

Balls as in ``drop_heights.py``, with the stiffness of the preset and the real one. One JSON line
per body, stiffness and grid; what is there is not run again. What the literature says stands in
``docs/measured/data/restitution.toml``.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
import tomllib
from pathlib import Path
from typing import Any

from drop_heights import DATA, STIFFNESS, Case, Drop, name_of, records
from drop_shapes import ball
from rows import add_law, law_of, preset_of

from gsfluent.figure.markdown import enter

PAGE = DATA.parent / "restitution.md"
CELLS = (12, 16, 24, 32)
TRAVERSALS = 60.0
"""How long a landing is followed, in traversals of the body by the wave."""
GOOD, SAME = 0.15, 0.1
"""Distance from the literature that counts as right, and between grids that counts as the same."""


def study(
    name: str, given: dict[str, Any], how: str, cells: int, device: str, law: str
) -> dict[str, Any]:  # fmt: skip
    """The record of one landing."""
    fruit = given["preset"].startswith("fruit.")
    case = Case(name, ball(given["diameter_m"]), float(cells), TRAVERSALS, fruit=fruit)
    drop = Drop(case, {"preset": given["preset"]}, how, device, False, law)
    drop.fall([(given["height_m"], 0)], 1e9)
    fall = drop.falls[0]
    return {
        "object": name, "law": law_of(drop.material), "stiffness": how, "cells": cells,
        "height": given["height_m"], "restitution": fall.restitution, "left": fall.left,
        "broken": fall.broken, "ever": fall.ever, "shaking": fall.shaking,
        "verdict": drop.verdicts[0], "softening": drop.material.softening, "steps": drop.steps,
        "seconds": drop.seconds, "device": name_of(device),
    }  # fmt: skip


def table(rows: list[dict[str, Any]], literature: dict[str, dict[str, Any]]) -> str:
    """Markdown: every body and stiffness, over the grids."""
    head = ("body", "law", "stiffness", "height m", "literature", *(f"{n} cells" for n in CELLS),
            "between grids", "farthest off")  # fmt: skip
    lines = [f"| {' | '.join(head)} |", f"|{' --- |' * len(head)}"]
    right = same = count = 0
    laws = sorted({r["law"] for r in rows})
    for name, given in literature.items():
        for how, law in itertools.product(STIFFNESS, laws):
            kind = {"object": name, "stiffness": how, "law": law}
            found = {r["cells"]: r for r in rows if r.items() >= kind.items()}
            if not found:
                continue
            speeds = [r["restitution"] for r in found.values() if r["left"]]
            spread = max(speeds) - min(speeds)
            off = max(speeds, key=lambda e: abs(e - given["restitution"])) - given["restitution"]
            count += 1
            same += spread <= SAME
            right += abs(off) <= GOOD
            soft = next(iter(found.values()))["softening"]
            cells = [
                name, law, "real" if soft == 1.0 else f"1/{soft:g}", f"{given['height_m']:g}",
                f"{given['restitution']:g}",
                *(f"{found[n]['restitution']:.2f}" if n in found else "-" for n in CELLS),
                f"{spread:.2f}", f"{off:+.2f}",
            ]  # fmt: skip
            lines.append(f"| {' | '.join(cells)} |")
    clean = sum(r["verdict"] == "clean" for r in rows)
    devices = ", ".join(sorted({r["device"] for r in rows}))
    said = (
        f"Within {GOOD} of the literature on every grid: {right} of {count}; grids within {SAME} "
        f"of each other: {same} of {count}; without a step taken back: {clean} of {len(rows)} "
        f"landings. {devices}."
    )
    lines += ["", said]
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    literature = tomllib.loads((DATA / "restitution.toml").read_text(encoding="utf-8"))
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", nargs="+", choices=list(literature), default=list(literature))
    parser.add_argument("--cells", nargs="+", type=int, choices=CELLS, default=list(CELLS))
    add_law(parser)
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("-o", "--output", type=Path, default=DATA / "restitution.jsonl")
    parser.add_argument("--markdown", type=Path, default=PAGE, help="page to enter the table into")
    parser.add_argument("--only-table", action="store_true", help="run nothing")
    options = parser.parse_args(arguments)
    keys = ("object", "law", "stiffness", "cells")
    done = {tuple(r[k] for k in keys) for r in records(options.output)}
    breaks_by = {
        name: law_of(preset_of(literature[name]["preset"], options.law)) for name in options.only
    }
    wanted = [
        (name, how, cells) for cells in options.cells for how in STIFFNESS for name in options.only
        if (name, breaks_by[name], how, cells) not in done and not options.only_table
    ]  # fmt: skip
    options.output.parent.mkdir(parents=True, exist_ok=True)
    for name, how, cells in wanted:
        row = study(name, literature[name], how, cells, options.device, options.law)
        with options.output.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")
        sys.stdout.write(
            f"{name} {how} {cells}: {row['restitution']:.3f}, {row['seconds']:.0f} s\n"
        )
        sys.stdout.flush()
    page = options.markdown
    text = page.read_text(encoding="utf-8") if page.is_file() else ""
    page.write_text(enter(text, "restitution", table(records(options.output), literature)), "utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
