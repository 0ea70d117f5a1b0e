"""The yield ellipse of NACC through the strengths that handbooks give.

The surface is ``q^2 (1 + 2 beta) + M^2 (p + beta p0)(p - p0) = 0``. Uniaxial tension of a stress s
is at ``p = -s/3, q = s``, uniaxial compression at ``p = s/3, q = s``.
"""

from __future__ import annotations

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
