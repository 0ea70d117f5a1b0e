"""Write the tables of presets into docs/measured/materials.md, from the code.

python scripts/study/materials.py
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

from gsfluent.figure.markdown import enter
from gsfluent.materials import Material, get, names

PAGE = Path(__file__).resolve().parents[2] / "docs" / "measured" / "materials.md"
_COLUMNS = {
    "young_modulus": "E [Pa]",
    "poisson_ratio": "nu",
    "density": "density [kg/m^3]",
}
_SHORT = {
    "cohesion": "beta",
    "hardening": "xi",
    "friction_angle": "phi",
    "alpha0": "alpha0",
    "shear_damage": "eta",
    "yield_stress": "yield",
    "hardening_modulus": "H",
    "cohesion_pressure": "c",
    "bulk_modulus": "K",
    "viscosity": "viscosity",
    "tait_exponent": "gamma",
}


def numbers() -> str:
    """Markdown: every preset with its numbers, wave speed and the speed at which it breaks."""
    head = ["preset", "law", *_COLUMNS.values(), "the law's own", "wave m/s", "breaks at m/s"]
    rows = [f"| {' | '.join(head)} |", f"|{' --- |' * len(head)}"]
    for name in names():
        m = get(name)
        solid = [_number(m, field) for field in _COLUMNS]
        own = ", ".join(f"{_SHORT[f]} {_number(m, f)}" for f in m.reads if f in _SHORT)
        if m.variation:
            own += f", variation {m.variation:g} over {m.grain:g} m"
        speed = m.wave_speed
        breaks = speed * m.failure_strain
        last = f"{breaks:.2g}" if math.isfinite(breaks) else "-"
        cells = [f"`{name}`", m.law, *solid, own or "-", f"{speed:.3g}", last]
        rows.append(f"| {' | '.join(cells)} |")
    return "\n".join(rows) + "\n"


def sources() -> str:
    """Markdown: where the numbers of every preset are from; fields left out are chosen by eye."""
    rows = ["| preset | number | source |", "| --- | --- | --- |"]
    for name in names():
        m = get(name)
        named = [f for f in m.reads if m.source(f) != "chosen by eye"]
        named += [f for f in ("variation", "grain") if m.source(f) != "chosen by eye"]
        for field in named:
            rows.append(f"| `{name}` | {field} | {m.source(field)} |")
        guessed = [f for f in m.reads if f not in named]
        if guessed:
            rows.append(f"| `{name}` | {', '.join(guessed)} | chosen by eye |")
    return "\n".join(rows) + "\n"


def _number(material: Material, field: str) -> str:
    value = getattr(material, field)
    return "-" if value is None else f"{float(value):g}"


def filled(text: str) -> str:
    """Return the page with its tables renewed."""
    for name, made in (("numbers", numbers()), ("sources", sources())):
        text = enter(text, name, made.rstrip(), f"## {name.capitalize()}")
    return text


def main() -> int:
    PAGE.write_text(filled(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
