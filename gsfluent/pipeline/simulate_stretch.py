"""Bounds of the total deformation.

The total deformation F of a point is a product of its steps. In broken matter and in liquids
nothing holds it back: it grows like ``exp(|grad v| t)``, past the largest float after some tenths
of a second of a hard shot. Only splats need F, and they show no stretch outside
:data:`gsfluent.pipeline.carry.STRETCH` anyway.
"""

from __future__ import annotations

from torch import Tensor

from gsfluent import ops
from gsfluent.pipeline.carry import STRETCH
from gsfluent.pipeline.simulate_state import State

WILD = 1e6
"""An entry of F at which the deformations of the state are bounded."""
LARGE = 1e3
"""Points with an entry from here on are bounded with it, so that it need not be done often."""


def bounded(state: State) -> State:
    """The state with what splats show of deformations that have run away; others stay as they are.

    A deformation that is no number any more begins again from none.
    """
    deformation = state.particles.deformation
    if deformation is None or bool((deformation.abs() < WILD).all()):
        return state
    return state._replace(particles=state.particles.replace(deformation=tamed(deformation)))


def tamed(deformation: Tensor) -> Tensor:
    """Deformations [N, 3, 3], large ones with their stretches clamped to what splats show."""
    rows = (~(deformation.abs().amax(dim=(1, 2)) < LARGE)).nonzero()[:, 0]
    # Squares of such entries are no float32.
    _, clamped = ops.polar_clamped(deformation[rows].double(), *STRETCH)
    return deformation.index_copy(0, rows, clamped.to(deformation))
