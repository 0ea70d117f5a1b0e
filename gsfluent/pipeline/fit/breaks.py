"""Numbers of matter that breaks, from the statistics of its pieces.

Where a piece goes is chance, so no derivative says anything: CMA-ES (Hansen and Ostermeier 2001)
searches, each candidate simulated under several seeds, the same ones for all. What a statistic is
off by counts in units of its spread over seeds. A quadratic through the best candidates gives the
bands (docs/theory/fit.md).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from gsfluent.errors import InputError
from gsfluent.materials.laws import RANGES, READS
from gsfluent.materials.material import nearest
from gsfluent.pipeline.fit.parameters import WIDE, places
from gsfluent.pipeline.fit.stage import Found, with_values
from gsfluent.pipeline.fit.task import Runner, one_by_one
from gsfluent.pipeline.matter.points import grid_spacing
from gsfluent.pipeline.simulate.stage import Simulate
from gsfluent.pipeline.stage import Stage
from gsfluent.progress import Progress, report_progress
from gsfluent.scene.scene import Scene
from gsfluent.targets.pieces import GROUPS, Pieces, statistics

Array = NDArray[np.float64]
NUMBERS = ("young_modulus", "cohesion", "hardening", "alpha0", "tensile_strength",
           "compressive_strength", "fracture_energy")  # fmt: skip
"""What can be learnt; the logarithm of its size is searched."""
WIDTH, FAR = 0.3, 1.5
"""First deviation of the candidates, and how far the search goes from its start [decades]."""
FEW = {"masses": 0.01, "places": 0.002, "broken": 0.01}
"""Least spread that chance is believed to have: shares, metres, share."""


@dataclasses.dataclass(frozen=True)
class Break:
    """One simulation of a candidate: picklable."""

    scene: Scene
    dx: float
    time: float
    seed: int
    device: str = "cpu"


def run_break(task: Break) -> dict[str, list[float]]:
    """Simulate, and take the statistics of the pieces at the end."""
    run = Simulate(dx=task.dx, seed=task.seed, repair=False, device=task.device)
    last = list(run(task.scene, fps=1.0 / task.time, seconds=2.0 * task.time))[-1]  # the second
    mass = last.particles.mass.double().cpu()
    label = last.fragments.cpu().long()
    whole, where = label >= 0, last.particles.position.double().cpu()
    dust = float(mass[(last.damage >= 1.0).cpu()].sum() / mass.sum())
    kept, weight = label[whole], mass[whole]
    count = int(kept.max()) + 1 if len(kept) else 0
    sums = torch.zeros(count, dtype=torch.float64).index_add_(0, kept, weight)
    centres = torch.zeros(count, 3, dtype=torch.float64)
    centres.index_add_(0, kept, weight[:, None] * where[whole])
    there = sums > 0.0
    if not bool(there.any()):  # all is dust: one heap
        sums, centres = mass.sum()[None], (mass[:, None] * where).sum(dim=0)[None]
        there = sums > 0.0
    centres = centres[there] / sums[there, None]
    found = statistics(sums[there].numpy(), centres.numpy(), dust)
    return {name: values.tolist() for name, values in found.items()}


class FitPieces(Stage):
    """Learns what makes a thing break as it did.

    Args:
        learn: ``OBJECT.NUMBER`` or ``OBJECT/PART.NUMBER`` each, at most six; numbers that its
            material has.
        seeds: Simulations of each candidate.
        rounds: Generations of the search.
        cells: Cells along the longest side of the largest body: those of the runs that follow, for
            how matter breaks hangs on them.
        device: Where simulations run.
        seed: Of the candidates.
        runner: Does the simulations.

    Raises:
        InputError: A number out of range.
    """

    name = "fit_pieces"

    def __init__(
        self, learn: Sequence[str], *, seeds: int = 8, rounds: int = 12, cells: int = 16,
        device: torch.device | str = "cpu", seed: int = 0, runner: Runner = one_by_one,
    ) -> None:  # fmt: skip
        super().__init__(seed=seed)
        for name, value, low, high in (
            ("seeds", seeds, 2, 1000), ("rounds", rounds, 1, 1000), ("cells", cells, 4, 256),
            ("numbers", len(learn), 1, 6),
        ):  # fmt: skip
            if not low <= value <= high:
                raise InputError(f"fit: {name} is {value}", f"give a number from {low} to {high}")
        self.learn, self.seeds, self.rounds, self.cells = list(learn), seeds, rounds, cells
        self.device, self.runner = str(torch.device(device)), runner

    def forward(self, scene: Scene, target: Pieces, *, progress: Progress | None = None) -> Found:
        """Learn.

        Args:
            scene: The start.
            target: The pieces.
            progress: Told after each generation.

        Raises:
            InputError: What is to be learnt cannot be.
        """
        begun = read_numbers(scene, self.learn)
        sign = {key: math.copysign(1.0, value) for key, value in begun.items()}
        start = np.log10(np.abs(list(begun.values())))
        dx = grid_spacing(scene, self.cells)

        def values_of(free: Array) -> dict[str, float]:
            return {k: sign[k] * 10.0 ** float(v) for k, v in zip(begun, free, strict=True)}

        def simulated(frees: Sequence[Array]) -> list[dict[str, Array]]:
            tasks = [
                Break(with_values(scene, values_of(free)), dx, target.time, k, self.device)
                for free in frees for k in range(self.seeds)
            ]  # fmt: skip
            done = self.runner(run_break, tasks)
            size = self.seeds
            return [_stacked(done[k : k + size]) for k in range(0, len(done), size)]

        first = simulated([start])[0]
        chance = {g: np.maximum(first[g].std(axis=0, ddof=1), FEW[g]) for g in GROUPS}

        def costs(frees: Sequence[Array]) -> list[float]:
            return [cost_of(made, target.wanted, chance) for made in simulated(frees)]

        def tell(number: int, best: float) -> None:
            report_progress(progress, number, self.rounds, f"cost {best:.3g}")

        tried, cost = cma(costs, start, self.rounds, self.seed, tell)
        best = tried[int(np.argmin(cost))]
        sd = bands(tried, cost)
        values = values_of(best)
        unsure = {k: "a break at these numbers looks alike" for k, s in zip(values, sd, strict=True)
                  if not s < 0.3}  # fmt: skip
        report = {
            "parameters": {k: {"value": v, "sd": float(s), "start": begun[k]}
                           for (k, v), s in zip(values.items(), sd, strict=True)},
            "unidentified": unsure, "cost": float(np.min(cost)), "warnings": [],
            "cost_of_start": cost_of(first, target.wanted, chance),
            "runs": self.seeds * (len(tried) + 1),
            "tried": [{"values": values_of(f), "cost": float(c)}
                      for f, c in zip(tried, cost, strict=True)],
        }  # fmt: skip
        learnt = {k: v for k, v in values.items() if k not in unsure}
        deviation = dict(zip(values, sd.tolist(), strict=True))
        return Found(values, deviation, {}, unsure, with_values(scene, learnt), report)


def _stacked(runs: Sequence[dict[str, list[float]]]) -> dict[str, Array]:
    return {g: np.asarray([run[g] for run in runs]) for g in GROUPS}


def cost_of(
    made: dict[str, Array], wanted: dict[str, Array], chance: dict[str, Array]
) -> float:  # fmt: skip
    """Half the sum over groups of the mean square of what the mean over seeds is off by.

    What lies in one group goes together, so a group counts as one number.
    """
    parts = [np.mean(((made[g].mean(axis=0) - wanted[g]) / chance[g]) ** 2) for g in wanted]
    return 0.5 * float(np.sum(parts))


def read_numbers(scene: Scene, learn: Sequence[str]) -> dict[str, float]:
    """Where the search starts.

    Raises:
        InputError: No such object, a number that its law does not read or that it does not have.
    """
    made, found = places(scene), {}
    for key in learn:
        place, _, field = key.partition(".")
        if place not in made:
            raise InputError(f"learn: no object {place!r}", nearest(place, made))
        known = [name for name in NUMBERS if name in READS[made[place].law]]
        if field not in known:
            raise InputError(f"learn: {key}: not from pieces", nearest(field, known))
        value = getattr(made[place], field)
        if not isinstance(value, int | float) or value == 0.0:
            raise InputError(f"learn: {key} is {value!r}", "give one number to start from")
        low, high, unit = RANGES[field]
        if not low <= value <= high:
            raise InputError(f"learn: {key} is {value:g}", f"give {low:g} to {high:g} {unit}")
        found[key] = float(value)
    return found


def cma(
    costs: Callable[[Sequence[Array]], list[float]],
    start: Array,
    rounds: int,
    seed: int,
    tell: Callable[[int, float], None] = lambda number, best: None,
) -> tuple[Array, Array]:
    """CMA-ES with its standard numbers (Hansen 2016), inside a box of :data:`FAR`.

    Args:
        costs: Of candidates [P] each.
        start: [P].
        rounds: Generations of ``4 + 3 ln P``.
        seed: Of the candidates.
        tell: Told the number of each generation and the best cost so far.

    Returns:
        All candidates [K, P] and their costs [K]; the first is the start.
    """
    size = len(start)
    many = 4 + int(3 * math.log(size)) if size > 1 else 4
    weight = math.log((many + 1) / 2) - np.log(np.arange(1, many // 2 + 1))
    weight /= weight.sum()
    mass = 1.0 / float((weight**2).sum())
    along = (4 + mass / size) / (size + 4 + 2 * mass / size)
    pull = (mass + 2) / (size + mass + 5)
    one = 2 / ((size + 1.3) ** 2 + mass)
    rank = min(1 - one, 2 * (mass - 2 + 1 / mass) / ((size + 2) ** 2 + mass))
    damp = 1 + 2 * max(0.0, math.sqrt((mass - 1) / (size + 1)) - 1) + pull
    expected = math.sqrt(size) * (1 - 1 / (4 * size) + 1 / (21 * size**2))
    random = np.random.default_rng(seed)
    mean, width, shape = start.copy(), WIDTH, np.eye(size)
    path, short = np.zeros(size), np.zeros(size)
    tried, found = [start.copy()], costs([start])
    for number in range(1, rounds + 1):
        value, axes = np.linalg.eigh(shape)
        root = np.sqrt(np.maximum(value, 1e-20))
        steps = (random.standard_normal((many, size)) * root) @ axes.T
        made = np.clip(mean + width * steps, start - FAR, start + FAR)
        cost = costs(list(made))
        tried += list(made)
        found += cost
        best = made[np.argsort(cost, kind="stable")[: len(weight)]]
        moved = (weight @ best - mean) / width
        each = (best - mean) / width
        mean = mean + width * moved
        short = (1 - pull) * short + math.sqrt(pull * (2 - pull) * mass) * (
            axes @ ((axes.T @ moved) / root)
        )
        length = float(np.linalg.norm(short))
        held = (
            length / math.sqrt(1 - (1 - pull) ** (2 * number)) < (1.4 + 2 / (size + 1)) * expected
        )
        path = (1 - along) * path + held * math.sqrt(along * (2 - along) * mass) * moved
        shape = (
            (1 - one - rank) * shape + one * np.outer(path, path)
            + rank * (each.T * weight) @ each
        )  # fmt: skip
        width = min(width * math.exp((pull / damp) * (length / expected - 1)), FAR)
        tell(number, float(np.min(found)))
    return np.stack(tried), np.asarray(found)


def bands(tried: Array, cost: Array) -> Array:
    """Standard deviations by a quadratic through the best candidates and a wide prior, [P]."""
    size = tried.shape[1]
    pairs = [(i, j) for i in range(size) for j in range(i, size)]
    few = max(3 * size, 2 * (1 + size + len(pairs)))
    rows = np.argsort(cost, kind="stable")[:few]
    if len(rows) < 1 + size + len(pairs):
        return np.full(size, WIDE)
    from_best = tried[rows] - tried[rows[0]]
    unit = np.maximum(np.abs(from_best).max(axis=0), 1e-12)
    u = from_best / unit
    terms = [np.ones(len(u)), *u.T, *(u[:, i] * u[:, j] for i, j in pairs)]
    solved = np.linalg.lstsq(np.stack(terms, axis=1), cost[rows], rcond=None)[0]
    bend = np.zeros((size, size))
    for (i, j), value in zip(pairs, solved[1 + size :], strict=True):
        bend[i, j] += value
        bend[j, i] += value
    bend /= np.outer(unit, unit)
    slope, axes = np.linalg.eigh(bend)
    known = (axes * np.maximum(slope, 0.0)) @ axes.T + np.eye(size) / WIDE**2
    return np.asarray(np.sqrt(np.diag(np.linalg.inv(known))))
