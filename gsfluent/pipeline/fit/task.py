"""One search of a fit: picklable, so that a pool of processes or a cluster may do it."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsfluent.pipeline.fit.forward import Forward
from gsfluent.pipeline.fit.parameters import FINER, OFFSET, Parameter, Unknowns, read_learn
from gsfluent.pipeline.fit.solve import Problem, in_stages, run_at
from gsfluent.pipeline.fit.together import TooFast
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


@dataclasses.dataclass(frozen=True)
class Task:
    """One search.

    Attributes:
        scene: Where numbers that are not searched stay as they are.
        target: What was seen.
        unknowns: What is searched.
        start: Free coordinates.
        dx: Of the coarser grid [m].
        shares: Of the frames, by stage.
        grids: 1 or 2.
        judge: Search the last stage to its end, and see how well the frames after it are foretold.
        name: What tells it from searches of the same start.
        device: Where the solver runs.
    """

    scene: Scene
    target: Target
    unknowns: Unknowns
    start: list[float]
    dx: float
    shares: tuple[float, ...]
    grids: int = 1
    judge: bool = False
    name: str = ""
    device: str = "cpu"


def run_task(task: Task) -> dict[str, Any]:
    """Do one search; plain values come back."""
    times = list(task.target.times)
    make = functools.partial(Forward, task.scene, times, device=task.device)
    forward = make(task.dx)
    finer = make(task.dx / RATIO) if task.grids == 2 else None
    observer = task.target.observe(forward.setting())
    fine = None if finer is None else task.target.observe(finer.setting())
    problem = Problem(forward, observer, task.unknowns, task.target.step, fine=fine)
    try:
        found = in_stages(problem, np.asarray(task.start), finer=finer, shares=task.shares,
                         settle=task.judge or task.shares[-1] == 1.0,
                         weigh=not task.judge)  # fmt: skip
    except TooFast:
        return {"cost": float("inf"), "free": list(task.start), "runs": forward.runs}
    judged = judge(problem, found.free, task.shares[-1], finer) if task.judge else {}
    used = [g for g in (forward, finer) if g is not None]
    return {
        **{k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in vars(found).items()},
        **judged,
        "grids": [{"dx": g.dx, "points": g.count, "runs": g.runs} for g in used],
    }


def judge(
    problem: Problem, free: Array, share: float, finer: Forward | None = None
) -> dict[str, float]:
    """How well numbers foretell the frames that no search has seen.

    Args:
        problem: What was searched.
        free: What was found on the first frames.
        share: Of the frames, those that were seen.
        finer: The finer grid.

    Returns:
        ``seen`` and ``held_out``: root mean square residuals in standard deviations, infinite when
        the numbers cannot be run so far.
    """
    frames = len(problem.forward.times)
    count = max(2, round(share * frames))
    try:
        if finer is not None:
            problem.refine(finer, free, frames)
        problem.trust[:] = 1.0
        _, motion = run_at(problem, free, frames)
    except TooFast:
        return {"seen": np.inf, "held_out": np.inf}
    residual, frame = problem.seen(motion, frames, problem.observer.pair(motion))
    early, late = residual[frame < count], residual[frame >= count]
    return {
        name: float(np.sqrt(np.mean(part**2))) if len(part) else 0.0
        for name, part in (("seen", early), ("held_out", late))
    }


def one_by_one(function: Callable[[Any], Any], items: Iterable[Any]) -> list[Any]:
    """Call a function for every item, here."""
    return [function(item) for item in items]


def unknowns_of(
    scene: Scene,
    learn: Mapping[str, Mapping[str, Any]] | Sequence[str],
    *,
    grids: int = 2,
    offset: bool = True,
) -> Unknowns:
    """What is to be learnt, and what of the grid is learnt beside it.

    Args:
        scene: The start.
        learn: See :func:`read_learn`.
        grids: With 2, :data:`FINER` is learnt.
        offset: With a floor and no other collider, :data:`OFFSET` is learnt.

    Raises:
        InputError: See :func:`read_learn`.
    """
    more = []
    if offset and scene.floor is not None and not scene.colliders:
        more.append(Parameter(OFFSET, (OFFSET_PRIOR[0],), spread=OFFSET_PRIOR[1]))
    if grids == 2:
        more.append(Parameter(FINER, (EXTRAPOLATION[0],), spread=EXTRAPOLATION[1]))
    return Unknowns([*read_learn(scene, learn).parameters, *more])
