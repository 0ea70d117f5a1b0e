"""What the person at the page has chosen: colours, light, cut. Plain values, no browser."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from gsfluent.pipeline.light.lamps import Lighting

APPEARANCE, DAMAGE, FRAGMENT, MATERIAL = "Appearance", "Damage", "Fragment", "Material"
BODY, SPEED, ENERGY, DEPTH = "Body", "Speed", "Kinetic energy", "Depth inside"
COLOR_BY = (APPEARANCE, DAMAGE, FRAGMENT, MATERIAL, BODY, SPEED, ENERGY, DEPTH)
"""What splats can be coloured by."""

AXES: dict[str, tuple[float, float, float]] = {
    "x": (1.0, 0.0, 0.0),
    "y": (0.0, -1.0, 0.0),
    "z": (0.0, 0.0, 1.0),
}
"""Normals of the named cuts: each points at the film's first camera, which then looks inside."""


@dataclass(frozen=True)
class Cut:
    """A plane that hides what lies in front of it."""

    normal: tuple[float, float, float] = AXES["y"]  # Toward the hidden side, any length but zero
    offset: float = 0.0  # Distance [m] of the plane from the middle of the matter, along the normal


@dataclass(frozen=True)
class Look:
    """How a moment is drawn."""

    color_by: str = APPEARANCE  # One of :data:`COLOR_BY`
    # The lamps; None shows captured colours as they are.
    light: Lighting | None = field(default_factory=Lighting)
    cut: Cut | None = None  # The cut plane, or None
    floor: bool = True  # Whether floor and backdrop are drawn


def direction(azimuth: float, elevation: float) -> tuple[float, float, float]:
    """Unit vector from angles in degrees; azimuth from +x toward +y, elevation above the floor."""
    a, e = math.radians(azimuth), math.radians(elevation)
    return (math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e))


def angles(vector: tuple[float, float, float]) -> tuple[float, float]:
    """Azimuth and elevation [degrees] of a vector, the inverse of :func:`direction`."""
    x, y, z = vector
    return math.degrees(math.atan2(y, x)), math.degrees(math.atan2(z, math.hypot(x, y)))
