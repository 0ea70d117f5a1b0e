"""A melon that falls, by both yield surfaces and several fracture energies.

    python scripts/study/surface/melon.py --law rankine --energy 60 100 --cells 20,40 --height 2
    python scripts/study/surface/melon.py --only-table

The melon of ``fracture_resolution.py``; its rind has the same fracture energy. One JSON line per
fall; what is there is not run again. The table is entered into the page of the resolution.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from fracture_resolution import LINES, MELON, PAGE, Trial, exponent, run_trial
from rows import Row, add_law, append, law_of, numbers, preset_of, put, read, table

from gsfluent.lab.charts.record import commit, machine
from gsfluent.materials import Material

OUT = LINES.with_name("fracture_surface.jsonl")


@dataclasses.dataclass(frozen=True)
class Melon(Trial):
    """The melon with a fracture energy [J/m^2] of its own; 0: that of its preset."""

    energy: float = 0.0

    @property
    def matter(self) -> Material:
        """What it is made of."""
        plain = preset_of(self.material, self.law)
        if not self.energy:
            return plain
        parts = tuple({**part, "fracture_energy": self.energy} for part in plain.parts)
        return plain.override(fracture_energy=self.energy, parts=parts)


def page(rows: list[Row]) -> None:
    """Enter the table, and with which power of dx the broken volume falls."""
    head = (
        "law", "G_c J/m^2", "from m", "cells", "loose", "pieces over 1 %", "largest", "broken",
        "blocks / intact",
    )  # fmt: skip
    keys = ("law", "gc", "height", "cells")
    lines, said = [], []
    for kind, group in itertools.groupby(
        sorted(rows, key=lambda r: [r[k] for k in keys]), key=lambda r: [r[k] for k in keys[:3]]
    ):
        mine = list(group)
        for r in mine:
            lines.append([
                r["law"], f"{r['gc']:g}", f"{r['height']:g}", str(r["cells"]),
                f"{100.0 * r['loose']:.2g} %", str(r["pieces_over_1_percent"]),
                f"{r['largest']:.2f}", f"{r['broken']:.3f}", f"{r['blocks']:.2f}",
            ])  # fmt: skip
        if len(mine) > 1:
            over = exponent(
                [{"dx": 1.0 / r["cells"], "broken": r["broken"]} for r in mine], "broken"
            )
            said.append(f"{kind[0]} {kind[1]:g}: {over:.2f}")
    words = f"Power of dx with which what breaks falls: {'; '.join(said)}."
    devices = ", ".join(sorted({r["device"] for r in rows}))
    text = f"{table(head, lines)}\n\n{words} Devices: {devices}."
    put(PAGE, "fracture resolution surfaces", text)


def main(argv: list[str] | None = None) -> int:
    """Parse the command line and run it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add_law(parser)
    parser.add_argument("--energy", type=float, nargs="+", default=[0.0], help="[J/m^2]")
    parser.add_argument("--cells", type=numbers, default=(12, 16, 20))
    parser.add_argument("--height", type=float, nargs="+", default=[2.0], help="[m]")
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("-o", "--out", type=Path, default=OUT)
    parser.add_argument("--only-table", action="store_true", help="run nothing")
    args = parser.parse_args(argv)
    kinds = itertools.product(args.energy, args.height, args.cells)
    for energy, height, cells in () if args.only_table else kinds:
        given = {f.name: getattr(MELON, f.name) for f in dataclasses.fields(MELON)}
        trial = Melon(**{**given, "height": height, "law": args.law, "energy": energy})
        key = {
            "law": law_of(trial.matter), "gc": float(trial.matter.fracture_energy or 0.0),
            "cells": cells, "height": height, "device": args.device,
        }  # fmt: skip
        if any(r.items() >= key.items() for r in read(args.out)):
            continue
        row = run_trial(trial, cells, 0, args.device)
        row["blocks"] = row["blocks"] / row["blocks_intact"]
        row = {**key, "machine": machine(args.device), "commit": commit(), **row}
        sys.stderr.write(f"{json.dumps(row)}\n")
        append(args.out, row)
    if args.out == OUT:
        page(read(args.out))
    return 0


if __name__ == "__main__":
    sys.exit(main())
