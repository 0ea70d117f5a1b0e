"""How gsfluent's error falls with dx on the cases of motion, and how good their references are.

    python scripts/fracturebench/ladder.py [--device cuda] [--page FILE] [NAME ...]

Every case of elastic bodies and of contact over its ladder of dx (float32, CFL 0.5, eight points
per cell). The order is the slope of the error over the three finest; both tables are entered into
docs/measured/fracturebench.md. Half a minute on one quiet core.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from pathlib import Path

import numpy as np

from gsfluent.figure.markdown import enter
from gsfluent.fracturebench import registry
from gsfluent.fracturebench.registry import Case, cases, find, judge
from gsfluent.fracturebench.scene import SceneError
from gsfluent.lab.frozen.answer import run_case

ROOT = Path(__file__).resolve().parents[2]
REFERENCES = Path(registry.__file__).parent / "data" / "references.json"
ROUNDING = 1e-5
"""An error below it is that of float32, and has no order."""


def order(dx: list[float], errors: list[float]) -> float:
    """Slope of log error over log dx at the three finest; NaN where it means nothing."""
    x, y = np.array(dx[-3:]), np.array(errors[-3:])
    if len(x) < 2 or not np.isfinite(y).all() or (y < ROUNDING).any():
        return math.nan
    return float(np.polyfit(np.log(x), np.log(y), 1)[0])


def row(case: Case, device: str) -> str:
    """Errors of a case from coarse to fine, as a row."""
    errors, cells = [], []
    for dx in case.ladder:
        scene = case.build(dx, 8)
        errors.append(judge(scene, run_case(scene, device=device))[0].error)
        cells.append(f"{errors[-1]:.2g} ({scene.count})")
        sys.stderr.write(f"{case.name}, dx {dx:.4g}: {errors[-1]:.3g}\n")
    slope = order(list(case.ladder), errors)
    said = "exact" if max(errors) < ROUNDING else "-" if math.isnan(slope) else f"{slope:.1f}"
    return f"| {case.name} | {', '.join(cells)} | {said} |"


def references() -> str:
    """Orders and errors of the finite elements."""
    known = json.loads(REFERENCES.read_text(encoding="utf-8"))
    lines = ["| reference | order | error left, relative rms |", "|---|---|---|"]
    for name in ("collide", "drop"):
        lines.append(f"| {name} | {known[name]['order']} | {known[name]['error']} |")
    slow = known["hertz"]
    force = ", ".join(
        f"{f:.2f} at {s:g} c" for s, f in zip(slow["speeds"], slow["force_over_hertz"], strict=True)
    )
    law = known["laws"]
    lines += [
        "",
        f"Largest force of an impact over Hertz's: {force}. The fixed corotated law instead of the "
        f"neo-Hookean changes the first measure of collide by {law['collide']:.2g} and that of "
        f"drop by {law['drop']:.2g}.",
    ]
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--references", action="store_true", help="only the table of references")
    parser.add_argument("names", nargs="*", metavar="NAME", help="cases; default all of motion")
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument(
        "--page", type=Path, default=ROOT / "docs" / "measured" / "fracturebench.md", metavar="FILE"
    )
    args = parser.parse_args()
    try:
        chosen = [find(n) for n in args.names] or [c for c in cases() if c.kind != "fracture"]
        lines = ["| case | error (points), coarse to fine | order |", "|---|---|---|"]
        text = args.page.read_text(encoding="utf-8") if args.page.is_file() else ""
        if not args.references:
            lines += [row(case, args.device) for case in chosen]
            text = enter(text, "fracturebench_ladder", "\n".join(lines), "## Convergence")
        text = enter(text, "fracturebench_references", references(), "## References")
        temporary = args.page.with_name(args.page.name + ".tmp")
        temporary.write_text(text, encoding="utf-8")
        temporary.replace(args.page)
    except (SceneError, OSError) as error:
        sys.stderr.write(f"ladder.py: {error}\n")
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
