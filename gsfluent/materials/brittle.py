"""Presets that break (law nacc) or never do (law elastic).

Explicit time steps cost one wave transit per cell, so a solid at its true stiffness (glass: 5400
m/s) would need a million steps per second. Stiff presets are therefore softened by a factor that
``sources`` states. Strength of a brittle preset is a strain, so the landing speed at which it
breaks is ``wave_speed * failure_strain`` of the softened solid.
"""

from __future__ import annotations

from gsfluent.materials.material import Material
from gsfluent.materials.sources import DENSITY, POISSON, softened

_RIND = {
    "name": "rind",
    "where": {"depth_below": 0.0175},
    "young_modulus": 9.6e5,
    "cohesion": 0.015,
    "hardening": 2.33,
    "alpha0": -0.21,
}
_PEEL = {"name": "peel", "where": {"depth_below": 0.004}, "cohesion": 0.12, "young_modulus": 5e5}

BRITTLE = (
    Material(
        "fruit.watermelon",
        4e5,
        0.32,
        950.0,
        cohesion=0.095,
        hardening=4.65,
        friction_angle=60.0,
        alpha0=-0.105,
        shear_damage=0.025,
        variation=0.35,
        parts=(_RIND,),
        sources={"density": DENSITY + ", a melon just floats"},
    ),
    Material(
        "fruit.apple",
        2.5e5,
        0.35,
        840.0,
        cohesion=0.1,
        hardening=5.0,
        friction_angle=60.0,
        alpha0=-0.1,
        shear_damage=0.025,
        variation=0.3,
        grain=0.008,
        sources={
            "density": DENSITY + ", an apple floats with a sixth above water",
            "young_modulus": softened(3e6, 12, "apple flesh"),
        },
    ),
    Material(
        "fruit.orange",
        2e5,
        0.4,
        950.0,
        cohesion=0.1,
        hardening=5.0,
        friction_angle=60.0,
        alpha0=-0.1,
        shear_damage=0.025,
        variation=0.3,
        grain=0.008,
        parts=(_PEEL,),
        sources={"density": DENSITY},
    ),
    Material("fruit.pumpkin", 6e5, 0.35, 800.0, cohesion=0.15, hardening=10.0, alpha0=-0.06),
    Material(
        "glass",
        7e7,
        0.22,
        2500.0,
        cohesion=0.05,
        hardening=10.0,
        alpha0=-0.03,
        friction_angle=60.0,
        sources={
            "young_modulus": softened(7e10, 1000, "soda-lime glass"),
            "density": DENSITY,
            "poisson_ratio": POISSON,
        },
    ),
    Material(
        "ceramic",
        6e7,
        0.22,
        2400.0,
        cohesion=0.06,
        hardening=10.0,
        alpha0=-0.03,
        friction_angle=60.0,
        sources={
            "young_modulus": softened(6e10, 1000, "porcelain"),
            "density": DENSITY,
            "poisson_ratio": POISSON,
        },
    ),
    Material(
        "bone",
        1.7e7,
        0.3,
        1900.0,
        cohesion=0.2,
        hardening=10.0,
        alpha0=-0.04,
        friction_angle=50.0,
        sources={
            "young_modulus": softened(1.7e10, 1000, "cortical bone"),
            "density": DENSITY,
            "poisson_ratio": POISSON,
        },
    ),
    Material(
        "chocolate",
        1e7,
        0.35,
        1300.0,
        cohesion=0.08,
        hardening=10.0,
        alpha0=-0.03,
        friction_angle=50.0,
        sources={"density": DENSITY},
    ),
    Material(
        "bread",
        3e4,
        0.1,
        250.0,
        cohesion=0.5,
        hardening=3.0,
        alpha0=-0.15,
        sources={"density": DENSITY + " of a white loaf"},
    ),
    Material("jelly", 3e4, 0.45, 1000.0, law="elastic", sources={"density": DENSITY + " of water"}),
    Material("plush", 2e4, 0.2, 150.0, law="elastic"),
    Material(
        "rubber",
        1e6,
        0.45,
        1100.0,
        law="elastic",
        sources={
            "young_modulus": "measured: handbook, soft rubber 1 to 5 MPa",
            "density": DENSITY,
            "poisson_ratio": "derived: rubber has 0.49 or above; 0.45 slows the pressure wave",
        },
    ),
    Material("elastic", 1e5, 0.3, 1000.0, law="elastic"),
)
