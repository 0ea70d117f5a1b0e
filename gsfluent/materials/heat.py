"""Thermal properties of what melts, with their sources, for :mod:`gsfluent.ops.heat`."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from gsfluent.errors import InputError
from gsfluent.materials.material import nearest


@dataclasses.dataclass(frozen=True)
class Thermal:
    """How a material takes up heat and lets it through.

    Args:
        conductivity: Of the solid [W/(m K)].
        liquid_conductivity: Of the liquid [W/(m K)].
        heat_capacity: Of the solid [J/(kg K)].
        liquid_heat_capacity: Of the liquid [J/(kg K)].
        melting_point: Where melting begins [degrees C].
        melting_range: How far above it ends [K].
        latent_heat: What it takes [J/kg].
        viscosity: Of the melt [Pa s].
        source: Where the numbers are from.
    """

    conductivity: float
    liquid_conductivity: float
    heat_capacity: float
    liquid_heat_capacity: float
    melting_point: float
    melting_range: float
    latent_heat: float
    viscosity: float
    source: str

    def row(self) -> Tensor:
        """The row for :func:`gsfluent.ops.conduct`, float64 [7]."""
        return torch.tensor(dataclasses.astuple(self)[:7], dtype=torch.float64)


THERMAL: dict[str, Thermal] = {
    "ice": Thermal(
        2.2, 0.57, 2050.0, 4200.0, 0.0, 0.0, 3.34e5, 1.8e-3,
        "measured: handbook, ice and water near 0 degrees C (CRC Handbook)",
    ),
    "chocolate": Thermal(
        0.25, 0.21, 1600.0, 1700.0, 28.0, 6.0, 4.5e4, 3.0,
        "derived: a third of cocoa butter of 150 J/g, which melts from 28 to 34 degrees C as form "
        "V (Beckett, Science of Chocolate); conductivity and capacity estimates from its parts; "
        "viscosity of the molten, 1 to 20 Pa s (the same book)",
    ),
    "wax": Thermal(
        0.24, 0.15, 2100.0, 2400.0, 52.0, 6.0, 1.9e5, 5e-3,
        "measured: paraffin wax, melting 52 to 58 degrees C, 170 to 210 J/g (tables of heat "
        "stores, e.g. Zalba et al. 2003); viscosity estimate, a few mPa s above 60 degrees C",
    ),
}  # fmt: skip
"""Name -> thermal properties."""


def thermal(name: str) -> Thermal:
    """Thermal properties by name.

    Raises:
        InputError: None has that name; the message gives the nearest one and all names.
    """
    if name not in THERMAL:
        raise InputError(f"unknown thermal material {name!r}", hint=nearest(name, THERMAL))
    return THERMAL[name]
