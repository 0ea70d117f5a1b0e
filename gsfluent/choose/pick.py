"""From the errors of probes to one setting: what each costs, which is the cheapest that will do."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from gsfluent.choose.fit import Fit

__all__ = ["CELLS", "SURE", "Choice", "Setting", "pick", "ranked"]

Array = NDArray[np.float64]

CELLS = (8, 10, 12, 14, 16, 20, 24, 28, 32, 40, 48, 56, 64, 80, 96, 128)
"""Cells along the largest solid that are offered."""
SURE = 0.9
"""Share of the draws that must meet the bound."""


@dataclasses.dataclass(frozen=True)
class Setting:
    """One setting with what is expected of it."""

    cells: int  # Cells along the longest side of the largest solid
    cfl: float  # Courant number
    seconds: float  # Predicted wall time of the whole simulation [s]
    error: float  # Median of the drawn errors, of the observable that is worst
    low: float  # 5th percentile
    high: float  # 95th percentile
    sure: float  # Share of the draws that meet the bound
    worst: str  # Observable that is worst in most draws
    parts: Mapping[str, float]  # Median error of each observable
    # Share of the draws in which the cells change nothing more than the bound, or than two runs
    # differ by chance.
    settled: float


@dataclasses.dataclass(frozen=True)
class Choice:
    """What was chosen, and why."""

    bound: float  # What was asked for
    settings: Sequence[Setting]  # All that were weighed, cheapest first
    chosen: Setting | None  # The one to take, or None when none meets the bound
    # The cheapest that in most draws differs from finer ones by no more than the bound or the run-
    # to-run band, whichever is larger; None when there is none.
    enough: Setting | None
    sure: float  # Share of the draws in which the chosen one meets the bound, 0 without one
    # Least error that any setting can claim: the run-to-run band of the observable with the widest
    # one.
    floor: float
    floor_of: str  # That observable, or empty
    reason: str  # In words
    within: float  # Least bound that can be met among the settings; infinite when none is known
    asymptotic: bool  # Whether every observable that matters follows a power of the cells


def ranked(
    fits: Sequence[Fit],
    bound: float,
    seconds: Callable[[int, float], float],
    *,
    growth: Mapping[str, float] | None = None,
    spread: Mapping[str, float] | None = None,
    steps: Mapping[float, Mapping[str, tuple[float, float]]] | None = None,
    cells: Sequence[int] = CELLS,
) -> list[Setting]:
    """Weigh all settings.

    Args:
        fits: Errors of each observable; sizes of the cells are 1 / cells.
        bound: What was asked for.
        seconds: Wall time of (cells, cfl) [s].
        growth: Factor by observable on the error of the mean, from the frames that were probed to
            all; 1 when absent.
        spread: The same on the scatter between runs.
        steps: By Courant number what it adds: observable to (error, size of the cells it was
            measured at). The probes' own has an empty mapping.
        cells: Those offered; coarser ones than were probed are left out.

    Returns:
        Cheapest first.
    """
    coarsest = max(fit.history.sizes[0] for fit in fits)
    found = []
    for cfl, added in (steps or {0.5: {}}).items():
        for count in cells:
            size = 1.0 / count
            if size > coarsest * (1.0 + 1e-9):
                continue
            bands = [_band(fit, size, spread or {}) for fit in fits]
            means = [_mean(fit, size, growth or {}, added) for fit in fits]
            rows = np.stack([
                fit.around(mean, size, (spread or {}).get(fit.name, 1.0))
                for fit, mean in zip(fits, means, strict=True)
            ])  # fmt: skip
            worst = rows.max(axis=0)
            settled = np.stack(means) <= np.array([[max(bound, band)] for band in bands])
            low, middle, high = np.quantile(worst, [0.05, 0.5, 0.95])
            most = np.bincount(rows.argmax(axis=0), minlength=len(fits)).argmax()
            found.append(
                Setting(
                    cells=count,
                    cfl=cfl,
                    seconds=seconds(count, cfl),
                    error=float(middle),
                    low=float(low),
                    high=float(high),
                    sure=float((worst <= bound).mean()),
                    worst=fits[int(most)].name,
                    parts={
                        fit.name: float(np.median(row)) for fit, row in zip(fits, rows, strict=True)
                    },
                    settled=float(settled.all(axis=0).mean()),
                )
            )
    return sorted(found, key=lambda s: (s.seconds, s.cells, -s.cfl))


def _band(fit: Fit, size: float, spread: Mapping[str, float]) -> float:
    """Scatter of a single run over the whole shot."""
    return min(spread.get(fit.name, 1.0) * fit.history.scatter(size), fit.history.most)


def _mean(
    fit: Fit,
    size: float,
    growth: Mapping[str, float],
    added: Mapping[str, tuple[float, float]],
) -> Array:
    """Drawn errors of the mean of many runs at a setting, over the whole shot, [D]."""
    more, at = added.get(fit.name, (0.0, size))
    # a longer step is longer in proportion to the cells: its error falls like theirs
    stepping = more * (size / at) ** fit.orders
    return np.asarray(fit.mean_errors(size) * growth.get(fit.name, 1.0) + stepping)


def pick(
    fits: Sequence[Fit],
    settings: Sequence[Setting],
    bound: float,
    *,
    spread: Mapping[str, float] | None = None,
) -> Choice:
    """Take the cheapest setting that meets the bound in :data:`SURE` of the draws.

    Args:
        fits: Errors of each observable.
        settings: From :func:`ranked`.
        bound: What was asked for.
        spread: As given to :func:`ranked`.
    """
    finest = min(1.0 / s.cells for s in settings)
    bands = {f.name: _band(f, finest, spread or {}) for f in fits if f.history.chaotic}
    floor_of = max(bands, key=lambda name: bands[name]) if bands else ""
    floor = bands.get(floor_of, 0.0)
    usable = [s for s in settings if math.isfinite(s.seconds)]
    meeting = [s for s in usable if s.sure >= SURE]
    chosen = min(meeting, key=lambda s: s.seconds) if meeting else None
    # nothing can be promised there: what is more likely than not is as much as a scene needs
    settled = [s for s in usable if s.settled > 0.5]
    enough = min(settled, key=lambda s: s.seconds) if settled else None
    # the 90th percentile lies between the median and the 95th: the latter promises enough
    within = min((s.high for s in usable), default=math.inf)
    lost = [fit.name for fit in fits if not fit.asymptotic]
    best = max(usable, key=lambda s: s.sure, default=None)
    if chosen is not None:
        reason = (
            f"cheapest setting that meets {bound:.1%} in {chosen.sure:.0%} of the draws; "
            f"the {chosen.worst} decides"
        )
    elif floor > bound:
        reason = (
            f"two runs of this shot that differ by chance alone differ by {floor:.1%} in the "
            f"{floor_of}: no setting can claim {bound:.1%}"
        )
        if enough is not None:
            reason += f"; finer than {enough.cells} cells changes less than chance does"
    elif best is not None and best.sure > 0.0:
        reason = (
            f"no setting up to {best.cells} cells meets {bound:.1%} with {SURE:.0%} certainty "
            f"(the best does in {best.sure:.0%} of the draws)"
        )
    else:
        most = max(usable, key=lambda s: s.cells, default=None)
        name = "" if most is None else f": {most.error:.1%} is expected of {most.cells} cells"
        reason = f"no setting that is offered meets {bound:.1%}{name}"
    if lost:
        reason += (
            f"; not yet in the asymptotic range: {', '.join(lost)} - the probes do not settle "
            "towards one answer, so what is said of finer cells is a guess"
        )
    return Choice(
        bound=bound,
        settings=settings,
        chosen=chosen,
        enough=enough,
        sure=chosen.sure if chosen else 0.0,
        floor=floor,
        floor_of=floor_of,
        reason=reason,
        within=within,
        asymptotic=not lost,
    )
