"""The pieces of a thing that has broken, as statistics: where each goes is chance.

The same drop with other random numbers moves points by centimetres, and the share that is broken
by a sixth: so a break is compared by the sizes of its pieces, by where its matter lies, and by how
much of it is broken, each against how far chance alone moves it (docs/theory/fit.md).
"""

from __future__ import annotations

from collections.abc import Sequence as Listing
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsfluent.errors import InputError

Array = NDArray[np.float64]
LARGEST = 8
"""Pieces whose shares of the mass are compared one by one, the largest first."""
PARTS = (0.05, 0.15, 0.25, 0.35, 0.45, 0.55, 0.65, 0.75, 0.85, 0.95)
"""Quantiles of the mass along each axis: their differences are Wasserstein's distance."""
GROUPS = ("masses", "places", "broken")


def statistics(masses: Any, places: Any = None, broken: float | None = None) -> dict[str, Array]:
    """What is compared.

    Args:
        masses: Of the pieces [kg], [K].
        places: Of their centres [m], [K, 3].
        broken: Share of the mass that belongs to no piece.

    Returns:
        By group: shares of the largest pieces [LARGEST], quantiles [3 * len(PARTS)], the share.
    """
    mass = np.asarray(masses, np.float64)
    order = np.sort(mass)[::-1][:LARGEST]
    found = {"masses": np.pad(order, (0, LARGEST - len(order))) / max(mass.sum(), 1e-300)}
    if places is not None:
        where = np.asarray(places, np.float64)
        rows = []
        for axis in range(3):
            line = np.argsort(where[:, axis], kind="stable")
            below = (np.cumsum(mass[line]) - 0.5 * mass[line]) / max(mass.sum(), 1e-300)
            rows.append(np.interp(PARTS, below, where[line, axis]))
        found["places"] = np.concatenate(rows)
    if broken is not None:
        found["broken"] = np.array([float(broken)])
    return found


class Pieces:
    """Pieces that were weighed, and perhaps where they lie.

    Args:
        masses: Of each [kg], [K]; shares of the whole do as well.
        places: Of their centres [m], in the scene's metres, [K, 3].
        broken: Share of the mass that is dust.
        time: When [s]; the scene is run so long.

    Raises:
        InputError: Wrong shapes, no piece, or a mass that is not positive.
    """

    def __init__(
        self, masses: Listing[float] | Array, *, places: Any = None, broken: float | None = None,
        time: float = 1.0,
    ) -> None:  # fmt: skip
        where = "targets.Pieces"
        mass = np.asarray(masses, np.float64)
        if mass.ndim != 1 or not len(mass) or not (np.isfinite(mass) & (mass > 0.0)).all():
            raise InputError(f"{where}: masses are no list of positive numbers", "kg, [K]")
        if places is not None:
            given = np.asarray(places, np.float64)
            if given.shape != (len(mass), 3) or not np.isfinite(given).all():
                raise InputError(f"{where}: places are {given.shape}", f"give [{len(mass)}, 3]")
        if broken is not None and not 0.0 <= broken <= 1.0:
            raise InputError(f"{where}: broken is {broken}", "give a share from 0 to 1")
        if not 0.0 < time <= 60.0:
            raise InputError(f"{where}: time is {time}", "give seconds above 0")
        self.time, self.wanted = float(time), statistics(mass, places, broken)
