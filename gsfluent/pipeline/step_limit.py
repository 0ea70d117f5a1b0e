"""How long a step may be for what came loose: points that no neighbour holds."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from gsfluent.scene import Scene

__all__ = ["loose_limit", "safe_steps"]

ROOM = 1.04
"""Share by which a Courant number must stay below the limit. At rest the limit is exact; the
automatic step counts the speed too, which is further room."""
_WHOLE = ("elastic", "corotated", "rigid", "fluid")
"""Laws whose matter stays together, or bears no shear and no tension."""


def loose_limit(poisson_ratio: float) -> float:
    """Largest stable ``c dt / dx`` of a point that nothing else holds, ``sqrt((1 - nu)/(1 + nu))``.

    All nodes are its own, so a step changes its velocity gradient by ``-4 dt / (rho dx^2) tau``: an
    oscillator of its volume with ``omega^2 = 12 K / (rho dx^2)``, which symplectic Euler keeps up
    to ``omega dt = 2``. Measured within 3 %, also on clusters of 2 to 8 points
    (docs/measured/stability.md).

    Args:
        poisson_ratio: nu, above -1 and below 0.5.
    """
    return math.sqrt((1.0 - poisson_ratio) / (1.0 + poisson_ratio))


def safe_steps(scene: Scene, courant: Sequence[float]) -> tuple[float, ...]:
    """Those Courant numbers that loose pieces of a scene's matter would bear.

    Args:
        scene: The scene; bodies of laws that do not come apart are not asked.
        courant: Courant numbers.
    """
    most = math.inf
    for body in scene.bodies:
        for material in (body.material, *(part.material(body.material) for part in body.parts)):
            if material.law not in _WHOLE:
                most = min(most, loose_limit(float(torch.as_tensor(material.poisson_ratio).max())))
    return tuple(number for number in courant if number * ROOM <= most)
