"""Case ``shatter``: a brittle ball thrown on a plane, judged by the statistics of its pieces."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ..registry import case
from ..run import Measure, Run
from ..scene import Floats, Scene, SceneError
from ..scenes.rows import uneven
from ..shapes import box, free, plane
from ..statistics import MEASURES, Figures, distance, figures

RADIUS = 0.05
SEEDS = tuple(range(8))
"""Seeds of an ensemble (:func:`gsfluent.fracturebench.statistics.jitter`)."""
RECORD = Path(__file__).parents[1] / "data" / "shatter.json"
"""Figures of the reference's runs: float64, CFL 0.3, ten cells along the radius; written by
``scripts/fracturebench/shatter.py``."""
_SPEED, _END, _SAMPLES = 0.25, 30.0, 20
_TOLERANCE = (0.1, 0.1, 0.3, 0.1)


def lattice_ball(radius: float, dx: float, per_cell: int) -> Floats:
    """Points of a cubic lattice inside a ball about the origin, [N, 3]: neighbours are clear."""
    spacing = dx / round(per_cell ** (1.0 / 3.0))
    half = math.ceil(radius / spacing) * spacing
    points = box([-half] * 3, [2.0 * half] * 3, dx, per_cell)
    return points[np.linalg.norm(points, axis=1) <= radius]


def reference() -> list[Figures]:
    """Figures of the eight runs of the reference setting.

    Raises:
        SceneError: The record is missing or broken.
    """
    try:
        plain = json.loads(RECORD.read_text(encoding="utf-8"))
        return [Figures.of_plain(p) for p in plain["runs"]]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise SceneError(
            f"{RECORD.name}: no record of the reference ({error}); make it with "
            "scripts/fracturebench/shatter.py"
        ) from error


def _judge(scene: Scene, run: Run) -> Iterator[Measure]:
    source = "8 runs of gsfluent, float64, CFL 0.3, dx = R / 10"
    if not run.finite:
        for name, tolerance in zip(MEASURES, _TOLERANCE, strict=True):
            yield Measure(name, math.nan, 0.0, math.inf, tolerance, "", source)
        return
    order = ("mass over pieces, KS", *(m for m in MEASURES if "KS" not in m))
    found = distance(reference(), [figures(scene, run)])
    for name in order:
        d = found[name]
        yield Measure(
            f"{name}, distance to the reference", d.value, 0.0, d.error,
            _TOLERANCE[MEASURES.index(name)], "", f"{source}; {d}",
        )  # fmt: skip


@case(
    kind="fracture", dx=RADIUS / 6, judge=_judge,
    ladder=(RADIUS / 4, RADIUS / 5, RADIUS / 6, RADIUS / 7, RADIUS / 8),
)  # fmt: skip
def shatter(dx: float, per_cell: int) -> Scene:
    """Brittle ball thrown on a plane at a quarter of its wave speed: statistics of its pieces.

    Its strength varies by a half over four fifths of the radius, the same at every resolution.
    """
    points = lattice_ball(RADIUS, dx, per_cell)
    rows, index, c = uneven(points, 0.8 * RADIUS, dx, RADIUS / 4.0)
    times = np.linspace(0.0, _END * RADIUS / c, _SAMPLES + 1)[1:]
    return free(
        "shatter", points, [0.0, 0.0, -_SPEED * c], dx, per_cell, times, rows, material=index,
        asks=("damage", "stress"), colliders=(plane(2, -RADIUS, kind="separate", friction=0.3),),
    )  # fmt: skip
