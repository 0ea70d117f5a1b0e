"""How the error of a setting falls with the size of the cells, from runs that know no truth.

Richardson extrapolation of whole histories: on cells of size ``h`` an observable is
``f(h) = f* + c h^p``, with ``c`` a history of its own and one order ``p``. ``p`` is searched in
0.5..2, the range in which quadratic B-splines converge (2 inside, about 1 at free surfaces), as
Eca and Hoekstra (2014), J. Comput. Phys. 262, section 3, do for grid studies of flows. What the
probes leave open is drawn at random: the order by how well each value of it fits, the histories by
their scatter between seeds. The same numbers give the same draws.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

ORDERS = (0.5, 2.0)
"""Least and largest order of convergence that is believed."""
DRAWS = 400
_GRID = 61
_SMALL = 1e-12


@dataclasses.dataclass(frozen=True)
class History:
    """One observable on several levels of cells."""

    name: str  # What it is
    sizes: tuple[float, ...]  # Size of the cells of each level, coarse to fine, [L]; any unit
    # Per level the history of each seed, [S, T, K]: S seeds, T moments, K components; in units of
    # the observable's own scale, so that 0.03 is an error of 3 %.
    values: tuple[Array, ...]
    # Runs differ by chance on every level alike (matter has broken): the scatter between seeds does
    # not shrink with the cells.
    chaotic: bool = False
    most: float = math.inf  # No error is larger: 1 for shares

    @property
    def band(self) -> float:
        """Run-to-run band on the finest level that has several seeds: rms over the history."""
        return self.bands[-1][1] if self.bands else 0.0

    @property
    def bands(self) -> list[tuple[float, float]]:
        """Size of the cells and rms scatter of a single run, of all levels with several seeds."""
        found = []
        for size, runs in zip(self.sizes, self.values, strict=True):
            if runs.shape[0] > 1:
                variance = runs.var(axis=0, ddof=1)
                found.append((size, math.sqrt(float(variance.sum(axis=-1).mean()))))
        return found

    def scatter(self, size: float) -> float:
        """Scatter of a single run at a size of cells.

        For what is chaotic it is the mean of the levels at every size, without the coarsest, whose
        few points scatter most; else it is that of sampling the points and falls with the cells, in
        proportion at most.
        """
        bands = self.bands
        if not bands:
            return 0.0
        if self.chaotic:
            bands = bands[1:] or bands
            return math.sqrt(sum(b * b for _, b in bands) / len(bands))
        return size * math.sqrt(sum((b / h) ** 2 for h, b in bands) / len(bands))


@dataclasses.dataclass(frozen=True)
class Fit:
    """The error of one observable by size of cells."""

    name: str  # What it is
    order: float  # Best fitting order
    orders: Array  # Orders drawn, [D]
    error: Array  # Rms error of the mean at the finest level, drawn, [D]
    chance: Array  # Factor on the scatter, drawn, [D]: few seeds do not know it well
    finest: float  # Size of the cells of that level
    misfit: float  # Rms of what the law does not explain over the change that it does explain
    parallel: float  # Cosine between the successive changes; 1 is steady convergence
    history: History  # The data

    def mean_errors(self, size: float) -> Array:
        """Drawn rms errors of the mean of many runs at a size of cells, [D]."""
        return np.asarray(self.error * (size / self.finest) ** self.orders)

    def gaps(self, size: float, finer: float, growth: float = 1.0, spread: float = 1.0) -> Array:
        """Drawn rms differences of one run from the mean of many on finer cells, [D].

        What both are off by in the same direction is not in it. ``growth`` is a factor on the
        difference of the means, ``spread`` one on the scatter.
        """
        return self.around(
            growth * (self.mean_errors(size) - self.mean_errors(finer)), size, spread
        )

    def errors(self, size: float) -> Array:
        """Drawn rms errors of one run at a size of cells, [D]: of the mean, and its scatter."""
        return self.around(self.mean_errors(size), size)

    def around(self, mean: Array, size: float, spread: float = 1.0) -> Array:
        """Drawn rms errors of one run, [D], from those of the mean and the scatter at a size."""
        whole = np.hypot(mean, spread * self.chance * self.history.scatter(size))
        return np.asarray(np.minimum(whole, self.history.most))

    @property
    def asymptotic(self) -> bool:
        """Whether the changes follow a power of the cells at all.

        Where they are no larger than the scatter there is nothing to follow, and nothing wrong.
        """
        first, last = self.history.values[0], self.history.values[-1]
        change = _rms(first.mean(axis=0) - last.mean(axis=0))
        noise = self.history.scatter(self.finest)
        if change <= max(noise, _SMALL):
            return True
        return bool(self.misfit < 0.5 and self.parallel > 0.0 and self.order > ORDERS[0])


def fit_histories(histories: Sequence[History], *, seed: int = 0, draws: int = DRAWS) -> list[Fit]:
    """Fit all observables of a shot.

    They come from the same runs of the same method: what one leaves open about the order, the
    others tell, together as much as one of them would.
    """
    likely = [_likely(history) for history in histories]
    found = []
    for number, history in enumerate(histories):
        others = likely[:number] + likely[number + 1 :]
        prior = np.mean(others, axis=0) if others else None
        found.append(fit_history(history, seed=seed, draws=draws, prior=prior))
    return found


def _likely(history: History) -> Array:
    """Logarithm of the likelihood of each order, [G], its greatest 0."""
    sizes = np.asarray(history.sizes) / history.sizes[-1]
    means = np.stack([runs.mean(axis=0).reshape(-1) for runs in history.values])
    grid = np.linspace(*ORDERS, _GRID)
    residual = _solve(means, sizes, grid)[0]
    power = 0.5 * _data(means, sizes, grid[residual.argmin()], history) * (sizes.size - 2)
    # what chance explains says nothing against an order
    chance = sum(
        history.scatter(size) ** 2 * runs.shape[1] / runs.shape[0]
        for size, runs in zip(history.sizes, history.values, strict=True)
    )
    floor = chance + _SMALL
    return np.asarray(power * np.log((residual.min() + floor) / (residual + floor)))


def fit_history(
    history: History, *, seed: int = 0, draws: int = DRAWS, prior: Array | None = None
) -> Fit:
    """Fit the law to one observable.

    Args:
        history: At least three levels.
        prior: Logarithm of how likely each order is by what else is known, [G].
        seed: Seed of the draws.
        draws: How many.

    Raises:
        ValueError: Fewer than three levels, sizes that do not fall, or histories that do not match.
    """
    sizes = np.asarray(history.sizes, dtype=np.float64)
    if sizes.size < 3 or sizes.size != len(history.values):
        raise ValueError(f"fit_history: needs three levels with values, got {sizes.size}")
    if not (np.diff(sizes) < 0).all() or not (sizes > 0).all():
        raise ValueError(f"fit_history: sizes must fall, got {history.sizes}")
    if len({runs.shape[1:] for runs in history.values}) != 1:
        raise ValueError("fit_history: histories of different length")
    scaled = sizes / sizes[-1]
    grid = np.linspace(*ORDERS, _GRID)
    means = np.stack([runs.mean(axis=0).reshape(-1) for runs in history.values])
    moments, components = history.values[0].shape[1:]
    rng = np.random.default_rng([seed, *history.name.encode()])

    best, amplitude, _ = _solve(means, scaled, grid)
    at = int(best.argmin())
    wave = amplitude[at] / math.sqrt(moments)
    steps = np.diff(means, axis=0)
    explained = wave * float(scaled[0] ** grid[at] - 1.0)
    # residuals of L levels with two unknowns per moment
    left = math.sqrt(float(best[at]) / (moments * max(1, sizes.size - 2)))
    power = 0.5 * _data(means, scaled, grid[at], history) * (sizes.size - 2)

    known = history.values[1:] if history.chaotic else history.values
    free = components * sum(runs.shape[0] - 1 for runs in known)
    # a variance of so many free values is known up to chi^2 / free
    chance = np.sqrt(free / rng.chisquare(free, draws)) if free else np.ones(draws)
    # chance lengthens every change: once in the runs, once more in the draws
    variance = moments * np.array(
        [
            history.scatter(size) ** 2 / runs.shape[0]
            for size, runs in zip(history.sizes, history.values, strict=True)
        ]
    )
    orders, error = np.empty(draws), np.empty(draws)
    for draw in range(draws):
        noisy = means + _noise(history, rng)
        residual, amplitude, along = _solve(noisy, scaled, grid)
        weight = ((residual.min() + _SMALL) / (residual + _SMALL)) ** power
        if prior is not None:
            weight = weight * np.exp(prior)
        pick = int(rng.choice(grid.size, p=weight / weight.sum()))
        orders[draw] = grid[pick]
        length = math.sqrt(max(0.0, amplitude[pick] ** 2 - 2.0 * along[pick] ** 2 @ variance))
        error[draw] = length / math.sqrt(moments) + left * abs(rng.standard_normal())
    return Fit(
        name=history.name,
        order=float(grid[at]),
        orders=orders,
        error=error,
        chance=chance,
        finest=float(sizes[-1]),
        misfit=left / explained if explained > _SMALL else 0.0,
        parallel=_cosine(steps[0], steps[-1]),
        history=history,
    )


def _solve(means: Array, sizes: Array, grid: Array) -> tuple[Array, Array, Array]:
    """Least squares of ``f* + c s^p`` for each order: squared residual, norm of c, and weights.

    Args:
        means: [L, T K].
        sizes: Over the finest one, [L].
        grid: Orders [G].
    """
    gram = means @ means.T
    powers = sizes[None, :] ** grid[:, None]
    centred = powers - powers.mean(axis=1, keepdims=True)
    weights = centred / (centred**2).sum(axis=1, keepdims=True)
    count = sizes.size
    middle = np.eye(count) - np.full((count, count), 1.0 / count)
    total = float(np.trace(middle @ gram))
    amplitude = np.sqrt(np.maximum(np.einsum("gi,ij,gj->g", weights, gram, weights), 0.0))
    residual = np.maximum(total - amplitude**2 * (centred**2).sum(axis=1), 0.0)
    return residual, amplitude, weights


def _data(means: Array, sizes: Array, order: float, history: History) -> float:
    """How many numbers a history is worth, since its moments hang together.

    ``T / (1 + 2 sum_k (1 - k / T) r_k)`` per component (Bayley and Hammersley 1946), with the
    autocorrelation ``r_k`` of what the best fit leaves, up to where it first falls to zero.
    """
    moments, components = history.values[0].shape[1:]
    matrix = np.stack([np.ones_like(sizes), sizes**order], axis=1)
    left = means - matrix @ np.linalg.lstsq(matrix, means, rcond=None)[0]
    series = left.reshape(-1, moments, components)
    power = float((series**2).sum())
    total = 1.0
    for lag in range(1, moments):
        shared = float((series[:, lag:] * series[:, :-lag]).sum())
        if power <= _SMALL**2 or shared <= 0.0:
            break
        # the sum over fewer pairs holds the factor (1 - lag / T) already
        total += 2.0 * shared / power
    return components * max(1.0, moments / total)


def _noise(history: History, rng: np.random.Generator) -> Array:
    """What the mean of each level may be off by: its seeds' deviations with random weights."""
    rows: list[Array] = []
    for runs in history.values:
        count = runs.shape[0]
        off = runs - runs.mean(axis=0)
        if count == 1:  # no seeds of its own: the scatter of the others, along no known history
            spread = history.scatter(history.sizes[len(rows)]) / math.sqrt(runs.shape[2])
            rows.append(spread * rng.standard_normal() * np.ones(off[0].size))
            continue
        weights = rng.standard_normal(count) / math.sqrt(count * (count - 1))
        rows.append(np.tensordot(weights, off, axes=1).reshape(-1))
    return np.stack(rows)


def _rms(history: Array) -> float:
    return math.sqrt(float((history**2).sum(axis=-1).mean()))


def _cosine(first: Array, last: Array) -> float:
    lengths = float(np.linalg.norm(first) * np.linalg.norm(last))
    return float(first @ last) / lengths if lengths > _SMALL else 1.0
