"""What a finer simulation of a probed shot would take, from the work that the probes did."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch

from gsfluent.config import Shot
from gsfluent.pipeline.choose_probe import Probe
from gsfluent.pipeline.simulate_solver import CFL
from gsfluent.scene import Scene

__all__ = ["cost_of", "measured_rates", "work_of"]

Seconds = Callable[[int, float], float]


def cost_of(
    whole: Sequence[Probe],
    levels: Sequence[Sequence[Probe]],
    scene: Scene,
    shot: Shot,
    device: torch.device | str,
) -> tuple[Seconds, str]:
    """Wall time of the whole simulation by cells and Courant number, and where it comes from.

    Args:
        whole: Runs over the whole shot, coarse to fine.
        levels: All probes.
        scene: The scene.
        shot: The shot.
        device: Where it would run.
    """
    per_step, per_point = measured_rates([p for level in levels for p in level])

    def seconds(cells: int, cfl: float) -> float:
        steps, points = work_of(whole, cells, cfl)
        return steps * (per_step + per_point * points)

    return seconds, "the probes' own times"


def work_of(whole: Sequence[Probe], cells: int, cfl: float) -> tuple[float, float]:
    """Steps of the grid, and points on it in the mean step, of the whole shot at a setting.

    Points go as the cube of the cells. Steps go as the cells over the Courant number, or a little
    slower where colliders and frames bound them: by the power that the two runs show.
    """
    first, last = whole[0], whole[-1]
    ratio = cells / last.cells
    power = 1.0
    if first.steps > 0 and last.steps > 0 and last.cells > first.cells:
        shown = np.log(last.steps / first.steps) / np.log(last.cells / first.cells)
        power = float(np.clip(shown, 0.5, 1.5))
    steps = last.steps * ratio**power * (CFL / cfl)
    mean = float(last.point_steps[-1]) / max(last.steps, 1)
    return steps, mean * ratio**3


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
