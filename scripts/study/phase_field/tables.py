"""Tables and the picture of docs/measured/phase_field.md."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from struck import apart

from gsfluent.figure.markdown import enter
from gsfluent.io.atomic import atomic_path

ROOT = Path(__file__).resolve().parents[3]
PICTURES = {  # of each, tests and a word in the name of the run
    "phase_field_cracks.jpg": (("branching", ""), ("pmma", "2.6")),
    "phase_field_loads.jpg": (
        ("kalthoff", "spectral_at1"), ("notch", "strength"), ("bending", "toughness"),
    ),
}  # fmt: skip
"""In docs/images; drawn anew where all of its runs are there."""
Found = Mapping[str, Any]
HEADINGS = {
    "pmma": (
        "## PMMA\n\n"
        "Bleyer et al. 2017: a strip of 32 x 16 mm, notch of 4 mm, held stretched; branches "
        "from a release of about 2 $G_c$, at l 0.1 mm. l is 2 cells."
    ),
    "notch": (
        "## A notched square\n\n"
        "Miehe et al. 2010: 1 mm, E 210 GPa, $G_c$ 2700 J/m², l 0.015 mm, AT2. Reference: "
        "0.701 kN/mm at 5.55 um. The last word says what the grid keeps: with `toughness` the "
        "solver works with a reduced $G_c$, so that a long crack costs $G_c$; with `strength` "
        "it works with $G_c$."
    ),
    "cost": (
        "## What a step takes\n\n"
        "A bar three times as long as wide, that trembles, or whose halves are pulled apart, by "
        "both laws in turn; `cost.py`. Bars: 1.02 before, 1.3 meanwhile.\n"
        "A crack's blocks and those around are five blocks wide: at 53 thousand points nine tenths "
        "of them give to the field, so that the bar is met by larger bodies only."
    ),
    "bending": (
        "## Three-point bending\n\n"
        "Miehe et al. 2010: 8 x 2 mm, notch of 0.4 mm, E 20.8 GPa, $G_c$ 500 J/m², l 0.06 mm, "
        "AT2. Reference: finite elements of our own (`elements.py`), bilinear, quasi-static, with "
        "the notch and the bars of each grid."
    ),
    "compact": (
        "## Compact compression\n\n"
        "Rittel and Maigre 1996: PMMA, one arm struck at 20 m/s; the sizes are remembered. The "
        "crack turns back towards the loaded side (directions above 90 degrees). Reference: the "
        "path of the finest grid at the widest l; bar 2 mm, which half the cells miss by 0.8 mm. "
        "A shorter l turns further back."
    ),
    "floor": (
        "## Twenty thousand steps\n\n"
        "A ball of 12 cells thrown at a quarter of its wave speed, without gravity, and one that "
        "falls and rests. Energies over that at the start."
    ),
    "plan": "## Every row of the plan\n\nHeld by a test, or measured above.",
    "melon": (
        "## A melon on three grids\n\n"
        "`fruit.watermelon`, l 25 mm on every grid, `prefer: strength`. Pieces after 40 ms."
    ),
}
"""What stands above the tables that the page has not yet."""
GONE = 1.5
"""Reach of a crack that has crossed the strip [heights]."""
KEYS = {"strip": 2, "pmma": 2, "cost": 3, "melon": 3}
"""Cells of a table that say what a row is of, if not the first alone."""
UNKNOWN = "not run yet"


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = ["| " + " | ".join(head) + " |", "|" + " --- |" * len(head)]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows])


def _mean(values: Sequence[float]) -> str:
    kept = [v for v in values if math.isfinite(v)]
    if not kept:
        return ""
    spread = f" ({min(kept):.2f} to {max(kept):.2f})" if len(kept) > 1 else ""
    return f"{sum(kept) / len(kept):.2f}{spread}"


def strip(found: Sequence[Found]) -> str:
    """Of each resolution and release: how far the crack ran, what it cost, how fast."""
    rows = []
    for cells, release in sorted({(f["cells"], f["release"]) for f in found}):
        mine = [f for f in found if (f["cells"], f["release"]) == (cells, release)]
        ran = sum(f["reach"] > GONE for f in mine)
        rows.append(
            (
                f"{cells:g} dx", f"{release:g}", f"{ran} of {len(mine)}",
                _mean([f["reach"] for f in mine]),
                _mean([f.get("surface", math.nan) for f in mine]),
                _mean([f.get("speed", math.nan) for f in mine]),
            )
        )  # fmt: skip
    head = (
        "l", "release over Gc", "crossed the strip", "reach [heights]",
        "surface energy per area over Gc", "speed over c_R",
    )  # fmt: skip
    return _table(head, rows)


def branching(found: Sequence[Found]) -> str:
    """The forking crack."""
    head = (
        "l", "points", "cracks behind the fork", "fork at [mm]", "at [us]", "fastest tip over c_R",
        "mirror [dx]", "surface energy [J/m]", "kinetic [J/m]", "gone [J/m]", "s",
    )  # fmt: skip
    return _table(
        head,
        (
            (
                f["setting"], str(f["points"]), f"{f['cracks']:g}", f"{f['fork'] * 1e3:.1f}",
                f"{f['when'] * 1e6:.0f}", f"{f['speed']:.2f}", f"{f['off']:.1f}",
                f"{f['surface'] / f['dx']:.3f}", f"{f['kinetic'] / f['dx']:.3f}",
                f"{f['gone'] / f['dx']:.3f}", f"{f['wall']:.0f}",
            )
            for f in found
        ),
    )  # fmt: skip


def peak(found: Sequence[Found], force: float | None, way: float | None) -> str:
    """A largest force and where it is, beside a reference [kN/mm], [um]."""
    rows = []
    for f in found:
        off = f"{f['off']:.1f}" if math.isfinite(f["off"]) else ""
        each = [f["setting"], f"{f['force']:.4f}", f"{f['moved']:.2f}"]
        for value, known in ((f["force"], force), (f["moved"], way)):
            each.append("" if known is None else f"{100.0 * (value / known - 1.0):+.1f} %")
        rows.append((*each, off, f"{f['wall']:.0f}"))
    head = (
        "l, kept", "largest force [kN/mm]", "at [um]", "force over reference",
        "way over reference", "off the line [dx]", "s",
    )  # fmt: skip
    return _table(head, rows)


def pmma(found: Sequence[Found]) -> str:
    """Where the strip of PMMA branches."""
    rows = (
        (
            f["setting"], f"{f['release']:g}", f"{f['share']:.2f}", f"{f['speed']:.2f}",
            f"{f['wall']:.0f}",
        )
        for f in sorted(found, key=lambda f: (-float(f["dx"]), float(f["release"])))
    )  # fmt: skip
    head = ("l", "release over Gc", "share of the way with branches", "fastest tip over c_R", "s")
    return _table(head, rows)


def kalthoff(found: Sequence[Found]) -> str:
    """Direction of Kalthoff's crack."""
    rows = (
        (
            f["setting"], f"{f['angle']:.1f}", f"{f['median']:.1f}", f"{f['length']:.0f}",
            f"{f['when']:.0f}", f"{f['wall']:.0f}",
        )
        for f in sorted(found, key=lambda f: (f["split"], f["model"], int(f["points"])))
        if f["length"]
    )  # fmt: skip
    head = (
        "side, l, split, model", "direction of the end [degrees]", "along the path",
        "length [mm]", "broken from [us]", "s",
    )  # fmt: skip
    return _table(head, rows)


def _elements_of(beam: Found, own: Sequence[Found]) -> Found | None:
    """Finite elements with the notch and the bars of the grid of a beam."""
    return next((f for f in own if math.isclose(f["of"], beam["dx"], rel_tol=1e-6)), None)


def bending(found: Sequence[Found], own: Sequence[Found]) -> str:
    """Largest force of each beam beside that of finite elements with its notch and bars."""
    rows = []
    for f in sorted(found, key=lambda f: -float(f["dx"])):
        known = _elements_of(f, own)
        if known is None:
            continue
        off = [f"{100.0 * (f[key] / known[key] - 1.0):+.1f} %" for key in ("force", "moved")]
        rows.append(
            (
                f["setting"], known["setting"], f"{known['force']:.4f}", f"{known['moved']:.1f}",
                f"{f['force']:.4f}", f"{f['moved']:.1f}", *off, f"{f['wall']:.0f}",
            )
        )  # fmt: skip
    head = (
        "l, kept", "reference", "its largest force [kN/mm]", "at [um]", "largest force [kN/mm]",
        "at [um]", "force over reference", "way over reference", "s",
    )  # fmt: skip
    return _table(head, rows)


def compact(found: Sequence[Found]) -> str:
    """Where the crack of the compact specimen goes."""
    finest = max(found, key=lambda f: (f["length_mm"], f["points"]))
    line = np.array(finest["path"]) / 1e3
    rows = (
        (
            f["setting"], f"{f['first']:.0f}", f"{f['angle']:.0f}", f"{f['length']:.0f}",
            f"{f['when']:.0f}", f"{1e3 * apart(np.array(f['path']) / 1e3, line):.1f}",
        )
        for f in found
    )  # fmt: skip
    head = (
        "dx, l", "first direction [degrees]", "direction of the end", "length [mm]",
        "broken from [us]", "off the finest of the widest l [mm]",
    )  # fmt: skip
    return _table(head, rows)


def floor(found: Sequence[Found]) -> str:
    """Balls over many steps."""
    rows = (
        (
            f["name"], str(f["points"]), f"{f['steps']:,}", f"{100.0 * f['broken']:.0f} %",
            f"{f['momentum']:.1e}", f"{f['gained']:.1e}", f"{f['kept']:.3f}",
            "yes" if f["same"] else "no",
        )
        for f in found
    )  # fmt: skip
    head = (
        "ball", "points", "steps", "broken", "momentum that nothing gave", "energy gained",
        "energy left", "same bits in another order",
    )  # fmt: skip
    return _table(head, rows)


def melon(found: Sequence[Found]) -> str:
    """Pieces of melons over the grid."""
    rows = []

    def of(f: Found) -> tuple[str, float, int]:
        return f.get("split", "spectral"), f["height"], f["cells"]

    for split, height, cells in sorted({of(f) for f in found}):
        mine = [f for f in found if of(f) == (split, height, cells)]
        clean = [f for f in mine if f["verdict"] == "clean"]
        pieces = [float(f.get("first", f)["pieces"]) for f in clean]
        spread = float(np.std(pieces)) if pieces else math.nan
        rows.append(
            (
                split, f"{height:g} m", str(cells), f"{len(clean)} of {len(mine)}",
                f"{np.mean(pieces):.1f}" if pieces else "", f"{spread:.1f}",
                *(
                    _mean([(f.get("first", f) if early else f)[name] for f in clean])
                    for name in ("largest", "broken")
                    for early in (True, False)
                ),
            )
        )  # fmt: skip
    head = (
        "split", "height", "cells", "clean", "pieces over 3 %", "+-", "largest after 40 ms",
        "at the end", "broken after 40 ms", "at the end",
    )  # fmt: skip
    return _table(head, rows)


def cost(found: Sequence[Found]) -> str:
    """What a step takes beside one of NACC."""
    rows = (
        (
            f["machine"], f"{row['points']:,}", "while it cracks" if row["pulled"] else "before",
            f"{row['ms']['nacc']:.3f}", f"{row['ms']['phase_field']:.3f}", f"{row['ratio']:.2f}",
            f"{100.0 * row['broken']['phase_field']:.1f} %",
        )
        for f in found
        for row in f["rows"]
    )  # fmt: skip
    head = ("on", "points", "when", "NACC [ms]", "phase field [ms]", "ratio", "broken")
    return _table(head, rows)


def picture(out: Path, names: Sequence[tuple[str, str]], to: Path) -> None:
    """Damage at the end of the named jobs, side by side."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, len(names), figsize=(4 * len(names), 3.2), squeeze=False)
    for axis in axes.flat:
        axis.set_axis_off()
    for axis, (name, said) in zip(axes.flat, names, strict=True):
        with np.load(out / f"{name}.npz") as data:
            x, damage = 1e3 * data["x"], data["damage"]
        order = np.argsort(damage, kind="stable")
        axis.scatter(*x[order].T, c=damage[order], s=0.15, cmap="inferno", vmin=0, vmax=255)
        axis.set_aspect("equal")
        axis.set_title(said, fontsize=9)
    figure.tight_layout()
    with atomic_path(to) as path:
        figure.savefig(path, dpi=80, format="jpg", pil_kwargs={"quality": 80})
    pyplot.close(figure)


TESTS = "`tests/ops/test_phase_field.py`"
PLAN = (  # row, bar, where it is held or measured
    ("one point", "1e-10", f"held by {TESTS}"),
    ("bar stretched slowly, l 4 dx", "2 % of its strength", f"held by {TESTS}, AT1 and AT2"),
    ("profile and energy of a crack", "rms 0.05; 3 %", f"held by {TESTS}"),
    ("crack pressed shut", "1 %", f"held by {TESTS}"),
    ("CPU, reference; gradients", "1e-10; 1e-6", f"held by {TESTS}"),
    ("GPU", "1e-10", "held by `tests/ops/test_phase_field_cuda.py`"),
    ("prestrained strip", "energy per area 0.9 to 1.1", "held at a release of 1.1"),
    ("notched square", "5 % in force and way", "held with `strength`"),
    ("branching", "two branches, 0.75 c_R", "held"),
    ("branching, energy", "3 %", "missed: 6 to 9 % of the kinetic energy is gone"),
    ("PMMA strip", "branches at 1.6 to 2.6 Gc", "held"),
    ("Kalthoff and Winkler", "60 to 72 degrees", "held by `spectral`"),
)


def plan(found: Mapping[str, Found], whole: bool) -> str:
    """Every row of "Tests and bars" of the specification, and what became of it.

    Args:
        found: What the jobs found.
        whole: With the rows of which nothing was found.
    """

    def of(test: str) -> list[Found]:
        return [f for f in found.values() if f["test"] == test]

    rows = list(PLAN)
    beams, own = of("bending"), of("elements")
    finest = min(beams, key=lambda f: float(f["dx"]), default=None)
    known = None if finest is None else _elements_of(finest, own)
    off = abs(finest["force"] / known["force"] - 1.0) if finest and known else math.nan
    rows.append(("three-point bending", "5 %", _met(off, 0.05, f"{100.0 * off:.0f} % off")))
    plates = [f for f in of("compact") if f.get("split") == "rankine"]
    gap = math.nan
    if len(plates) > 1:
        finest = max(plates, key=lambda f: (f["length_mm"], f["points"]))
        line = np.array(finest["path"]) / 1e3
        gap = 1e3 * max(apart(np.array(f["path"]) / 1e3, line) for f in plates if f is not finest)
    rows.append(("compact compression, by `rankine`", "2 mm", _met(gap, 2.0, f"{gap:.1f} mm")))
    balls = of("floor")
    worst = max((max(f["momentum"], f["gained"]) for f in balls), default=math.nan)
    worst = worst if all(f["same"] for f in balls) else math.inf
    rows.append(("balls, 20 000 steps", "1e-6, same bits", _met(worst, 1e-6, f"{worst:.1e}")))
    melons = [f for f in of("melon") if "first" in f and f["height"] == 0.6]
    means = [
        float(np.mean([f["first"]["pieces"] for f in melons if f["cells"] == cells]))
        for cells in {f["cells"] for f in melons}
    ]
    off = max(means) / min(means) - 1.0 if len(means) > 2 else math.nan
    rows.append(("melon at 20, 30, 40 cells", "25 %", _met(off, 0.25, f"{100.0 * off:.0f} %")))
    rows = [row for row in rows if whole or row[2] != UNKNOWN]
    return _table(("row", "bar", "found"), rows)


def _met(value: float, bar: float, told: str) -> str:
    """Whether a figure holds its bar, in words."""
    if math.isnan(value):
        return UNKNOWN
    return f"{'held' if value <= bar else 'missed'}: {told}"


def enter_page(found: Mapping[str, Found], out: Path, page: Path) -> None:
    """Write every table for which there are figures, and the picture.

    Rows of the page stay that ``found`` has not.
    """
    text = page.read_text(encoding="utf-8")

    def of(test: str) -> list[Found]:
        return [f for f in found.values() if f["test"] == test]

    parts = {
        "strip": strip, "branching": branching, "pmma": pmma, "kalthoff": kalthoff,
        "notch": lambda rows: peak(rows, 0.701, 5.55),
        "bending": lambda rows: bending(rows, of("elements")), "cost": cost,
        "compact": compact, "floor": floor, "melon": melon,
    }  # fmt: skip
    for test, table in parts.items():
        if rows := of(test):
            head = HEADINGS.get(test, "")
            text = enter(text, f"phase_field_{test}", table(rows), head, KEYS.get(test, 1))
    begun = "<!-- phase_field_plan: begin -->" in text
    text = enter(text, "phase_field_plan", plan(found, not begun), HEADINGS["plan"], 1)
    for file, shown in PICTURES.items():
        names = []
        for test, word in shown:
            mine = [
                n for n, f in found.items()
                if f["test"] == test and word in n and (out / f"{n}.npz").is_file()
            ]  # fmt: skip
            if mine:  # the finest
                best = max(mine, key=lambda n: int(found[n]["points"]))
                names.append((best, f"{test}, {found[best]['setting']}"))
        if len(names) == len(shown):
            picture(out, names, ROOT / "docs" / "images" / file)
    with atomic_path(page) as path:
        path.write_text(text, encoding="utf-8")
