"""The cases: how a scene is built at any resolution, and how a run of it is judged."""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Callable, Iterable, Sequence

from .run import Measure, Run
from .scene import Scene, SceneError

MODULES = ("contact", "elastic", "flow", "bars", "cantilever", "cracks", "plane", "rock", "shatter")
"""Modules of ``scenes`` that register cases."""

Build = Callable[[float, int], Scene]
Judge = Callable[[Scene, Run], Iterable[Measure]]


@dataclasses.dataclass(frozen=True)
class Case:
    """A problem."""

    name: str  # its name
    kind: str  # elastic, contact or fracture: what a method must be able to do
    summary: str  # one line
    dx: float  # node spacing of the frozen scene [m]
    build: Build  # build(dx, points_per_cell) -> Scene
    judge: Judge  # judge(scene, run) -> measures; the first is the error of the charts
    ladder: tuple[float, ...]  # node spacings from coarse to fine that a chart runs [m]


_CASES: dict[str, Case] = {}


def case(
    *, kind: str, dx: float, ladder: Sequence[float], judge: Judge
) -> Callable[[Build], Build]:
    """Register a builder ``(dx, points_per_cell) -> Scene`` under its own name.

    Raises:
        ValueError: An unknown kind.
    """
    if kind not in ("elastic", "contact", "fracture"):
        raise ValueError(f"case: kind must be elastic, contact or fracture, got {kind!r}")

    def register(build: Build) -> Build:
        name = build.__name__
        summary = (build.__doc__ or name).strip().splitlines()[0].rstrip(".")
        _CASES[name] = Case(name, kind, summary, dx, build, judge, tuple(ladder))
        return build

    return register


def cases(kind: str | None = None) -> list[Case]:
    """Return all cases, or those of a kind, by name."""
    for module in MODULES:
        importlib.import_module(f".scenes.{module}", __package__)
    chosen = (c for c in _CASES.values() if kind is None or c.kind == kind)
    return sorted(chosen, key=lambda c: c.name)


def find(name: str) -> Case:
    """Return a case by name.

    Raises:
        SceneError: No such case.
    """
    known = {c.name: c for c in cases()}
    if name not in known:
        raise SceneError(f"no case {name!r}; there are {', '.join(known)}")
    return known[name]


def judge(scene: Scene, run: Run) -> list[Measure]:
    """Judge a run; one that broke off has an infinite error in every measure.

    Raises:
        SceneError: The run does not answer this scene.
    """
    run.matched(scene)
    measures = list(find(scene.name).judge(scene, run))
    if run.finite:
        return measures
    return [dataclasses.replace(m, error=float("inf")) for m in measures]
