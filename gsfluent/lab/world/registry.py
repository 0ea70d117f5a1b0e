"""What a problem with a known answer returns, and the list of all of them."""

from __future__ import annotations

import dataclasses
import importlib
import math
import pkgutil
import time
from collections.abc import Callable, Iterable
from typing import Any, Literal

Tier = Literal["fast", "slow"]


@dataclasses.dataclass(frozen=True)
class Result:
    """One figure beside its reference."""

    name: str  # problem it belongs to
    quantity: str  # what was measured
    value: float  # the measured figure
    reference: float  # what it should be
    error: float  # distance of the two in the measure tolerance is given in
    tolerance: float  # largest accepted error
    unit: str = ""  # unit of value and reference
    source: str = ""  # where the reference (or the tolerance) comes from
    seconds: float = 0.0  # CPU time of the whole problem; filled in by run
    note: str = ""  # settings or findings worth a column

    @property
    def passed(self) -> bool:
        """Whether the error is a number within the tolerance."""
        return math.isfinite(self.error) and self.error <= self.tolerance


@dataclasses.dataclass(frozen=True)
class Problem:
    """A registered problem: its name, its cost class and the function that computes it."""

    name: str
    tier: Tier
    function: Callable[..., Result | Iterable[Result]]
    summary: str


_PROBLEMS: dict[str, Problem] = {}


def problem(*, tier: Tier) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Register a function ``() -> Result`` or ``() -> several Results`` under its own name.

    Every argument of the function needs a default; the defaults are what the battery runs.

    Args:
        tier: ``"fast"`` (a few seconds on one core, also a test) or ``"slow"``.

    Raises:
        ValueError: An unknown tier, or a name that another module has taken.
    """
    if tier not in ("fast", "slow"):
        raise ValueError(f"problem: tier must be 'fast' or 'slow', got {tier!r}")

    def register(function: Callable[..., Any]) -> Callable[..., Any]:
        name = function.__name__
        known = _PROBLEMS.get(name)
        if known is not None and known.function.__module__ != function.__module__:
            raise ValueError(
                f"problem: {name!r} of {function.__module__} is already a problem of "
                f"{known.function.__module__}"
            )
        summary = (function.__doc__ or name).strip().splitlines()[0].rstrip(".")
        _PROBLEMS[name] = Problem(name, tier, function, summary)
        return function

    return register


def discover() -> None:
    """Import every module of :mod:`gsfluent.lab.problems`, so that its problems are registered."""
    rooms = importlib.import_module("gsfluent.lab.problems")
    for module in pkgutil.walk_packages(rooms.__path__, f"{rooms.__name__}."):
        importlib.import_module(module.name)


def problems(tier: str = "all", only: str | None = None) -> list[Problem]:
    """Return registered problems in the order of their names.

    Raises:
        ValueError: An unknown tier.
    """
    if tier not in ("fast", "slow", "all"):
        raise ValueError(f"problems: tier must be 'fast', 'slow' or 'all', got {tier!r}")
    chosen = (p for p in _PROBLEMS.values() if tier in ("all", p.tier))
    return sorted((p for p in chosen if only is None or only in p.name), key=lambda p: p.name)


def run(item: Problem, **options: Any) -> list[Result]:
    """Compute a problem; every result carries the process CPU time of the whole of it [s]."""
    start = time.process_time()
    found = item.function(**options)
    results = [found] if isinstance(found, Result) else list(found)
    seconds = time.process_time() - start
    return [dataclasses.replace(r, name=r.name or item.name, seconds=seconds) for r in results]


def compare(
    quantity: str,
    value: float,
    reference: float | None = None,
    *,
    tolerance: float,
    error: float | None = None,
    unit: str = "",
    source: str = "",
    note: str = "",
    name: str = "",
) -> Result:
    """Return the Result of a figure that should equal its reference.

    Args:
        quantity: What was measured.
        value: Measured figure.
        reference: What it should be; None: nothing at all.
        tolerance: Largest accepted error, in the measure of it.
        error: Default: the difference as a share of ``reference``, or ``value`` in its unit.
        unit: Unit of value and reference.
        source: Where the reference comes from.
        note: Settings or findings.
        name: Of the problem; default: :func:`run` fills it in.
    """
    if error is None and reference is None:
        error = abs(value)
    elif error is None:
        off = abs(value - float(reference or 0.0))
        error = off / abs(reference) if reference else math.inf
    target = 0.0 if reference is None else reference
    return Result(name, quantity, value, target, error, tolerance, unit, source, note=note)
