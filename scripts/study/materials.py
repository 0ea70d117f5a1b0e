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
    "tensile_strength": "tensile",
    "compressive_strength": "compressive",
    "fracture_energy": "G_c",
    "toughness": "G_c",
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
_WHOLE = ("softening", "restitution", "dust")
_WEAK = ("variation", "weibull_modulus", "reference_volume", "grain")


def numbers() -> str:
    """Markdown: every preset with its numbers, wave speed and the speed at which it breaks.

    Stiffness and strengths are those of the real thing, speeds those of the softened one.
    """
    head = ["preset", "law", *_COLUMNS.values(), "the law's own", "Weibull", "softening"]
    head += ["restitution", "dust", "wave m/s", "breaks at m/s"]
    rows = [f"| {' | '.join(head)} |", f"|{' --- |' * len(head)}"]
    for name in names():
        m = get(name)
        solid = [_number(m, field) for field in _COLUMNS]
        shown = [f for f in m.reads if f in _SHORT and getattr(m, f) is not None]
        own = ", ".join(f"{_SHORT[f]} {_number(m, f)}" for f in shown)
        if m.variation:
            own += f", variation {m.variation:g} over {m.grain:g} m"
        brittle = m.law == "nacc"
        weak = f"{m.weibull_modulus:g} at {m.reference_volume:g} m^3, grain {m.grain:g} m"
        whole = [_number(m, field) if brittle else "-" for field in _WHOLE]
        speed, breaks = m.wave_speed, m.breaking_speed
        last = f"{breaks:.2g}" if math.isfinite(breaks) else "-"
        cells = [f"`{name}`", m.law, *solid, own or "-", weak if m.weibull_modulus else "-"]
        cells += [*whole, f"{speed:.3g}", last]
        rows.append(f"| {' | '.join(cells)} |")
    return "\n".join(rows) + "\n"


def sources() -> str:
    """Markdown: where the numbers of every preset are from; fields left out are chosen by eye."""
    rows = ["| preset | number | source |", "| --- | --- | --- |"]
    for name in names():
        m = get(name)
        given = [f for f in m.reads if getattr(m, f) is not None]
        if m.law == "nacc":
            weak = [f for f in _WEAK[1:] if m.weibull_modulus] or ["variation", "grain"]
            given += [*(f for f in weak if m.weibull_modulus or m.variation), *_WHOLE]
        named = [f for f in given if f in m.sources]
        named += [f for f in m.sources if f not in given]  # of its parts
        for field in named:
            rows.append(f"| `{name}` | {field} | {m.sources[field]} |")
        guessed = [f for f in given if f not in named]
        if guessed:
            rows.append(f"| `{name}` | {', '.join(guessed)} | chosen by eye |")
    return "\n".join(rows) + "\n"


def _number(material: Material, field: str) -> str:
    value = getattr(material, field)
    if value is not None and field == "young_modulus":
        value = value * material.softening
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
