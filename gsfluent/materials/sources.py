"""Wording of the ``sources`` of presets: ``measured: ...``, ``derived: ...``."""

from __future__ import annotations

DENSITY = "measured: handbook density"
POISSON = "measured: handbook Poisson ratio"


def softened(true_young: float, factor: float, what: str) -> str:
    """Say that a stiffness was divided by ``factor``."""
    return (
        f"derived: handbook {true_young:g} Pa for {what}, softened {factor:g} times for time steps"
    )


def softened_yield(true_stress: float, factor: float, what: str) -> str:
    """Say that a yield stress was divided by the root of the factor of the stiffness."""
    return (
        f"derived: {true_stress:g} Pa for {what}, divided by the root of {factor:g}, so that the "
        "speed yield stress / (density x wave speed) at which it dents is the true one"
    )


def compressible(speed: float) -> str:
    """Say that a liquid got a slower sound."""
    return (
        f"derived: density x ({speed:g} m/s)^2; sound ten times faster than the flow keeps the "
        "density within a percent, the true 1500 m/s would need that many more steps"
    )
