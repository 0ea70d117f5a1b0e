"""More presets that break (law nacc): building materials, ice, wood, foam.

Explicit time steps cost one wave transit per cell, so a solid at its true stiffness (glass: 5400
m/s) would need a million steps per second. Stiff presets are therefore softened by a factor that
``sources`` states. Strength of a brittle preset is a strain, so the landing speed at which it
breaks is ``wave_speed * failure_strain`` of the softened solid.
"""

from __future__ import annotations

from gsfluent.materials.material import Material
from gsfluent.materials.sources import DENSITY, POISSON, softened

HARD = (
    Material(
        "concrete",
        3.3e7,
        0.2,
        2400.0,
        cohesion=0.08,
        hardening=10.0,
        alpha0=-0.03,
        friction_angle=55.0,
        variation=0.2,
        grain=0.02,
        sources={
            "young_modulus": softened(3.3e10, 1000, "concrete C30/37 (EN 1992-1-1, table 3.1)"),
            "poisson_ratio": "measured: EN 1992-1-1, 3.1.3",
            "density": "measured: EN 1991-1-1, table A.1",
            "cohesion": "derived: 2.9 MPa in tension to 38 MPa in compression (EN 1992-1-1)",
            "grain": "derived: size of the aggregate",
        },
    ),
    Material(
        "rock",
        5e7,
        0.25,
        2650.0,
        cohesion=0.07,
        hardening=10.0,
        alpha0=-0.03,
        friction_angle=58.0,
        variation=0.2,
        grain=0.02,
        sources={
            "young_modulus": softened(5e10, 1000, "granite"),
            "poisson_ratio": POISSON + " of granite",
            "density": DENSITY + " of granite",
        },
    ),
    Material(
        "ice",
        1.86e7,
        0.33,
        917.0,
        cohesion=0.05,
        hardening=10.0,
        alpha0=-0.03,
        friction_angle=50.0,
        variation=0.2,
        grain=0.01,
        sources={
            "young_modulus": softened(9.3e9, 500, "polycrystalline ice"),
            "poisson_ratio": POISSON,
            "density": DENSITY + " at 0 C",
        },
    ),
    Material(
        "wood",
        1.1e7,
        0.35,
        450.0,
        cohesion=0.3,
        hardening=10.0,
        alpha0=-0.03,
        friction_angle=45.0,
        variation=0.3,
        grain=0.01,
        sources={
            "young_modulus": softened(1.1e10, 1000, "spruce along the grain; here all directions"),
            "density": DENSITY + " of dry spruce",
        },
    ),
    Material(
        "plaster",
        3e7,
        0.2,
        1000.0,
        cohesion=0.06,
        hardening=10.0,
        alpha0=-0.03,
        friction_angle=55.0,
        variation=0.15,
        sources={
            "young_modulus": softened(3e9, 100, "set gypsum plaster"),
            "density": DENSITY + " of set gypsum plaster",
        },
    ),
    Material(
        "foam",
        1e5,
        0.1,
        25.0,
        cohesion=0.5,
        hardening=6.0,
        alpha0=-0.05,
        friction_angle=30.0,
        variation=0.1,
        sources={
            "young_modulus": softened(5e6, 50, "expanded polystyrene"),
            "poisson_ratio": "measured: expanded polystyrene 0.1",
            "density": DENSITY + " of packing polystyrene",
        },
    ),
    Material(
        "snow",
        1.4e5,
        0.2,
        400.0,
        cohesion=0.05,
        hardening=10.0,
        alpha0=-0.02,
        friction_angle=40.0,
        variation=0.3,
        sources={
            "young_modulus": "measured: value of Stomakhin et al. 2013 for packed snow",
            "poisson_ratio": "measured: value of Stomakhin et al. 2013",
            "density": "measured: value of Stomakhin et al. 2013 for packed snow",
        },
    ),
)
