"""The yield surfaces of brittle matter through the strengths that handbooks give.

The ellipse of NACC is ``q^2 (1 + 2 beta) + M^2 (p + beta p0)(p - p0) = 0``. Uniaxial tension of a
stress s is at ``p = -s/3, q = s``, uniaxial compression at ``p = s/3, q = s``. Rankine's surface
takes both strengths as they are (csrc/core/material/rankine.h).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

STEEPEST = 0.8
"""Largest ``cohesion * hardening`` of what is derived: softening slower than unloading, so that the
energy is that of the law and not of the time step."""
LARGEST = 0.45
"""Largest ``p0 / kappa``; the return map has no state beyond 0.495."""


def ellipse(
    friction: Tensor, tensile: Tensor, compressive: Tensor, largest: Tensor
) -> tuple[Tensor, Tensor]:
    """Cohesion and strength p0 of the yield ellipse through two uniaxial stresses.

    The difference of the two equations gives p0, what is left is quadratic in beta.

    Args:
        friction: M, [N].
        tensile: Uniaxial tensile strength t [Pa], [N].
        compressive: Uniaxial compressive strength c [Pa], [N]; at least t / 0.9 is taken.
        largest: Largest p0 [Pa], [N]; where the strengths ask for more, p0 is this, and the ellipse
            goes through the tensile one alone, or as near to it as a cohesion of one allows.

    Returns:
        ``(beta, p0)``, [N] each.
    """
    m2 = friction**2
    t = tensile.minimum(0.95 * friction * largest / (3.0 + m2 / 9.0).sqrt())
    ratio = (t / compressive).clamp(max=0.9)
    k = ratio * m2 / (1.0 - ratio) ** 2
    # (18 - k) beta^2 + (9 + M^2 + 2 k) beta - k = 0; its small root without cancellation
    linear = 9.0 + m2 + 2.0 * k
    beta = 2.0 * k / (linear + (linear**2 + 4.0 * (18.0 - k) * k).sqrt())
    p0 = 3.0 * (t / ratio - t) * (1.0 + 2.0 * beta + m2 / 9.0) / (m2 * (1.0 - beta))
    reach = largest + t / 3.0
    alone = (t**2 / m2 + t / 3.0 * reach) / (largest * reach - 2.0 * t**2 / m2)
    crowded = p0 > largest
    return torch.where(crowded, alone, beta), torch.where(crowded, largest, p0)


SHAPE = 0.25
"""``xi |alpha0|`` of Rankine's surface: so small that strength falls almost along a line."""


def opening(
    mu: Tensor, kappa: Tensor, tensile: Tensor, energy: Tensor, *, prefer: str = "toughness"
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Rankine's softening with a given energy per volume.

    ``f = beta kappa sinh(xi |alpha|)`` takes ``beta kappa (cosh(xi |alpha0|) - 1) / xi`` until it
    is gone, whatever the path. It must fall slower than matter unloads, else the energy is that of
    the step: then there is less strength, or more energy.

    Args:
        mu: Shear modulus [Pa], [N].
        kappa: Bulk modulus [Pa], [N].
        tensile: Tensile strength [Pa], [N].
        energy: Energy per volume [J/m^3], [N].
        prefer: ``toughness`` lowers the strength there, ``strength`` raises the energy.

    Returns:
        ``(beta, xi, alpha0, kept)``, [N] each; the last is the share of the strength that is left.
    """
    young = 9.0 * kappa * mu / (3.0 * kappa + mu)
    steepest = STEEPEST * torch.minimum(kappa, young)
    cosh, sinh = math.cosh(SHAPE), math.sinh(SHAPE)
    # -df/dalpha at the start is beta kappa xi cosh = (f / sinh)^2 (cosh - 1) cosh / energy
    over = (cosh - 1.0) * cosh / sinh**2
    limit = (steepest * energy / over).sqrt()
    kept = (limit / tensile).clamp(max=1.0) if prefer == "toughness" else torch.ones_like(limit)
    strength = tensile * kept
    energy = energy.maximum(over * strength**2 / steepest)
    beta = strength / (kappa * sinh)
    xi = beta * kappa * (cosh - 1.0) / energy
    return beta, xi, -SHAPE / xi, kept
