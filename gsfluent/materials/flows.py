"""Presets that flow: grains (drucker_prager), metals and clay (von_mises), liquids (fluid).

What is softened, and by how much, is in ``sources``; see :mod:`gsfluent.materials.brittle`.
"""

from __future__ import annotations

from gsfluent.materials.material import Material
from gsfluent.materials.sources import DENSITY, POISSON, compressible, softened, softened_yield

GRAINS = (
    Material(
        "sand",
        1e6,
        0.3,
        1600.0,
        law="drucker_prager",
        friction_angle=34.0,
        sources={
            "young_modulus": softened(2e7, 20, "loose sand"),
            "poisson_ratio": "measured: handbook, loose sand 0.3",
            "density": DENSITY + " of dry loose quartz sand",
            "friction_angle": "measured: angle of repose of dry quartz sand, 30 to 35 degrees",
        },
    ),
    Material(
        "gravel",
        2e6,
        0.25,
        1700.0,
        law="drucker_prager",
        friction_angle=40.0,
        sources={
            "young_modulus": softened(1e8, 50, "loose gravel"),
            "density": DENSITY + " of loose gravel",
            "friction_angle": "measured: angle of repose of crushed gravel, about 40 degrees",
        },
    ),
    Material(
        "soil",
        5e5,
        0.3,
        1500.0,
        law="drucker_prager",
        friction_angle=30.0,
        cohesion_pressure=1500.0,
        sources={
            "density": DENSITY + " of moist topsoil",
            "friction_angle": "measured: handbook, loam 25 to 32 degrees",
        },
    ),
)

METALS = (
    Material(
        "steel",
        2.1e8,
        0.3,
        7850.0,
        law="von_mises",
        yield_stress=7.4e6,
        hardening_modulus=2e6,
        sources={
            "young_modulus": softened(2.1e11, 1000, "structural steel (EN 1993-1-1, 3.2.6)"),
            "poisson_ratio": "measured: EN 1993-1-1, 3.2.6",
            "density": "measured: EN 1991-1-1, table A.4",
            "yield_stress": softened_yield(2.35e8, 1000, "steel S235 (EN 1993-1-1, table 3.1)"),
        },
    ),
    Material(
        "aluminium",
        7e7,
        0.33,
        2700.0,
        law="von_mises",
        yield_stress=3.5e6,
        hardening_modulus=1e6,
        sources={
            "young_modulus": softened(7e10, 1000, "aluminium"),
            "poisson_ratio": POISSON,
            "density": DENSITY,
            "yield_stress": softened_yield(1.1e8, 1000, "half-hard aluminium sheet"),
        },
    ),
    Material(
        "copper",
        1.17e8,
        0.35,
        8930.0,
        law="von_mises",
        yield_stress=1.26e7,
        hardening_modulus=3.2e6,
        sources={
            "young_modulus": softened(1.17e11, 1000, "copper of the Taylor bar benchmark"),
            "poisson_ratio": "measured: copper of the Taylor bar benchmark",
            "density": DENSITY,
            "yield_stress": softened_yield(4e8, 1000, "copper of the Taylor bar benchmark"),
            "hardening_modulus": "derived: 1e8 Pa of the Taylor bar benchmark, divided as the yield"
            " stress",
        },
    ),
    Material(
        "plasticine",
        2e6,
        0.42,
        1750.0,
        law="von_mises",
        yield_stress=6e4,
        sources={"density": DENSITY + " of plasticine, 1600 to 1800"},
    ),
    Material(
        "clay",
        1e6,
        0.42,
        1900.0,
        law="von_mises",
        yield_stress=1.5e4,
        sources={"density": DENSITY + " of wet potter's clay"},
    ),
)

LIQUIDS = (
    Material(
        "water",
        density=998.0,
        law="fluid",
        bulk_modulus=9e5,
        viscosity=1.0e-3,
        sources={
            "density": "measured: water at 20 C",
            "viscosity": "measured: water at 20 C",
            "bulk_modulus": compressible(30),
            "tait_exponent": "measured: Tait's equation of water (Monaghan 1994)",
        },
    ),
    Material(
        "milk",
        density=1030.0,
        law="fluid",
        bulk_modulus=9.3e5,
        viscosity=2.0e-3,
        sources={
            "density": DENSITY + " of whole milk",
            "viscosity": "measured: handbook, whole milk at 20 C",
            "bulk_modulus": compressible(30),
        },
    ),
    Material(
        "oil",
        density=915.0,
        law="fluid",
        bulk_modulus=8.2e5,
        viscosity=0.084,
        sources={
            "density": DENSITY + " of olive oil",
            "viscosity": "measured: handbook, olive oil at 20 C",
            "bulk_modulus": compressible(30),
        },
    ),
    Material(
        "honey",
        density=1420.0,
        law="fluid",
        bulk_modulus=1.3e6,
        viscosity=10.0,
        sources={
            "density": DENSITY + " of honey",
            "viscosity": "measured: handbook, honey at 20 C is 2 to 20 Pa s, by kind",
            "bulk_modulus": compressible(30),
        },
    ),
)
