"""The switches of the textbook solver, and where its first number that is none came from."""

from __future__ import annotations

import dataclasses
from typing import Literal, NamedTuple

from gsfluent.lab.textbook.nacc import MAPS

_CHOICES: dict[str, tuple[str, ...]] = {
    "transfer": ("apic", "pic", "flip"),
    "kernel": ("quadratic", "linear"),
    "force": ("mls", "gradient", "twice"),
    "storage": ("F", "strain"),
    "law": ("neo_hookean", "corotated"),
    "return_map": MAPS,
    "sums": ("plain", "sorted", "float64", "fixed"),
}


@dataclasses.dataclass(frozen=True)
class Variant:
    """What others differ by.

    Raises:
        ValueError: A value is none of these.
    """

    transfer: Literal["apic", "pic", "flip"] = "apic"  # apic, pic or flip
    flip: float = 0.99  # share of FLIP in flip
    kernel: Literal["quadratic", "linear"] = "quadratic"  # quadratic or linear B-splines
    # mls (weights times distance), gradient (of the weights) or twice (gradient times weight:
    # GaussianFluent's released FLIP path)
    force: Literal["mls", "gradient", "twice"] = "mls"
    storage: Literal["F", "strain"] = "F"  # F or strain (e = b - I)
    # of elastic rows: neo_hookean (Borden's) or corotated
    law: Literal["neo_hookean", "corotated"] = "neo_hookean"
    return_map: str = "fixed_explicit"  # of NACC rows: one of MAPS
    # tolerances of 1e-4 Pa in the fixed-centre maps, as ziran and claymore have them
    absolute: bool = False
    energy_as_pressure: bool = False  # claymore's stress: the energy where its derivative belongs
    # smallest and largest volume ratio that a step may leave, or None
    clamp: tuple[float, float] | None = None
    # sums at nodes: plain in the order of the points, sorted by cell and number (on a GPU
    # deterministic as well), float64, or fixed (64-bit integers)
    sums: Literal["plain", "sorted", "float64", "fixed"] = "plain"
    # seed of a new order of the points in every step, which is how atomic additions behave; None
    # keeps their order
    shuffle: int | None = None
    # divide by a node's mass only where it is more than mass_floor. False divides everywhere, so
    # that a node without mass is 0 / 0; FLIP then does so in the gather of the old velocity only,
    # as GaussianFluent's does
    guarded: bool = True
    mass_floor: float = 0.0  # [kg]
    local_positions: bool = False  # keep cell and offset in place of absolute coordinates
    fields: bool = False  # A velocity field per body, with the contact of equations.md 11.3

    def __post_init__(self) -> None:
        for name, known in _CHOICES.items():
            if getattr(self, name) not in known:
                raise ValueError(
                    f"Variant: {name} must be one of {', '.join(known)}, got "
                    f"{getattr(self, name)!r}"
                )
        if not 0.0 <= self.flip <= 1.0:
            raise ValueError(f"Variant: flip must be in [0, 1], got {self.flip}")
        if self.kernel == "linear" and self.force == "mls":
            raise ValueError("Variant: the MLS force needs the quadratic kernel; take 'gradient'")
        if self.clamp is not None and not 0.0 < self.clamp[0] < self.clamp[1]:
            raise ValueError(f"Variant: clamp must be two rising positive numbers: {self.clamp}")


class Birth(NamedTuple):
    """Where the first number that is none came from."""

    stage: str  # grid, g2p, return map or position
    step: int  # number of the step, from 0
    points: int  # how many points it hit
    point: int  # the first of them, or -1
    alone: bool  # no other point shares a node with it
    massless: bool  # A node of its stencil has no mass

    def __str__(self) -> str:
        where = f"not finite after {self.step} steps, born in the {self.stage}: "
        what = f"{self.points} points, the first is number {self.point}"
        return (
            where
            + what
            + (", alone" if self.alone else "")
            + (", with a node of its stencil without mass" if self.massless else "")
        )
