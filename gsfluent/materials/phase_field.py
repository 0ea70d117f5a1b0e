"""Length and threshold of phase-field matter on a grid, from what handbooks give.

AT1 is strongest at ``sqrt(3 E Gc / (8 l))``, AT2 at ``(9/16) sqrt(E Gc / (3 l))`` (Tanne et al.
2018): toughness and strength fix the length. A grid holds no length below two cells; there one of
the two gives way (:attr:`Material.prefer`). docs/theory/phase-field.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from gsfluent.errors import InputError
from gsfluent.materials import laws

CELLS = 2.0
"""Least length in cells."""
C0 = {"at1": 8.0 / 3.0, "at2": 2.0}
GRID_ENERGY = {"at1": 0.90, "at2": 1.20}
"""A crack on nodes takes ``1 + this dx / l`` of the toughness that the solver works with: measured
with jittered points as bodies are sampled, mean over its places (docs/theory/phase-field.md)."""
STEP = 0.04
"""Steps of the logarithm of strength in which it varies from place to place."""
SIZE = {"at1": 3.0 / 8.0, "at2": 27.0 / 256.0}
"""l is this times ``E Gc / strength^2``."""
SPLITS = {"volumetric": 0, "none": 1, "spectral": 2, "rankine": 3}
MODELS = {"at1": 0, "at2": 4}
"""Their sum is the column ``shear_damage`` of a row."""


def columns(
    material: Any, at: Callable[[Any], Tensor], dx: float, weakness: Tensor | float = 1.0
) -> dict[str, Tensor]:
    """Threshold [J/m^3], length [m] and code of a material on a grid.

    Args:
        material: Of law ``phase_field``.
        at: Turns a parameter into its values at the points.
        dx: Node spacing [m]; 0 for no grid, where the length is a metre if nothing gives it.
        weakness: Factor on the strength; toughness goes with its square, the length stays.

    Returns:
        ``threshold``, ``length``, ``code`` and ``toughness``, the one that a crack takes here.
    """
    model = material.model
    wide, add = CELLS * dx, GRID_ENERGY[model] * dx
    energy, young = at(material.toughness), at(material.young_modulus)
    strong = material.tensile_strength
    size = None
    if strong is not None:
        strength = at(strong) / material.softening**0.5
        size = SIZE[model] * young / strength**2  # l over the toughness of the solver
    if material.length is not None:
        length = at(material.length)
    elif size is not None:
        length = (size * energy - add).clamp(min=wide)
    else:
        length = torch.full_like(energy, wide or 1.0)
    if material.prefer == "strength" and size is not None:
        energy = (length + add) / size
    energy = energy * weakness**2
    solved = energy / (1.0 + add / length)
    code = torch.full_like(energy, float(SPLITS[material.split] + MODELS[model]))
    return {
        "threshold": solved / (2.0 * C0[model] * length),
        "length": length + torch.zeros_like(solved),
        "code": code,
        "toughness": energy,
    }


def kept(material: Any, dx: float) -> tuple[float, float, float]:
    """(length [m], strength and toughness over those given) on a grid.

    Both are one where no strength is given, or where the grid is fine enough.
    """

    def at(value: Any) -> Tensor:
        return torch.as_tensor(value, dtype=torch.float64).cpu().reshape(-1)

    found = columns(material, at, dx)
    length, energy = found["length"], found["toughness"]
    share = torch.ones_like(length)
    if material.tensile_strength is not None:
        strength = at(material.tensile_strength) / material.softening**0.5
        held = energy / (length + GRID_ENERGY[material.model] * dx)
        held = (SIZE[material.model] * at(material.young_modulus) * held).sqrt()
        share = (held / strength).clamp(max=1.0)
    left = energy / at(material.toughness)
    return float(length.max()), float(share.min()), float(left.min())


def failure_strain(material: Any) -> float:
    """Strain of its strength in tension; infinite where only a grid says what that is."""
    young = torch.as_tensor(material.young_modulus, dtype=torch.float64)
    if material.tensile_strength is not None:
        strength = torch.as_tensor(material.tensile_strength, dtype=torch.float64)
        return float((strength / (material.softening**0.5 * young)).min())
    if material.length is None:
        return math.inf
    toughness, length = (
        torch.as_tensor(v, dtype=torch.float64) for v in (material.toughness, material.length)
    )
    return float((SIZE[material.model] * toughness / (length * young)).sqrt().min())


def rows(material: Any, at: Callable[[Any], Tensor], weakness: Tensor, dx: float) -> Tensor:
    """Rows of points of a phase-field material on a grid, float64 [N, 8].

    Args:
        material: Of law ``phase_field``.
        at: Turns a parameter into its values at the points.
        weakness: Factor on the strength of each point, [N]; toughness goes with its square.
        dx: Node spacing [m].

    Raises:
        InputError: A length that is given is less than two cells.
    """
    step = (STEP * (weakness.clamp(min=1e-3).log() / STEP).round()).exp()
    found = columns(material, at, dx, step)
    least = float(found["length"].min())
    if least < CELLS * dx * (1.0 - 1e-6):
        raise InputError(
            f"material {material.name!r}: length must be at least {CELLS:g} cells of {dx:.3g} m, "
            f"got {least:.3g} m",
            hint=f"give length: auto, at least {CELLS * dx:.3g}, or a finer quality",
        )
    row = laws.row(
        material.law,
        lambda field: found[field] if field in found else at(getattr(material, field)),
    )
    if material.hysteresis == "both":
        row[..., 7] += row[..., 7] > 0.0
    return row.expand(weakness.shape[0], 8).clone()
