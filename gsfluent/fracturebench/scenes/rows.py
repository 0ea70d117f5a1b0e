"""Brittle materials of the fracture cases: what a row holds, and what it means without NACC.

A row of law ``nacc`` is that of non-associative Cam-Clay (Wolper et al. 2019, CD-MPM) with an
elliptic yield surface in pressure p (positive in compression) and shear stress q:
``q^2 (1 + 2 beta) + M^2 (p + beta p0)(p - p0) = 0`` with ``p0 = kappa sinh(xi max(-alpha, 0))``, at
most 0.495 kappa.

================== =================================================================================
``friction``       M, slope of the critical state line
``cohesion``       beta: the surface reaches into tension to ``p = -beta p0``
``hardening``      xi
``alpha``          log plastic volume ratio at the start; negative is intact. Plastic volume raises
                   it, and at 0 the strength is gone: damage is ``1 - max(alpha) / alpha(0)``
``yield_time``     where there is one, the time T [s] that a yield takes (Duvaut and Lions 1976): a
                   state x beyond the surface falls to its return x' by ``-(x - x') / T``, so that
                   strength grows with the rate; without one at once
================== =================================================================================

For another damage model the same rows say what to calibrate to:

=================== ================================================================================
``tensile_strength`` axial stress at which straining along one axis, the others held, leaves the
                     elastic range [Pa]
``uniaxial_strain``  the strain at which it does
``fracture_energy``  that a crack takes per area [J/m^2]; the crack band keeps it on every grid
                     (``xi`` and ``alpha`` change with the node spacing, strength does not)
``mode_one_toughness`` K_Ic of plane strain, ``sqrt(E G / (1 - nu^2))`` [Pa m^0.5]
=================== ================================================================================
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..run import Run
from ..scene import Floats, Ints, Scene, SceneError, wave_speed
from ..shapes import elastic

BAND_CELLS = 2.0
"""Width of the narrowest crack that a grid of quadratic splines can show [dx]."""
BROKEN = 0.999
"""Damage from which a point counts as broken."""
P0_CAP = 0.495
"""Largest p0 over kappa: beyond half of it no volume would give the pressure."""


def moduli(row: dict[str, Any]) -> tuple[float, float]:
    """Shear and bulk modulus [Pa]."""
    young, nu = float(row["young_modulus"]), float(row["poisson_ratio"])
    return young / (2.0 * (1.0 + nu)), young / (3.0 * (1.0 - 2.0 * nu))


def _facts(row: dict[str, Any], density: float) -> dict[str, Any]:
    """The row with what it means for other damage models; ``density`` is the energy's [J/m^3]."""
    mu, kappa = moduli(row)
    slope, beta = float(row["friction"]), float(row["cohesion"])
    p0 = kappa * min(1e-5 + math.sinh(-float(row["hardening"]) * float(row["alpha"])), P0_CAP)
    # with p = -kappa e and q = 2 mu e the yield condition is quadratic in the strain e
    a = 4.0 * mu * mu * (1.0 + 2.0 * beta) + (slope * kappa) ** 2
    b = slope * slope * kappa * p0 * (1.0 - beta)
    c = -slope * slope * beta * p0 * p0
    strain = (-b + math.sqrt(b * b - 4.0 * a * c)) / (2.0 * a)
    young, nu = float(row["young_modulus"]), float(row["poisson_ratio"])
    energy = BAND_CELLS * density
    return row | {
        "tensile_strength": (kappa + 4.0 / 3.0 * mu) * strain,
        "uniaxial_strain": strain,
        "fracture_energy": energy,
        "mode_one_toughness": math.sqrt(young * energy / (1.0 - nu * nu)),
    }


def brittle(
    young: float,
    poisson: float,
    density: float,
    *,
    friction: float,
    cohesion: float,
    strength: float,
    softening: float,
    energy: float,
    dx: float,
    reference: float,
    shear_damage: float = 0.0,
) -> dict[str, Any]:
    """Row of a brittle material whose cracks take the same energy on every grid.

    Args:
        young: Young's modulus [Pa].
        poisson: Poisson's ratio.
        density: [kg/m^3].
        friction: M.
        cohesion: beta.
        strength: ``p0 / kappa`` when intact.
        softening: -alpha at the start on the reference grid.
        energy: Energy density of softening over ``kappa softening strength``, a number of the
            order of beta that depends on the shape of the surface (measured on one point).
        dx: Node spacing of the scene [m].
        reference: Node spacing that ``softening`` belongs to [m].
        shear_damage: Softening per plastic shear.
    """
    scale = reference / dx
    row = elastic(young, poisson, density) | {
        "law": "nacc", "friction": friction, "cohesion": cohesion, "shear_damage": shear_damage,
        "hardening": math.asinh(strength) / (softening * scale), "alpha": -softening * scale,
    }  # fmt: skip
    per_volume = energy * moduli(row)[1] * softening * scale * strength
    return _facts(row, per_volume * dx)


def scattered(row: dict[str, Any], factor: float) -> dict[str, Any]:
    """The row with alpha at the start, and so strength and softening, times a factor."""
    changed = {**row, "alpha": float(row["alpha"]) * factor}
    return _facts(changed, float(row["fracture_energy"]) / BAND_CELLS * factor * factor)


def levels(
    row: dict[str, Any], factor: Floats, count: int = 16
) -> tuple[tuple[dict[str, Any], ...], Ints]:
    """Rows of a material whose strength scatters, and the row of each point.

    Strength is given in ``count`` steps, so that a row of ``materials`` holds all a point needs.

    Args:
        row: Of factor 1.
        factor: Strength of each point over that of the row, [N].
        count: Rows.
    """
    low, high = float(factor.min()), float(factor.max())
    if high - low < 1e-12:
        return (scattered(row, low),), np.zeros(factor.shape[0], np.int32)
    edge = (high - low) / count
    index = np.minimum((factor - low) / edge, count - 1).astype(np.int32)
    return tuple(scattered(row, low + (i + 0.5) * edge) for i in range(count)), index


def shape_noise(x: Floats, length: float, seed: int, waves: int = 24) -> Floats:
    """Smooth noise fixed to the body, of mean 0 and variance 1 in the large, [N].

    A sum of plane waves of random direction, so that it is the same at every resolution.
    """
    generator = np.random.default_rng(seed)
    k = generator.normal(size=(waves, 3))
    k *= 2.0 * math.pi / length / np.linalg.norm(k, axis=1, keepdims=True)
    phase = generator.random(waves) * 2.0 * math.pi
    return math.sqrt(2.0 / waves) * np.cos(x @ k.T + phase).sum(axis=1)


def uneven(
    x: Floats, length: float, dx: float, reference: float
) -> tuple[tuple[dict[str, Any], ...], Ints, float]:
    """Rows of a soft brittle solid whose strength varies by a half, of each point, and its speed.

    Args:
        x: Places in the body [m], [N, 3].
        length: Over which strength varies [m].
        dx: Node spacing of the scene [m].
        reference: Node spacing that its softening belongs to [m].
    """
    row = brittle(
        1e6, 0.2, 1000.0, friction=2.4, cohesion=0.1, strength=0.49, softening=0.05,
        energy=0.088, shear_damage=0.025, dx=dx, reference=reference,
    )  # fmt: skip
    factor = np.clip(1.0 + 0.5 * shape_noise(x, length, 3), 0.3, 1.7)
    return *levels(row, factor), wave_speed(row)


def damage_of(scene: Scene, run: Run) -> Floats:
    """Damage that a run handed in, [T, N].

    Raises:
        SceneError: It did not, or not in the shape of the scene.
    """
    if run.damage is None:
        raise SceneError(
            f"{run.method}, {scene.name}: this case is judged by damage; hand in `damage`, 0 "
            "intact to 1 broken, for every time and point"
        )
    if run.damage.shape != (scene.times.shape[0], scene.count):
        raise SceneError(
            f"{run.method}, {scene.name}: damage has shape {run.damage.shape}, the scene asks for "
            f"{(scene.times.shape[0], scene.count)} (times, points)"
        )
    return run.damage
