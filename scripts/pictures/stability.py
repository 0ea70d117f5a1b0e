"""Enter recorded stability maps into docs/measured/stability.md and draw its pictures.

python scripts/pictures/stability.py docs/measured/data/stability_*.jsonl
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from gsfluent.figure.map import Plane, draw_planes
from gsfluent.figure.markdown import enter
from gsfluent.lab.stability import maps as stability
from gsfluent.lab.stability import report as stability_report
from gsfluent.lab.stability import run as running
from gsfluent.lab.stability.peers import marks, measured

ROOT = Path(__file__).resolve().parents[2]
# rows of maps whose panels fit beside each other
SHEETS = {
    "steps": (("speed", "ratios"), ("stiffness_speed", "points_per_cell"),
              ("poisson", "fragments", "gradient_limit")),
    "matter": (("fields", "early_contact"), ("impact", "softening"), ("centre", "return_map"),
               ("order",)),
    "numbers": (("precision", "creep"), ("storage", "transfer", "zero_weight", "kernel"),
                ("released", "loose")),
}  # fmt: skip
COLUMNS = 4
# what, the specification's measured limit (solver.md), map, variant, other axis
LIMITS = (
    ("bulk, 8 points per cell", "1.3", "points_per_cell", 1, 8.0),
    ("bulk, 1 point per cell", "1.0", "points_per_cell", 1, 1.0),
    ("free cube, nu 0.3", "1.0", "poisson", 0, 0.3),
    ("free cube, nu 0.45", "0.9", "poisson", 0, 0.45),
    ("one point alone", "0.7", "fragments", 0, 1.0),
    ("clusters of 2", "0.7", "fragments", 0, 2.0),
    ("clusters of 8", "0.7", "fragments", 0, 8.0),
)


def markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(c.replace("|", "\\|") for c in row) + " |" for row in lines)


def limits(maps: dict[str, stability.Map], points: Sequence[stability.Point]) -> str:
    """Stable Courant numbers beside the specification's."""
    rows = []
    for what, wanted, name, variant, at in LIMITS:
        m = maps[name]
        own = {
            float(p.x): p.holds
            for p in points
            if p.map == name and p.variant == m.variants[variant] and p.y == at
        }
        broken = [x for x in sorted(own) if not own[x]]
        fails = broken[0] if broken else float("inf")
        holds = max((x for x in own if x < fails), default=0.0)
        rows.append((what, wanted, f"{holds:g}", f"{fails:g}", f"{name}, {m.variants[variant]}"))
    return markdown(("stable c dt / dx", "specification", "holds", "fails", "map"), rows)


def compared(maps: Sequence[stability.Map], points: Sequence[stability.Point]) -> str:
    """Points of two devices beside each other."""
    by: dict[str, dict[str, stability.Point]] = {}
    for p in points:
        by.setdefault(p.device, {})[p.key.rsplit("|", 1)[0]] = p
    if len(by) < 2:
        return "Only one device is recorded."
    cpu, cuda = by["cpu"], by["cuda"]
    rows = []
    for m in maps:
        keys = [k for k in cuda if k.startswith(m.name + "|") and k in cpu]
        if not keys:
            continue
        same = sum(cuda[k].holds == cpu[k].holds for k in keys)
        step = sum(cuda[k].step == cpu[k].step for k in keys)
        seconds = sum(cuda[k].seconds for k in keys)
        rows.append((m.name, str(len(keys)), str(same), str(step), f"{seconds:.1f}"))
    head = ("map", "points on both", "same verdict", "same step", "GPU seconds")
    wrong = stability_report.verdict(maps, list(cuda.values()))
    said = "; ".join(wrong) if wrong else "inside with margin at every point run"
    where = ", ".join(sorted({p.machine for p in cuda.values()}))
    return f"{len(cuda)} points on {where}; the defaults: {said}.\n\n" + markdown(head, rows)


def main() -> int:
    """Draw and enter."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("lines", nargs="+", type=Path)
    parser.add_argument("--page", type=Path, default=ROOT / "docs" / "measured" / "stability.md")
    parser.add_argument("--images", type=Path, default=ROOT / "docs" / "images")
    parser.add_argument(
        "--peers", type=Path, default=ROOT / "docs" / "measured" / "data" / "peers_failures.json"
    )
    given = parser.parse_args()
    programs = measured(given.peers) if given.peers.is_file() else []
    points = [p for path in given.lines for p in stability.read(path)]
    known = running.all_maps()
    cpu = [p for p in points if p.device == "cpu"] or points
    maps = [m for m in known.values() if any(p.map == m.name for p in cpu)]
    for sheet, rows in SHEETS.items():
        panels: list[Plane | None] = []
        for names in rows:
            line = [
                plane
                for name in names
                for plane in stability_report.planes(known[name], cpu, marks(maps, programs))
            ]
            panels += [*line, *[None] * (COLUMNS - len(line))] if line else []
        if panels:
            path = given.images / f"stability_{sheet}.png"
            draw_planes(
                panels, path, kinds=stability_report.LETTER_WORDS, columns=COLUMNS, dpi=78,
                cell=(0.21, 0.17),
            )  # fmt: skip
            sys.stdout.write(f"{path}: {path.stat().st_size // 1000} kB\n")
    wrong = stability_report.verdict(maps, cpu)
    seconds = sum(p.seconds for p in cpu)
    machine = ", ".join(sorted({p.machine for p in cpu}))
    text = (
        f"{len(cpu)} points of {len(maps)} maps, {seconds:.0f} s of computing on {machine}, "
        f"{sum(p.holds for p in cpu)} held. "
        + ("Every default is inside, settings with a margin of 1.2 or more (within the spans named "
           "under Margins)."
           if not wrong else "NOT inside with margin: " + "; ".join(wrong) + ".")
    )  # fmt: skip
    tests = [
        (*r, f"`{known[r[0]].test}`") for r in stability_report.table(maps, cpu)
    ]  # fmt: skip
    named = [line for m in maps for line in stability_report.named(m, cpu, marks(maps, programs))]
    others = [
        (m.name, variant, f"{failed} of {count}")
        for m in maps
        for variant, failed, count in stability_report.others(m, cpu)
    ]
    page = given.page.read_text(encoding="utf-8")
    page = enter(page, "verdict", text)
    page = enter(page, "limits", limits(known, cpu))
    page = enter(page, "margins", markdown((*stability_report.HEAD, "test"), tests))
    page = enter(
        page, "programs",
        markdown(
            ("map", "program", "what", "seen", "right", "fails"),
            [(m.map, m.peer, m.what + (f"; {m.note}" if m.note else ""),
              "-" if "signal" in m.note else f"{m.seen:.3g}",
              f"{m.right:.3g}", "yes" if m.failed else "no") for m in programs],
        ),
    )  # fmt: skip
    page = enter(page, "named", "\n".join(f"* {line}" for line in named))
    page = enter(
        page, "variants", markdown(("map", "variant", "fails where gsfluent holds"), others)
    )
    page = enter(page, "devices", compared(maps, points))
    given.page.write_text(page, encoding="utf-8")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
