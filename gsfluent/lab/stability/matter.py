"""Maps of what breaks: the return map's variants, how fast strength is lost, the order of sums."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch

from gsfluent.lab.stability.maps import Axis, Map, Outcome, Place
from gsfluent.lab.stability.scenes import IMPACT, SPACING, brittle, watched
from gsfluent.lab.world.driver import World
from gsfluent.lab.world.invariants import OfWorld, Violation, check, search

STEPS = 100
APART = 1e-4
"""RMS distance of two numberings of the same points that counts as another result [dx]."""


COURANT = Axis(
    "courant", "Courant number (c + v) dt / dx",
    (0.1, 0.2, 0.3, 0.5, 0.7, 0.85, 1.0, 1.2, 1.5, 2.0, 2.5, 3.0, 4.0), 0.5,
)  # fmt: skip


class Twins:
    """Two runs of one scene whose points are numbered differently."""

    def __init__(self, make: Callable[[int | None], World], seed: int = 5) -> None:
        self.worlds = make(None), make(seed)
        self.runs = [OfWorld(w) for w in self.worlds]
        count = len(self.worlds[0].scene.mass)
        order = torch.randperm(count, generator=torch.Generator().manual_seed(seed))
        self.back = torch.argsort(order).to(self.worlds[0].scene.mass.device)
        self.first = self.runs[0].look()

    def advance(self, steps: int) -> None:
        """Both go on."""
        for run in self.runs:
            run.advance(steps)

    def look(self) -> Any:
        """The sums of the first."""
        return self.runs[0].look()

    def save(self) -> list[Any]:
        """Copy both."""
        return [run.save() for run in self.runs]

    def load(self, saved: list[Any]) -> None:
        """Set both back."""
        for run, one in zip(self.runs, saved, strict=True):
            run.load(one)

    def judge(self) -> Violation | None:
        """The laws, and then whether they are still the same."""
        now = self.look()
        if (bad := check(self.first, now)) is not None:
            return bad
        one, other = (w.position.double() for w in self.worlds)
        apart = float((one - other[self.back]).square().sum(1).mean().sqrt()) / SPACING
        if apart > APART:
            return Violation(now.step, "order", apart, APART)
        return None


def twins(make: Callable[[int | None], World], place: Place) -> Outcome:
    """Run both numberings until a law is broken or they part."""
    pair = Twins(make)
    found = search(pair, pair.judge, STEPS, every=place.every)
    return Outcome(STEPS, found, len(pair.back))


# --- the map itself ---


def map_point(k: float, epsilon: float, variant: str, place: Place) -> Outcome:
    """The brittle ball under one return map, its sums in the order of its points."""
    options: dict[str, Any] = {
        "k": k if k < 100.0 else math.inf, "epsilon": epsilon,
        "implicit": not variant.startswith("explicit"),
    }  # fmt: skip
    engine = "solver" if variant == "implicit, exact sums" else "ops"
    return twins(lambda o: brittle(order=o, place=place, engine=engine, **options), place)


RETURN_MAP_MAP = Map(
    "return_map", "A brittle ball: k and epsilon of the return map",
    Axis("k", "k, exponent of the dynamic centre (100: fixed centre)",
         (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 8.0, 100.0), 2.0),
    Axis("epsilon", "epsilon, its regularisation", (0.0, 0.01, 0.03, 0.1, 0.2, 0.3, 0.5), 0.1,
         log=False),
    ("implicit, exact sums", "implicit, ordinary sums", "explicit, ordinary sums"), map_point,
    "test_boundary_return_map_against_the_order_of_the_points",
    "O: the same points numbered differently end elsewhere (1e-4 dx, RMS). Exact sums cannot; "
    "with ordinary sums it is the map that lets rounding grow or not.",
)  # fmt: skip

MAPS: dict[str, dict[str, Any]] = {
    "dynamic, implicit": {"k": 2.0, "epsilon": 0.1, "implicit": True},
    "dynamic, explicit": {"k": 2.0, "epsilon": 0.1, "implicit": False},
    "fixed, implicit": {"k": math.inf, "epsilon": 0.0, "implicit": True},
    "fixed, explicit": {"k": math.inf, "epsilon": 0.0, "implicit": False},
}


def centre_point(courant: float, which: str, variant: str, place: Place) -> Outcome:
    """The brittle ball, its centre fixed or dynamic, alpha explicit or implicit."""
    return watched(brittle(courant=courant, place=place, **MAPS[which]), STEPS, place)


CENTRE_MAP = Map(
    "centre", "A brittle ball: variants of the return map",
    COURANT, Axis("map", "return map", tuple(MAPS), "dynamic, implicit"),
    ("gsfluent",), centre_point, "test_boundary_courant_number_brittle_ball",
    "Sums are exact and divisions guarded here, so that the map alone is seen.", gpu=True,
)  # fmt: skip

# --- how brittle ---

HARDENING = Axis(
    "hardening", "xi: how fast strength is lost", (0.3, 1.0, 3.0, 10.0, 30.0, 100.0), 3.0,
    setting=False,
)  # fmt: skip


def softening_point(courant: float, hardening: float, variant: str, place: Place) -> Outcome:
    """The brittle ball, of one strength, that loses it fast or slowly."""
    options = MAPS["dynamic, implicit" if variant == "gsfluent" else "fixed, explicit"]
    world = brittle(courant=courant, hardening=hardening, place=place, **options)
    return watched(world, STEPS, place)


SOFTENING_MAP = Map(
    "softening", "A brittle ball: how fast strength is lost",
    COURANT, HARDENING, ("gsfluent", "fixed centre, explicit"),
    softening_point, "test_boundary_courant_number_softening", "", gpu=True,
)  # fmt: skip


def impact_point(courant: float, mach: float, variant: str, place: Place) -> Outcome:
    """The brittle ball at some speed."""
    options = MAPS["dynamic, implicit" if variant == "gsfluent" else "fixed, explicit"]
    return watched(brittle(courant=courant, mach=mach, place=place, **options), STEPS, place)


IMPACT_MAP = Map(
    "impact", "A brittle ball hits a floor", COURANT,
    Axis("mach", "speed over wave speed, v / c", (0.03, 0.1, 0.2, IMPACT, 0.5, 0.7, 1.0, 2.0),
         IMPACT, setting=False),
    ("gsfluent", "fixed centre, explicit"), impact_point,
    "test_boundary_courant_number_brittle_impact",
    "At a touch nothing breaks and the elastic limit counts; where all breaks, matter without "
    "strength forgives longer steps.",
)  # fmt: skip

SUMS = ("exact", "ordinary")


def order_point(hardening: float, sums: str, variant: str, place: Place) -> Outcome:
    """Two numberings of the brittle ball."""
    options = MAPS["dynamic, implicit" if variant == "gsfluent" else "fixed, explicit"]
    engine = "solver" if sums == "exact" else "ops"
    return twins(
        lambda o: brittle(order=o, hardening=hardening, place=place, engine=engine, **options),
        place,
    )


ORDER_MAP = Map(
    "order", "A brittle ball whose points are shuffled", HARDENING,
    Axis("sums", "sums at nodes", SUMS, "exact"), ("gsfluent", "fixed centre, explicit"),
    order_point, "test_boundary_order_of_the_points",
    "Shuffled points are what atomic additions on a GPU do to a sum in every step.",
)  # fmt: skip
