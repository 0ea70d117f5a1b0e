"""What a finer simulation of a probed shot would take, from the work that the probes did."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence

import numpy as np
import torch

from gsfluent.choose.probe import Probe
from gsfluent.pipeline.simulate.engine import CFL
from gsfluent.plan.cost import CostModel
from gsfluent.plan.work import laws_of
from gsfluent.scene.scene import Scene

__all__ = ["Work", "cost_of", "measured_rates", "work_of"]

Seconds = Callable[[int, float], float]


@dataclasses.dataclass(frozen=True)
class Work:
    """What a simulation does."""

    steps: float  # Steps of the grid
    points: float  # Points on it in the mean step
    blocks: float  # Blocks in use in the mean step
    composed: float  # Steps of the composable operators, among them


def cost_of(
    whole: Sequence[Probe],
    levels: Sequence[Sequence[Probe]],
    scene: Scene,
    device: torch.device | str,
    model: CostModel | None = None,
) -> tuple[Seconds, str]:
    """Wall time of the whole simulation by cells and Courant number, and where it comes from.

    Args:
        whole: Runs over the whole shot, coarse to fine.
        levels: All probes.
        scene: The scene, for its laws.
        device: Where it would run.
        model: The machine's cost model; the stored one when None. Its times are multiplied by what
            the finest probes took over what it says of them. Without one the probes' own times
            are carried on.
    """
    every = [p for level in levels for p in level]
    model = CostModel.load(device) if model is None else model
    if model is None:
        per_step, per_point = measured_rates(every)

        def measured(cells: int, cfl: float) -> float:
            work = work_of(whole, cells, cfl)
            return work.steps * (per_step + per_point * work.points)

        return measured, "the probes' own times"
    known, fields = model, max(p.fields for p in every)
    laws = laws_of(scene)

    def said(work: Work) -> float:
        return known.predict(
            work.points, work.blocks, work.steps, fields=fields, laws=laws,
            composed_steps=work.composed,
        ).seconds  # fmt: skip

    finest = min(levels[-1], key=lambda p: p.seconds)
    predicted = said(_done(finest))
    factor = finest.seconds / predicted if predicted > 0.0 and finest.seconds > 0.0 else 1.0
    source = f"the cost model, times {factor:.2f} as the probes took"
    return (lambda cells, cfl: factor * said(work_of(whole, cells, cfl))), source


def _done(run: Probe) -> Work:
    """What a probe did."""
    steps = max(run.steps, 1)
    return Work(run.steps, float(run.point_steps[-1]) / steps, run.blocks, run.composed)


def work_of(whole: Sequence[Probe], cells: int, cfl: float) -> Work:
    """What the whole shot would do at a setting.

    Points go as the cube of the cells; steps and blocks by the power of the cells that the two runs
    show, steps over the Courant number.
    """
    first, last = whole[0], whole[-1]
    ratio, done = cells / last.cells, _done(last)
    apart = math.log(last.cells / first.cells)

    def power(coarse: float, fine: float, usual: float, low: float, high: float) -> float:
        if coarse <= 0.0 or fine <= 0.0 or apart <= 0.0:
            return usual
        return min(max(math.log(fine / coarse) / apart, low), high)

    faster = CFL / cfl * ratio ** power(first.steps, last.steps, 1.0, 0.5, 1.5)
    return Work(
        steps=done.steps * faster,
        points=done.points * ratio**3,
        blocks=done.blocks * ratio ** power(first.blocks, last.blocks, 3.0, 2.0, 3.0),
        composed=done.composed * faster,
    )


def measured_rates(probes: Sequence[Probe]) -> tuple[float, float]:
    """Seconds per step, and per step and point, from the probes' own times.

    Of the seeds of a level the fastest counts: nothing makes a run faster than it is.
    """
    best: dict[tuple[int, float], tuple[float, float]] = {}
    for p in probes:
        if p.steps == 0 or not p.point_steps.size:
            continue
        step = p.seconds / p.steps
        points = float(p.point_steps[-1]) / p.steps
        key = (p.cells, p.cfl)
        if key not in best or step < best[key][0]:
            best[key] = (step, points)
    if not best:
        return 0.0, 0.0
    took, points = np.array(list(best.values())).T
    matrix = np.stack([np.ones_like(points), points], axis=1)
    # relative errors: the small runs say what a step costs, the large ones what a point does
    fixed, each = np.linalg.lstsq(matrix / took[:, None], np.ones_like(took), rcond=None)[0]
    if each <= 0.0:
        return 0.0, float((took / points).min())
    if fixed < 0.0:
        return 0.0, float(np.median(took / points))
    return float(fixed), float(each)
