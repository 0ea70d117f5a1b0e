"""The stage that learns numbers of materials from motion: starts, two grids, bands, words."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsfluent.errors import InputError, RunError
from gsfluent.pipeline.fit.forward import Forward, TooFast
from gsfluent.pipeline.fit.parameters import FINER, LIMITS, OFFSET, Parameter, Unknowns, read_learn
from gsfluent.pipeline.fit.solve import SHARES, Problem, in_stages
from gsfluent.pipeline.matter.points import grid_spacing
from gsfluent.pipeline.stage import Stage
from gsfluent.progress import Progress, report_progress
from gsfluent.scene.scene import Scene
from gsfluent.targets.target import Target

Array = NDArray[np.float64]
Runner = Callable[[Callable[[Any], Any], Iterable[Any]], list[Any]]
"""Calls a function for every item; :func:`gsfluent.sweep.map` does it in many processes."""

RATIO = 2.0
"""Ratio of the two grids' spacings."""
EXTRAPOLATION = (1.5, 0.3)
"""Believed share of the change to the finer grid that is to come in all, and its deviation: 2 where
the error falls as dx, 4 / 3 where it falls as its square."""
OFFSET_PRIOR = (0.4, 0.3)
"""Believed floor offset in cells, and its deviation: measured on rebounds, docs/theory/fit.md."""
LEFT = 0.1
"""Of what the finer grid moves a number by, the part that may be left: a standard deviation."""
NUISANCE = (OFFSET, FINER)
"""What is learnt of the grid, not of the scene."""
CORRELATED = 0.9
PRIOR_SHARE = 0.5
STILL = 0.01


@dataclasses.dataclass(frozen=True)
class Found:
    """What was learnt.

    Attributes:
        values: By key, a number or three.
        sd: Standard deviations: of ``log`` numbers in decades, else in their unit.
        correlation: Pairs of numbers beyond 0.9, with it.
        unidentified: Key -> words; these values are bounds or beliefs, not findings.
        scene: The scene with what was learnt.
        report: All of it as plain values, for ``fit.json``.
    """

    values: dict[str, Any]
    sd: dict[str, Any]
    correlation: dict[tuple[str, str], float]
    unidentified: dict[str, str]
    scene: Scene
    report: dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Task:
    """One search: picklable, so that a pool of processes may do it."""

    scene: Scene
    target: Target
    unknowns: Unknowns
    start: list[float]
    dx: float
    shares: tuple[float, ...]
    grids: int = 1


def run_task(task: Task) -> dict[str, Any]:
    """Do one search; plain values come back."""
    times = list(task.target.times)
    forward = Forward(task.scene, times, task.dx)
    finer = Forward(task.scene, times, task.dx / RATIO) if task.grids == 2 else None
    observer = task.target.observe(forward.setting())
    problem = Problem(forward, observer, task.unknowns, task.target.step)
    try:
        found = in_stages(problem, np.asarray(task.start), finer=finer, shares=task.shares)
    except TooFast:
        return {"cost": float("inf"), "free": list(task.start), "runs": forward.runs}
    used = [g for g in (forward, finer) if g is not None]
    return {
        **{k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in vars(found).items()},
        "grids": [{"dx": g.dx, "points": g.count, "runs": g.runs} for g in used],
    }


def one_by_one(function: Callable[[Any], Any], items: Iterable[Any]) -> list[Any]:
    """Call a function for every item, here."""
    return [function(item) for item in items]


class Fit(Stage):
    """Learns numbers of materials, velocities and spins from motion.

    Levenberg-Marquardt on forward differences of the resident solver, in stages of time, from
    several starts, on two grids (docs/theory/fit.md). Bodies that break cannot be learnt.

    Args:
        learn: What: ``{"melon": {"young_modulus": (1e4, 1e7), "velocity": True}}``, or a list of
            ``melon.young_modulus``.
        starts: How many; the first is the scene as it is.
        cells: Cells along the longest side of the largest body.
        grids: 2 to see on a grid twice as fine what the first does wrong, and take it out; or 1.
        offset: Learn how much higher than the floor the grid holds matter up, too.
        seed: Of the starts.
        runner: Does the searches; one after the other when absent.

    Raises:
        InputError: A number out of range.
    """

    name = "fit"

    def __init__(
        self,
        learn: Mapping[str, Mapping[str, Any]] | Sequence[str],
        *,
        starts: int = 4,
        cells: int = 8,
        grids: int = 2,
        offset: bool = True,
        seed: int = 0,
        runner: Runner = one_by_one,
    ) -> None:
        super().__init__(seed=seed)
        for name, value, low, high in (
            ("starts", starts, 1, 64), ("cells", cells, 4, 256), ("grids", grids, 1, 2),
        ):  # fmt: skip
            if not low <= value <= high:
                raise InputError(f"fit: {name} is {value}", f"give a number from {low} to {high}")
        self.learn, self.starts, self.cells, self.grids = learn, starts, cells, grids
        self.offset, self.runner = offset, runner

    def forward(self, scene: Scene, target: Target, *, progress: Progress | None = None) -> Found:
        """Learn.

        Args:
            scene: The start: geometry, density, gravity and floor are believed.
            target: What was seen, from :mod:`gsfluent.targets`.
            progress: Told after each search.

        Raises:
            InputError: What is to be learnt cannot be, or the target does not meet the scene.
            RunError: No start can be run.
        """
        unknowns = read_learn(scene, self.learn)
        more = []
        if self.offset and scene.floor is not None and not scene.colliders:
            more.append(Parameter(OFFSET, (OFFSET_PRIOR[0],), spread=OFFSET_PRIOR[1]))
        if self.grids == 2:
            more.append(Parameter(FINER, (EXTRAPOLATION[0],), spread=EXTRAPOLATION[1]))
        unknowns = Unknowns([*unknowns.parameters, *more])
        dx = grid_spacing(scene, self.cells)
        make = functools.partial(Task, scene, target, unknowns)
        total = 1 + (self.starts if self.starts > 1 else 0)
        begin, tries = unknowns.start.tolist(), list[dict[str, Any]]()
        if self.starts > 1:
            # of all starts two stages; the best goes on
            starts = unknowns.starts(self.starts, self.seed)
            tries = self.runner(
                run_task, [make(s.tolist(), dx, SHARES[:2], self.grids) for s in starts]
            )
            report_progress(progress, self.starts, total, "starts")
            good = [t for t in tries if np.isfinite(t["cost"])]
            if not good:
                raise RunError("fit: no start can be run", "nothing", "start from other numbers")
            begin = min(good, key=lambda t: t["cost"])["free"]
        found = self.runner(run_task, [make(begin, dx, SHARES, self.grids)])[0]
        report_progress(progress, total, total, f"{self.cells} cells")
        if not np.isfinite(found["cost"]):
            raise RunError("fit: the best start cannot be run", "nothing", "use fewer cells")
        return conclude(scene, unknowns, found, tries)


def of_the_grid(unknowns: Unknowns, free: Array, information: Any) -> Array:
    """By how much the change to the finer grid has moved each number: linearised, free [P]."""
    part = unknowns.slices().get(FINER)
    if part is None:
        return np.zeros(len(unknowns))
    rows = np.arange(len(unknowns)) != part.start
    normal = np.asarray(information)
    whole = normal + np.diag(1.0 / unknowns.spread**2)
    moved = np.zeros(len(unknowns))
    pull = normal[rows, part.start] * free[part.start]
    moved[rows] = -np.linalg.solve(whole[np.ix_(rows, rows)], pull)
    return moved


def conclude(
    scene: Scene, unknowns: Unknowns, found: Mapping[str, Any], tries: Sequence[Mapping[str, Any]]
) -> Found:
    """Values, bands and words of a search.

    Args:
        scene: As it was.
        unknowns: What was learnt.
        found: The search.
        tries: The starts.
    """
    free = np.asarray(found["free"])
    covariance = np.asarray(found["covariance"])
    grid = of_the_grid(unknowns, free, found["information"])
    sd = np.sqrt(np.diag(covariance) + (LEFT * grid) ** 2)
    slope = np.abs(unknowns.slope(free))
    share = np.clip(np.diag(covariance) / unknowns.spread**2, 0.0, 1.0)
    deviation = np.sqrt(np.diag(covariance))
    related = covariance / np.outer(deviation, deviation)
    labels, values = unknowns.labels(), unknowns.values(free)
    slices = unknowns.slices()
    pairs = {
        (labels[i], labels[j]): float(related[i, j])
        for i in range(len(labels))
        for j in range(i)
        if abs(related[i, j]) > CORRELATED
    }
    spread, unidentified, numbers = {}, {}, {}
    for p in unknowns.parameters:
        part = slices[p.key]
        here = sd[part] * slope[part]
        spread[p.key] = float(here[0]) if p.size == 1 else [float(v) for v in here]
        limit = LIMITS.get(p.kind, np.inf)
        if p.key not in NUISANCE and (here.max() > limit or share[part].max() > PRIOR_SHARE):
            unidentified[p.key] = _bound(p, free[part], sd[part])
        numbers[p.key] = {
            "value": values[p.key],
            "sd": spread[p.key],
            "sd_noise": (deviation[part] * slope[part]).tolist(),
            "grid": (grid[part] * slope[part]).tolist(),
            "prior_share": float(share[part].max()),
        }
    strain = float(found["strain"])
    warnings = []
    if strain < STILL:
        warnings.append(f"no strain exceeds 1 % ({strain:.2%}): stiffness hardly shows")
    learnt = {k: v for k, v in values.items() if k not in unidentified and k not in NUISANCE}
    report = {
        "parameters": numbers,
        "unidentified": unidentified,
        "correlated": [[*pair, value] for pair, value in pairs.items()],
        "least_informed": least_informed(found["information"], labels, unknowns),
        "warnings": warnings,
        "rms": found["rms"],
        "per_frame": found["per_frame"],
        "strain": strain,
        "grids": found["grids"],
        "starts": [
            {"cost": t["cost"], "values": unknowns.values(np.asarray(t["free"]))} for t in tries
        ],
    }
    return Found(values, spread, pairs, unidentified, with_values(scene, learnt), report)


def _bound(p: Parameter, free: Array, sd: Array) -> str:
    """What can be said of a number that was not found."""
    low, high = p.value(free - 1.28 * sd), p.value(free + 1.28 * sd)
    if p.size == 1:
        return f"between {low[0]:.3g} and {high[0]:.3g} in four of five cases"
    return "within " + ", ".join(f"{a:.3g} to {b:.3g}" for a, b in zip(low, high, strict=True))


def least_informed(information: Any, labels: Sequence[str], unknowns: Unknowns) -> list[str]:
    """Directions of which the motion says less than what was believed before, in words."""
    spread = unknowns.spread
    scaled = np.asarray(information) * np.outer(spread, spread)  # 1: as much as the prior
    size, axes = np.linalg.eigh(scaled)
    words = []
    for amount, axis in zip(size, axes.T, strict=True):
        if amount >= 10.0:
            break
        main = [int(i) for i in np.argsort(-np.abs(axis)) if abs(axis[i]) > 0.3]
        flip = np.sign(axis[main[0]])
        told = [f"{labels[i]} {'up' if flip * axis[i] > 0 else 'down'}" for i in main]
        words.append(f"{' with '.join(told)}: {amount:.2g} times as sure as before")
    return words


def with_values(scene: Scene, values: Mapping[str, Any]) -> Scene:
    """A scene with other numbers of its bodies."""
    made = Scene.__new__(Scene)
    made.__dict__.update(scene.__dict__)
    made.bodies = []
    for body in scene.bodies:
        mine = {
            key.partition(".")[2]: value
            for key, value in values.items()
            if key.partition(".")[0] == body.name
        }
        motion: dict[str, Any] = {
            k: tuple(mine.pop(k)) for k in ("velocity", "angular_velocity") if k in mine
        }
        material = dataclasses.replace(body.material, **mine) if mine else body.material
        made.bodies.append(dataclasses.replace(body, material=material, **motion))
    return made
