"""Which parameters a law reads, their ranges and defaults, and the row it hands to the ops."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

LAWS = {
    "elastic": 0,
    "nacc": 1,
    "drucker_prager": 2,
    "von_mises": 3,
    "fluid": 4,
    "rigid": 5,
    "corotated": 6,
    "yeoh": 7,
    "ogden": 8,
    "phase_field": 9,
}
"""Constitutive laws and their numbers in :func:`gsfluent.ops.return_mapping`."""

RANGES: dict[str, tuple[float, float, str]] = {
    "young_modulus": (0.0, math.inf, "Pa"),
    "poisson_ratio": (-0.99, 0.495, "no unit"),
    "density": (0.0, math.inf, "kg/m^3"),
    "cohesion": (0.0, 1e3, "no unit"),
    "hardening": (0.0, 1e3, "no unit"),
    "friction_angle": (0.0, 89.0, "degrees"),
    "alpha0": (-10.0, 0.5, "no unit"),
    "shear_damage": (0.0, 10.0, "no unit"),
    "yield_stress": (0.0, math.inf, "Pa"),
    "hardening_modulus": (-math.inf, math.inf, "Pa"),
    "plastic_viscosity": (0.0, math.inf, "Pa s"),
    "hardening_exponent": (0.0, 1.0, "no unit"),
    "rate_sensitivity": (0.0, 1.0, "no unit"),
    "melting_heat": (0.0, math.inf, "J/m^3"),
    "cohesion_pressure": (0.0, math.inf, "Pa"),
    "bulk_modulus": (0.0, math.inf, "Pa"),
    "viscosity": (0.0, math.inf, "Pa s"),
    "tait_exponent": (1.0, 20.0, "no unit"),
    "tensile_strength": (0.0, math.inf, "Pa"),
    "compressive_strength": (0.0, math.inf, "Pa"),
    "fracture_energy": (0.0, math.inf, "J/m^2"),
    "yeoh_c20": (-math.inf, math.inf, "Pa"),
    "yeoh_c30": (0.0, math.inf, "Pa"),
    "ogden_alpha1": (-20.0, 20.0, "no unit"),
    "ogden_mu2": (-math.inf, math.inf, "Pa"),
    "ogden_alpha2": (-20.0, 20.0, "no unit"),
    "ogden_mu3": (-math.inf, math.inf, "Pa"),
    "ogden_alpha3": (-20.0, 20.0, "no unit"),
    "toughness": (0.0, math.inf, "J/m^2"),
    "length": (0.0, math.inf, "m"),
    "relaxation_share": (0.0, 0.99, "no unit"),
    "relaxation_time": (0.0, math.inf, "s"),
    "yield_time": (0.0, math.inf, "s"),
}
"""Parameter -> lowest value, highest value, unit."""

POSITIVE = (
    "young_modulus", "density", "grain", "bulk_modulus", "reference_volume", "softening",
    "tensile_strength", "compressive_strength", "fracture_energy", "toughness", "length",
    "relaxation_time", "yield_time",
)  # fmt: skip
"""Parameters that must be above their lowest value."""

WORDS: dict[str, tuple[str, ...]] = {
    "law": tuple(LAWS),
    "prefer": ("toughness", "strength"),
    "surface": ("cam_clay", "rankine"),
    "hysteresis": ("pressed", "both", "unloading"),
    "split": ("volumetric", "none", "spectral", "rankine"),
    "model": ("at1", "at2"),
}
"""What of a material is a word, and which words there are."""

HANDBOOK = ("tensile_strength", "compressive_strength", "fracture_energy")
"""What fixes cohesion, hardening and alpha0 of nacc matter on a grid, all three together."""
DERIVED = ("cohesion", "hardening", "alpha0")
"""What they fix; given by hand, each takes the place of what would be derived."""

BREAKS = ("nacc", "phase_field")
"""Laws of matter that can break."""

PARAMETERS = tuple(RANGES)
"""The fields of a material that may vary in space."""

RELAXATION = ("relaxation_share", "relaxation_time")
"""What makes matter relax, both together or not at all."""

JOHNSON_COOK = ("hardening_exponent", "rate_sensitivity", "melting_heat")
"""What makes metal harden by a power and by its rate, and soften by its own heat."""

_SOLID = ("young_modulus", "poisson_ratio", "density")
READS: dict[str, tuple[str, ...]] = {
    "elastic": (*_SOLID, *RELAXATION),
    "corotated": _SOLID,
    "nacc": (
        *_SOLID,
        "cohesion",
        "hardening",
        "friction_angle",
        "alpha0",
        "shear_damage",
        *HANDBOOK,
        *RELAXATION,
        "yield_time",
    ),
    "drucker_prager": (*_SOLID, "friction_angle", "cohesion_pressure"),
    "von_mises": (
        *_SOLID,
        "yield_stress",
        "hardening_modulus",
        "plastic_viscosity",
        *JOHNSON_COOK,
    ),
    "fluid": ("bulk_modulus", "density", "viscosity", "tait_exponent"),
    "rigid": ("density",),
    "yeoh": (*_SOLID, "yeoh_c20", "yeoh_c30"),
    "ogden": (
        *_SOLID,
        "ogden_alpha1",
        "ogden_mu2",
        "ogden_alpha2",
        "ogden_mu3",
        "ogden_alpha3",
    ),
    "phase_field": (*_SOLID, "toughness", "length", "tensile_strength"),
}
"""Law -> the parameters it reads; any other is refused, because it would do nothing."""

OPTIONAL = {
    "elastic": RELAXATION,
    "nacc": (*RELAXATION, "yield_time"),
    "phase_field": ("length", "tensile_strength"),
}
"""Law -> parameters that may be left out: the grid finds them, or it is not viscous."""

DEFAULTS: dict[str, dict[str, float]] = {
    "nacc": {
        "cohesion": 0.6,
        "hardening": 3.0,
        "friction_angle": 45.0,
        "alpha0": -0.04,
        "shear_damage": 0.0,
    },
    "drucker_prager": {"friction_angle": 35.0, "cohesion_pressure": 0.0},
    "von_mises": {
        "hardening_modulus": 0.0,
        "plastic_viscosity": 0.0,
        **dict.fromkeys(JOHNSON_COOK, 0.0),
    },
    "fluid": {"viscosity": 0.0, "tait_exponent": 7.0},
    "ogden": {"ogden_mu2": 0.0, "ogden_alpha2": 2.0, "ogden_mu3": 0.0, "ogden_alpha3": 2.0},
}
"""Law -> parameters that may be left out, and their values then."""


def unstable(law: str, row: Tensor) -> str:
    """What of a row of parameters [..., 8] would make matter that pushes itself apart, or ""."""
    mu, _, strength, cohesion, hardening, damage, _, exponent = row.unbind(dim=-1)
    if law == "von_mises" and bool((hardening <= -3.0 * mu).any()):
        return "hardening_modulus must be above -3 times the shear modulus"
    if law == "von_mises" and bool(((exponent > 0.0) & (hardening < 0.0)).any()):
        return "hardening_modulus must not be below 0 with an exponent, a rate or a heat"
    if law == "yeoh":
        falls = (strength < 0.0) & (8.0 * strength**2 >= 12.0 * mu * cohesion)
        if bool(falls.any()):
            return (
                "yeoh_c20 is so far below 0 that the modulus falls to nothing: its square must "
                "be below 1.5 times the shear modulus times yeoh_c30"
            )
    if law == "ogden":
        rest = cohesion * hardening, damage * exponent
        if bool((rest[0] < 0.0).any() or (rest[1] < 0.0).any()):
            return "ogden_mu2 and ogden_alpha2, and ogden_mu3 and ogden_alpha3, must have one sign"
        if bool((strength == 0.0).any()):
            return "ogden_alpha1 must not be 0"
        if bool((rest[0] + rest[1] >= 2.0 * mu).any()):
            return "the terms of ogden_mu2 and ogden_mu3 must leave some of the shear modulus"
    return ""


def row(law: str, at: Callable[[str], Tensor]) -> Tensor:
    """Return the columns of ``params`` for a law, [..., 8], float64.

    Args:
        law: Name of the law.
        at: Parameter name -> its values (any shape that broadcasts).

    Columns: see :func:`gsfluent.ops.return_mapping`.
    """
    density = at("density")
    zero = torch.zeros_like(density)
    mu, kappa, strength, cohesion, hardening, damage, exponent = (zero,) * 7
    if law == "fluid":
        kappa, strength, exponent = at("bulk_modulus"), at("viscosity"), at("tait_exponent")
    elif law != "rigid":
        young, nu = at("young_modulus"), at("poisson_ratio")
        mu, kappa = young / (2.0 * (1.0 + nu)), young / (3.0 * (1.0 - 2.0 * nu))
    if law in ("nacc", "drucker_prager"):
        sine = torch.sin(torch.deg2rad(at("friction_angle")))
        slope = 6.0 * sine / (3.0 - sine)  # q = M p
    if law == "nacc":
        strength, cohesion = slope, at("cohesion")
        hardening, damage = at("hardening"), at("shear_damage")  # -c of Rankine's surface
        exponent = 1.0 - at("restitution") ** 2  # of the energy, csrc/core/material/loss.h
    elif law == "drucker_prager":
        # |dev tau| = sqrt(2/3) q = 3 alpha_DP p
        strength, cohesion = math.sqrt(2.0 / 27.0) * slope, at("cohesion_pressure")
    elif law == "phase_field":  # threshold, length and code: materials.phase_field
        strength, hardening, damage = at("threshold"), at("length"), at("code")
        exponent = 1.0 - at("restitution") ** 2
    elif law == "von_mises":
        strength, hardening = at("yield_stress"), at("hardening_modulus")
        power, heat = at("hardening_exponent"), at("melting_heat")
        cohesion = at("rate_sensitivity")
        # a rate or heat of linear hardening is that of the exponent 1
        exponent = torch.where((power == 0.0) & ((cohesion > 0.0) | (heat > 0.0)), 1.0, power)
        damage = torch.where(exponent > 0.0, heat, at("plastic_viscosity"))
    elif law == "yeoh":
        strength, cohesion = at("yeoh_c20"), at("yeoh_c30")
    elif law == "ogden":
        strength, cohesion, hardening = at("ogden_alpha1"), at("ogden_mu2"), at("ogden_alpha2")
        damage, exponent = at("ogden_mu3"), at("ogden_alpha3")
    columns = (mu, kappa, strength, cohesion, hardening, damage, density, exponent)
    return torch.stack(torch.broadcast_tensors(*columns), dim=-1)
