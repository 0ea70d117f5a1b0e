"""The yield ellipse of NACC through the strengths that handbooks give.

The surface is ``q^2 (1 + 2 beta) + M^2 (p + beta p0)(p - p0) = 0``. Uniaxial tension of a stress s
is at ``p = -s/3, q = s``, uniaxial compression at ``p = s/3, q = s``.
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

    Args:
        friction: M, [N].
        tensile: Uniaxial tensile strength [Pa], [N].
        compressive: Uniaxial compressive strength [Pa], [N]; at least the tensile one.
        largest: Largest p0 [Pa], [N]; where the stresses ask for more, p0 is this, and the ellipse
            goes through the tensile one alone.

    Returns:
        ``(beta, p0)``, [N] each.
    """
    compressive = compressive.maximum(1.001 * tensile)
    low, high = torch.full_like(tensile, math.log(1e-6)), torch.full_like(tensile, math.log(1e3))
    for _ in range(80):
        middle = 0.5 * (low + high)
        over = _compressive(friction, tensile, middle.exp()) > compressive
        low, high = torch.where(over, middle, low), torch.where(over, high, middle)
    beta = (0.5 * (low + high)).exp()
    p0 = _tip(friction, tensile, beta)
    m2, s = friction**2, tensile
    capped = (s**2 / m2 + s / 3.0 * (largest + s / 3.0)) / (
        largest * (largest + s / 3.0) - 2.0 * s**2 / m2
    ).clamp(min=1e-12 * largest**2)
    crowded = p0 > largest
    return torch.where(crowded, capped, beta), torch.where(crowded, largest, p0)


def _tip(friction: Tensor, tensile: Tensor, beta: Tensor) -> Tensor:
    """p0 of the ellipse with this cohesion through uniaxial tension."""
    m2, s = friction**2, tensile
    half = (beta - 1.0) * s / 3.0  # beta p0^2 + half p0 - rest = 0
    rest = s**2 / 9.0 + s**2 * (1.0 + 2.0 * beta) / m2
    return (-half + (half**2 + 4.0 * beta * rest).sqrt()) / (2.0 * beta)


def _compressive(friction: Tensor, tensile: Tensor, beta: Tensor) -> Tensor:
    """Uniaxial compressive strength of that ellipse."""
    m2, p0 = friction**2, _tip(friction, tensile, beta)
    a = (1.0 + 2.0 * beta) / m2 + 1.0 / 9.0  # a s^2 - b s - beta p0^2 = 0
    b = (1.0 - beta) * p0 / 3.0
    return (b + (b**2 + 4.0 * a * beta * p0**2).sqrt()) / (2.0 * a)
