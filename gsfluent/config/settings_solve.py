"""``solve:`` of a shot."""

from __future__ import annotations

import dataclasses
import logging
from pathlib import Path
from typing import Any

from gsfluent.config.read import (
    Place,
    Reader,
    choice,
    flag,
    key,
    mapping,
    number,
    optional,
    section,
    whole,
)
from gsfluent.errors import InputError

_log = logging.getLogger(__name__)


def share(low: float, high: float) -> Reader:
    """Reader of a share, ``3%`` or ``0.03``, in ``low..high``."""

    def read(value: Any, place: Place) -> float:
        if isinstance(value, str) and value.strip().endswith("%"):
            value, unit = value.strip()[:-1].strip(), 0.01
        else:
            unit = 1.0
        try:
            found = unit * float(number()(value, place))
        except InputError:
            raise place.error("be a share such as 3% or 0.03", value) from None
        if not low <= found <= high:
            raise place.error(f"lie in {low:.2%}..{high:.0%}", f"{found:.4g}")
        return round(found, 12)  # 3 * 0.01 is not 0.03

    return read


def read_error(text: str, argument: str) -> float:
    """Read a bound on the error from words, for the command line.

    Raises:
        InputError: Not a share such as ``3%`` or ``0.03``, or out of range.
    """
    return float(_ERROR(text, Place(argument, Path())))


_ERROR = share(1e-4, 0.5)


WALL_POINTS = {"preview": 10_000}
"""Most material points for walls by quality. Finer cells cost steps, too: a preview of a bowl with
so many takes about as long as one of a ball with three times as many."""
_WALL_POINTS = 300_000


@dataclasses.dataclass(frozen=True)
class SolveSettings:
    """``solve:`` - how accurately."""

    quality: str = key(
        choice("preview", "shot", "hero"),
        "Size of the cells of the grid.",
        "preview",
        default="shot",
    )
    cells: int | None = optional(
        whole(8, 1024),
        "Cells along the longest side of the largest solid, instead of those of `quality`.",
        "32",
    )
    max_points: int | None = optional(
        whole(0, 8_000_000),
        "Where a quarter of a body stands on walls thinner than three cells of `quality`, the "
        "cells are made as fine as that takes, up to so many material points and eight times the "
        "cells of `quality`; 0 leaves them. Without it 10000 for `preview`, else 300000. `cells` "
        "is never changed.",
        "1000000",
    )
    cfl: float = key(
        number(0.05, 0.9),
        "Courant number of the automatic time step. Below 0.5 points keep what shorter steps would "
        "lose.",
        "0.7",
        default=0.5,
    )
    error: float | None = optional(
        _ERROR,
        "Largest error, instead of `quality` and `cells`: the cheapest cells and cfl that "
        "short probes of the shot promise to meet it with.",
        "3%",
    )
    seconds_per_frame: float | None = optional(
        number(above=0.0),
        "Wall time that simulating a frame may take on this machine [s], instead of `quality` "
        "and `cells`: as many cells as that allows, by the cost model of `gsfluent plan`.",
        "0.5",
    )
    max_hours: float = key(
        number(above=0.0),
        "A run is refused whose simulation the plan expects to take longer than this [h].",
        "100",
        default=24.0,
    )
    standing: bool = key(
        flag,
        "What stands still on the floor sleeps from the start, without a strain, until "
        "something comes near; else its weight begins to act at the start.",
        "true",
        default=False,
    )
    contact: str = key(
        choice("auto", "points", "nodes"),
        "What floors, colliders and other bodies push: the `points` of the matter where they are "
        "(`cfl` at most 0.5), or `nodes` of the grid, up to 1.5 cells before the matter is there, "
        "which take away part of every bounce. `auto`: points where all matter is elastic or a "
        "metal and `cfl` is at most 0.5, else nodes, for which the losses of brittle presets were "
        "fitted; `plan` and `run.json` say which. Pieces of one body touch at nodes.",
        "nodes",
        default="auto",
    )
    inertia: str = key(
        choice("grid", "body"),
        "What elastic bodies turn with: the `grid` spreads each mass over a cell, so that a rod "
        "four cells thick twists 8 % too slowly; `body` shares the mass out among its points so "
        "that the body has its own inertia (2 %). Bodies that break or flow are left alone.",
        "grid",
        default="body",
    )
    devices: str = key(
        choice("one", "all"),
        "`all`: where the grid holds 1000000 points or more, all GPUs of this machine work at it, "
        "each at a part, with the bits of one, and pictures are drawn on them in turn. They must "
        "reach each other's memory. On a CPU, and where there is one GPU, no difference.",
        "all",
        default="one",
    )
    loose_debris: bool = key(
        flag,
        "Does nothing any more: loose matter leaves the grid in every shot.",
        "true",
        default=False,
        old="loose_crumbs",
    )
    deterministic: bool = key(
        flag,
        "Insist on the same bits from the same input on the same device. The solver gives them "
        "anyway; on a GPU a free rigid body lighter than what it meets does not, and is refused "
        "then.",
        "true",
        default=False,
    )

    @property
    def points_for_walls(self) -> int:
        """Most material points to which cells are refined for walls."""
        if self.max_points is None:
            return WALL_POINTS.get(self.quality, _WALL_POINTS)
        return self.max_points


def read_solve(value: Any, place: Place) -> SolveSettings:
    """Read ``solve:``; what chooses the cells may be said only once."""
    solve: SolveSettings = section(SolveSettings, value, place)
    given = mapping(value, place)
    if solve.loose_debris:
        _log.warning("%s.loose_debris does nothing now: loose matter leaves the grid", place.path)
    # of a resolved shot every default is written out: those say nothing
    defaults = {"quality": "shot", "cfl": 0.5, "cells": None, "seconds_per_frame": None}
    for chooser, what, others in (
        ("error", "the cells and the time step", ("quality", "cells", "cfl", "seconds_per_frame")),
        ("seconds_per_frame", "the cells", ("quality", "cells")),
    ):
        if getattr(solve, chooser) is None:
            continue
        for name in others:
            if given.get(name, defaults[name]) != defaults[name]:
                raise InputError(
                    f"{place.path}.{chooser} chooses {what}, and {name} is given too",
                    f"remove {chooser} or {name}",
                )
    return solve
