"""From which speed a body breaks, how fast it lands, and what would break it."""

from __future__ import annotations

import functools
import math
from typing import Any

import torch

from gsfluent import materials
from gsfluent.materials import Material
from gsfluent.pipeline.matter.brittle import kept_strength
from gsfluent.scene.scene import Body, Scene

_STRESS, _ENERGY = 1.1, 8.8
"""Fitted to all balls of docs/measured/breaks_from.md, for all materials together."""
_BAND = 2.0  # cells that a crack is wide: so much less of a body is left to cut
SURE = 1.25
"""Times the speed from which a thing is estimated to break at which it surely does."""
_SLENDER = 0.15
"""Share of the ball around it that a slender body fills at most: a bar of 1 : 2 : 4 has 0.24."""
_HIGH = 20.0  # m; what needs more is not dropped but shot at
_STEEL = 7800.0


def breaks_from(
    material: Material, length: float, dx: float | None = None, *, slender: bool = False
) -> float:
    """Speed of a landing that parts a body [m/s]; infinite for what does not break.

    The landing brings the stress, which by Hertz goes as ``E (v / c)^(6/5)``, and pays for the
    break: its energy ``rho V v^2 / 2`` over that of a cut across the longest side, ``G V / L``.
    The sum of both is needed (docs/theory/fracture.md). Scattered strength takes its energy along:
    a body that is larger than the specimens has weaker spots, and breaks there. What is slender
    bends as a whole: its strain is ``sqrt(3) v / c`` (Hunt 1960), wherever it is struck, and all
    of its energy can go into one cut.

    Of a material without a fracture energy it is
    :attr:`gsfluent.materials.Material.breaking_speed`, at which it starts to break.

    Args:
        material: What the body is made of.
        length: Longest side of the body [m].
        dx: Node spacing [m]: a coarse grid keeps less strength; the real strength without.
        slender: It is a plate, a bar or a vessel, and not compact (:func:`is_slender`).
    """
    start = material.breaking_speed
    if material.law == "phase_field" and dx is not None:
        return start * kept_strength(material, dx)
    if not material.by_handbook or material.energy_by_hand or not math.isfinite(start):
        return start

    young, density, energy = (
        float(torch.as_tensor(field, dtype=torch.float64).mean())
        for field in (material.young_modulus, material.density, material.fracture_energy)
    )
    kept = 1.0 if dx is None else kept_strength(material, dx)
    strength = kept * float(material.strengths()[0].min())
    stressed = _STRESS * material.wave_speed * (strength / young) ** (5.0 / 6.0)
    paid = math.sqrt(6.0 * energy / (density * length))
    if slender:
        stressed = kept * start / math.sqrt(3.0)
    else:
        paid *= _ENERGY
    if material.weibull_modulus > 0.0:  # the size effect of a ball
        specimens = material.reference_volume / (math.pi / 6.0 * length**3)
        paid *= specimens ** (0.5 / material.weibull_modulus)
    narrow = 1.0 if dx is None else max(1.0 - _BAND * dx / length, 0.0)
    return narrow * math.hypot(stressed, paid)


def _length(body: Body) -> float:
    low, high = body.bounds()
    return float((high - low).max())


def is_slender(body: Body) -> bool:
    """Whether a body fills so little of the ball around it that it bends: plates, bars, vessels."""
    return body.volume < _SLENDER * math.pi / 6.0 * _length(body) ** 3


def landing_speed(body: Body, scene: Scene) -> float | None:
    """Speed with which a body falls onto the floor [m/s]; None without a floor."""
    if scene.floor is None:
        return None
    height = max(0.0, float(body.bounds()[0][2]) - scene.floor)
    pull = max(0.0, -scene.gravity[2])
    return math.sqrt(min(0.0, body.velocity[2]) ** 2 + 2.0 * pull * height)


def breaking_rows(body: Body, lands: float | None, pull: float, dx: float) -> list[dict[str, Any]]:
    """What breaks a body, material by material.

    Args:
        body: The body.
        lands: Speed with which it strikes or is struck [m/s]; None when it meets nothing.
        pull: Strength of gravity [m/s^2].
        dx: Node spacing [m].

    Returns:
        Rows with ``object``, ``material``, ``lands_with`` and ``breaks_from`` [m/s] (None: it meets
        nothing, it does not break), ``height`` of a fall that breaks it [m] or None, ``breaks``
        (whether it is expected to), and ``hint``: what would break it, empty where it breaks.
    """
    rows = []
    for material in body.materials:
        limit = breaks_from(material, _length(body), dx, slender=is_slender(body))
        finite = math.isfinite(limit)
        breaks = finite and lands is not None and lands >= limit
        rows.append(
            {
                "object": body.name,
                "material": material.name,
                "lands_with": lands,
                "breaks_from": limit if finite else None,
                "height": limit**2 / (2.0 * pull) if finite and pull > 0.0 else None,
                "breaks": breaks,
                "hint": "" if breaks else _hint(body, limit, lands or 0.0, pull, dx),
            }
        )
    return rows


def _hint(body: Body, limit: float, lands: float, pull: float, dx: float) -> str:
    """The height, the material or the bullet that breaks a body."""
    said = []
    if math.isfinite(limit):
        height = (SURE * limit) ** 2 / (2.0 * pull) if pull > 0.0 else math.inf
        if height <= _HIGH:
            said.append(f"a drop from {height:.2g} m")
        else:
            said.append(f"throw: {SURE * limit:.2g} m/s")
    if weaker := _weaker(body, lands, dx):
        said.append(f"material: {weaker}")
    if math.isfinite(limit):
        # a bullet that brings the energy of that fall, a tenth as wide as the body
        radius = 0.05 * _length(body)
        mass = _STEEL * 4.0 / 3.0 * math.pi * radius**3
        whole = float(torch.as_tensor(body.material.density).mean()) * body.volume
        speed = SURE * limit * math.sqrt(whole / mass)
        said.append(f"a bullet of radius {radius:.2g} m at {speed:.2g} m/s")
    return ", or ".join(said)


@functools.lru_cache(maxsize=8)  # a second of work, and the same for every part of a body
def _presets(length: float, dx: float, slender: bool) -> dict[str, float]:
    """From which speed bodies of the presets break that can."""
    return {
        name: breaks_from(materials.get(name), length, dx, slender=slender)
        for name in materials.names()
        if materials.get(name).law == "nacc"
    }


def _weaker(body: Body, lands: float, dx: float) -> str:
    """The toughest preset that such a landing surely breaks; empty without any."""
    found = _presets(_length(body), dx, is_slender(body)) if lands > 0.0 else {}
    fit = {name: speed for name, speed in found.items() if SURE * speed <= lands}
    return max(fit, key=fit.__getitem__) if fit else ""
