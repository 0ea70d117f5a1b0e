"""The cheapest setting that meets an error on a shot of one's own: ``gsfluent chart SHOT --error``.

Nothing about the truth is known, so the shot is run a few times on coarse grids, from just before
something happens and for few frames; how fast the answers draw together tells how far the coarse
ones are from where they are going (:mod:`gsfluent.choose.fit`), and what a finer grid
would cost is told by the cost model. ``solve: {error: 3%}`` does the same within ``gsfluent run``.
"""

from __future__ import annotations

import dataclasses
import logging
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch

from gsfluent.choose.fit import Fit, History, fit_histories
from gsfluent.choose.pick import CELLS, Choice, pick, ranked
from gsfluent.choose.probe import Probe, distance, histories, probe, window
from gsfluent.choose.seconds import cost_of
from gsfluent.config import Shot
from gsfluent.errors import InputError
from gsfluent.pipeline.simulate.engine import CFL
from gsfluent.progress import Progress, report_progress
from gsfluent.scene.scene import Scene
from gsfluent.stages.simulate import solver_options

_log = logging.getLogger(__name__)

LEVELS = (10, 14, 20)
"""Cells of the probes: the finest has half of those of ``quality: shot``."""
FRAMES = 12
LONG_STEP = 0.7
"""The other Courant number that is offered."""


@dataclasses.dataclass(frozen=True)
class Probing:
    """How a shot is probed."""

    levels: tuple[int, ...] = LEVELS  # Cells of the probes, coarse to fine, at least three
    frames: int = FRAMES  # Frames from just before something happens
    seeds: int | None = None  # Runs per level; None: three where something can break, else two
    cfl: tuple[float, ...] = (LONG_STEP,)  # Courant numbers to offer beside 0.5

    def __post_init__(self) -> None:
        if len(self.levels) < 3 or list(self.levels) != sorted(set(self.levels)):
            raise InputError(
                f"probes need three or more growing numbers of cells, got {list(self.levels)}",
                "for example 10 14 20",
            )
        if min(self.levels) < 6 or self.frames < 2 or (self.seeds or 2) < 2:
            raise InputError(
                "probes need 6 cells, 2 frames and 2 seeds at least",
                "for example levels 10 14 20, frames 12, seeds 2",
            )


QUICK = Probing(levels=(8, 10, 12), frames=6, seeds=2)


@dataclasses.dataclass(frozen=True)
class Growth:
    """Factors from the window to the end of the shot, by observable."""

    mean: Mapping[str, float]  # On the error of the mean of many runs
    spread: Mapping[str, float]  # On the scatter between runs


@dataclasses.dataclass(frozen=True)
class Probes:
    """What was run."""

    whole: tuple[Probe, Probe]  # Over the whole shot: the first runs of the two coarsest levels
    # All levels by seed, at least to the end of the window; the two coarsest to the end where
    # matter breaks, else their first seeds.
    levels: tuple[tuple[Probe, ...], ...]
    # With the longer steps, Courant number to its runs on the middle level.
    long: Mapping[float, tuple[Probe, ...]]
    first: int  # First frame of the window
    last: int  # Last frame + 1
    fps: float  # Frames per second

    @property
    def seconds(self) -> float:
        """Wall time of all runs [s]."""
        every = [p for level in (*self.levels, *self.long.values()) for p in level]
        return sum(p.seconds for p in {id(p): p for p in (*self.whole, *every)}.values())


def run_probes(
    scene: Scene,
    shot: Shot,
    probing: Probing,
    *,
    device: torch.device | str = "cpu",
    seed: int = 0,
    progress: Progress | None = None,
) -> Probes:
    """Run the probes of a scene.

    Args:
        scene: The scene of the shot.
        shot: For its frames and what its ``solve`` leaves as it is.
        probing: How.
        device: Where to compute.
        seed: Of the first run of each level; the others follow it.
        progress: Told after every run.

    Raises:
        InputError: A probe broke off.
    """
    fps, total = shot.output.fps, max(2, round(shot.output.fps * shot.output.seconds))
    done, seeds = 0, probing.seeds or 2

    def go(cells: int, number: int, frames: int, cfl: float = CFL) -> Probe:
        nonlocal done
        found = probe(
            scene, cells, fps=fps, frames=frames, seed=seed + number, device=device,
            options=dataclasses.replace(solver_options(shot), cfl=cfl),
        )  # fmt: skip
        if found.failed:
            raise InputError(
                f"the probe at {cells} cells broke off: {found.failed}",
                "change the shot as it says, or set solve.quality instead of solve.error",
            )
        done += 1
        runs = len(probing.levels) * seeds + len(probing.cfl) * seeds
        report_progress(progress, min(done, runs), runs, f"{cells} cells, seed {number}")
        return found

    coarse = go(probing.levels[0], 0, total)
    first, last = window(coarse.seen, probing.frames)
    breaks = bool((coarse.seen.broken > 0.0).any())
    if probing.seeds is None and breaks:
        seeds = 3
    second = go(probing.levels[1], 0, total)
    levels = []
    for at, cells in enumerate(probing.levels):
        known = [coarse, second][at : at + 1]
        until = total if at < 2 and breaks else last
        levels.append((*known, *(go(cells, n, until) for n in range(len(known), seeds))))
    middle = probing.levels[1]
    long = {cfl: tuple(go(middle, n, last, cfl) for n in range(seeds)) for cfl in probing.cfl}
    report_progress(progress, done, done, "probed")
    return Probes((coarse, second), tuple(levels), long, first, last, fps)


def choose_setting(
    probes: Probes,
    bound: float,
    seconds: Callable[[int, float], float],
    *,
    cells: Sequence[int] = CELLS,
) -> tuple[Choice, list[Fit], Growth]:
    """Fit, extrapolate and choose; ``seconds``: of the whole simulation by cells and CFL [s].

    Returns:
        The choice, the fits, and the growth from the window to the whole shot.
    """
    scale = probes.whole[0].seen
    shown = histories(probes.levels, probes.first, probes.last, scale)
    fits = fit_histories(shown)
    growth, spread = _growth(probes)
    steps: dict[float, dict[str, tuple[float, float]]] = {CFL: {}}
    for cfl, runs in probes.long.items():
        steps[cfl] = _step_error(shown, histories([runs], probes.first, probes.last, scale))
    settings = ranked(fits, bound, seconds, growth=growth, spread=spread, steps=steps, cells=cells)
    return pick(fits, settings, bound, spread=spread), fits, Growth(growth, spread)


def _growth(probes: Probes) -> tuple[dict[str, float], dict[str, float]]:
    """Factors from the window to the end of the shot, by observable.

    On the error of the mean: what two coarse levels differ by beyond chance from the window's first
    frame on, over the same in the window. On the scatter: that of the finer one of them. Frames
    before anything happens have no error and would only dilute it.
    """
    total = min(probe.seen.frames for probe in probes.whole)
    pair = [[p for p in level if p.seen.frames >= total] for level in probes.levels[:2]]
    change: list[dict[str, float]] = []
    chance: list[dict[str, float]] = []
    for first, last in ((probes.first, probes.last), (probes.first, total)):
        shown = histories(pair, first, last, probes.whole[0].seen)
        change.append({})
        chance.append({})
        for h in shown:
            bands = dict(h.bands)
            gap = distance(h.values[0].mean(axis=0), h.values[1].mean(axis=0))
            off = sum(
                bands.get(size, 0.0) ** 2 / runs.shape[0]
                for size, runs in zip(h.sizes, h.values, strict=True)
            )
            change[-1][h.name] = math.sqrt(max(0.0, gap**2 - off))
            chance[-1][h.name] = bands.get(h.sizes[1], 0.0)

    def ratio(pair: list[dict[str, float]]) -> dict[str, float]:
        inside, whole = pair
        return {
            name: value / inside[name] if value > 0.0 and inside.get(name, 0.0) > 0.0 else 1.0
            for name, value in whole.items()
        }

    return ratio(change), ratio(chance)


def _step_error(
    usual: Sequence[History], longer: Sequence[History]
) -> dict[str, tuple[float, float]]:
    """What a longer step changes on the middle level, and the size of its cells, by observable.

    Of the difference between the means, what their scatter explains is taken off.
    """
    found = {}
    by_name = {history.name: history for history in longer}
    for history in usual:
        if history.name not in by_name:  # nothing has broken with the longer step
            continue
        runs, size = history.values[1], history.sizes[1]
        gap = distance(runs.mean(axis=0), by_name[history.name].values[0].mean(axis=0))
        chance = 2.0 * history.scatter(size) ** 2 / runs.shape[0]
        found[history.name] = (math.sqrt(max(0.0, gap**2 - chance)), size)
    return found


def choose(
    scene: Scene,
    shot: Shot,
    bound: float,
    *,
    probing: Probing | None = None,
    device: torch.device | str = "cpu",
    seed: int = 0,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Probe a scene and choose.

    Returns:
        ``chart.json``: see docs/theory/plan.md.

    Raises:
        InputError: A probe broke off, or the scene is empty.
    """
    probing = probing or Probing()
    probing = dataclasses.replace(probing, cfl=safe_steps(scene, probing.cfl))
    probes = run_probes(scene, shot, probing, device=device, seed=seed, progress=progress)
    seconds, source = cost_of(probes.whole, probes.levels, scene, device)
    choice, fits, growth = choose_setting(probes, bound, seconds)
    _log.info("chart: %s", choice.reason)
    return summary(choice, fits, growth, probes, probing, source) | {"device": str(device)}


def summary(
    choice: Choice,
    fits: Sequence[Fit],
    growth: Growth,
    probes: Probes,
    probing: Probing,
    source: str,
) -> dict[str, Any]:
    """Plain values of a choice."""

    def plain(setting: Any) -> dict[str, Any]:
        return {
            k: _rounded(v) if isinstance(v, float) else v
            for k, v in dataclasses.asdict(setting).items()
        } | {"parts": {k: _rounded(v) for k, v in setting.parts.items()}}

    chosen = choice.chosen
    return {
        "bound": choice.bound,
        "met": chosen is not None,
        "chosen": None if chosen is None else plain(chosen),
        "enough": None if choice.enough is None else plain(choice.enough),
        "sure": _rounded(choice.sure),
        "reason": choice.reason,
        "within": _rounded(choice.within) if math.isfinite(choice.within) else None,
        "floor": _rounded(choice.floor),
        "floor_of": choice.floor_of,
        "asymptotic": choice.asymptotic,
        "settings": [plain(setting) for setting in choice.settings],
        "observables": [
            {
                "name": fit.name,
                "order": _rounded(fit.order),
                "order_spread": _rounded(float(fit.orders.std())),
                "error_finest": _rounded(float(np.median(fit.error))),
                "band": _rounded(fit.history.band),
                "growth": _rounded(growth.mean.get(fit.name, 1.0)),
                "spread": _rounded(growth.spread.get(fit.name, 1.0)),
                "misfit": _rounded(fit.misfit),
                "parallel": _rounded(fit.parallel),
                "asymptotic": fit.asymptotic,
            }
            for fit in fits
        ],
        "probe": {
            "cells": list(probing.levels),
            "seeds": len(probes.levels[-1]),
            "frames": [probes.first, probes.last],
            "of_frames": probes.whole[0].seen.frames,
            "seconds": _rounded(probes.seconds),
        },
        "seconds_from": source,
    }


def _rounded(value: float) -> float:
    return float(f"{value:.4g}")


ROOM = 1.04
"""Share by which a Courant number must stay below the limit. At rest the limit is exact; the
automatic step counts the speed too, which is further room."""


_WHOLE = ("elastic", "corotated", "rigid", "fluid")
"""Laws whose matter stays together, or bears no shear and no tension."""


def loose_limit(poisson_ratio: float) -> float:
    """Largest stable ``c dt / dx`` of a point that nothing else holds, ``sqrt((1 - nu)/(1 + nu))``.

    All nodes are its own, so a step changes its velocity gradient by ``-4 dt / (rho dx^2) tau``: an
    oscillator of its volume with ``omega^2 = 12 K / (rho dx^2)``, which symplectic Euler keeps up
    to ``omega dt = 2``. Measured within 3 %, also on clusters of 2 to 8 points
    (docs/theory/stability.md).

    Args:
        poisson_ratio: nu, above -1 and below 0.5.
    """
    return math.sqrt((1.0 - poisson_ratio) / (1.0 + poisson_ratio))


def safe_steps(scene: Scene, courant: Sequence[float]) -> tuple[float, ...]:
    """Those Courant numbers that loose pieces of a scene's matter would bear.

    Args:
        scene: The scene; bodies of laws that do not come apart are not asked.
        courant: Courant numbers.
    """
    most = math.inf
    for body in scene.bodies:
        for material in (body.material, *(part.material(body.material) for part in body.parts)):
            if material.law not in _WHOLE:
                most = min(most, loose_limit(float(torch.as_tensor(material.poisson_ratio).max())))
    return tuple(number for number in courant if number * ROOM <= most)
