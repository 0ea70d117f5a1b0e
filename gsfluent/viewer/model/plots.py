"""Curves of a run over time, with a line at the frame that is shown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

# A curve: label, colour.
_CURVES: dict[str, tuple[tuple[str, str, str], ...]] = {
    "Energy": (
        ("kinetic", "kinetic", "#2f6fc4"),
        ("elastic", "elastic", "#3f9d5a"),
        ("gravity", "gravity", "#8a8f98"),
        ("dissipated", "dissipated", "#d0453f"),
    ),
    "Momentum": (
        ("momentum_x", "x", "#d0453f"),
        ("momentum_y", "y", "#3f9d5a"),
        ("momentum_z", "z", "#2f6fc4"),
    ),
    "Fragments": (
        ("fragments", "pieces", "#8d62c0"),
        ("pieces_over_1_percent", "over 1 % of the mass", "#2f6fc4"),
    ),
    "Broken": (
        ("damaged_fraction", "share of the volume broken", "#d0453f"),
        ("broken_fraction", "share of the mass ever broken", "#8a8f98"),
        ("loose_fraction", "share of the mass loose", "#d98a1f"),
    ),
    "Blocks": (("active_blocks", "blocks of the grid in use", "#3f9d5a"),),
    "Holes": (("holes", "holes in the silhouette", "#d98a1f"),),
}
_UNITS = {"Energy": "J", "Momentum": "kg m/s", "Broken": "%", "Holes": "%"}
_PREFIXES = ((1e6, "M"), (1e3, "k"), (1.0, ""), (1e-3, "m"), (1e-6, "µ"))
NOW = "#30343b"


@dataclass(frozen=True)
class Plot:
    """One chart."""

    name: str  # What it shows
    title: str  # Name and unit
    time: np.ndarray  # Times [s], [F]
    labels: tuple[str, ...]  # Names of the curves
    colors: tuple[str, ...]  # Their CSS colours
    # Their values in the unit of the title, [F] each; NaN where unknown.
    values: tuple[np.ndarray, ...]

    def columns(self, now: float) -> tuple[np.ndarray, ...]:
        """Data for the chart: time, every curve, and the line at ``now`` (0 to 1 on its own scale).

        The line is two points at the same time, so that time is repeated there.
        """
        row = int(np.searchsorted(self.time, now))
        time = np.insert(self.time, row, [now, now])
        line = np.full(time.shape, np.nan)
        line[row : row + 2] = 0.0, 1.0
        curves = []
        for values in self.values:
            at = np.interp(now, self.time, values)
            curves.append(np.insert(values, row, [at, at]))
        return (time, *curves, line)


def plots_of(facts: Sequence[dict[str, Any]]) -> list[Plot]:
    """The charts that the figures of the frames allow.

    Args:
        facts: Figures per frame as in ``run.json``'s ``per_frame``; empty ones leave gaps.

    Returns:
        Only charts with at least two known values.
    """
    known = [_flat(row) for row in facts if "time" in row]
    time = np.array([row["time"] for row in known], dtype=np.float64)
    plots = []
    for name, curves in _CURVES.items():
        columns, labels, colors = [], [], []
        for key, label, color in curves:
            values = np.array([_number(row.get(key)) for row in known], dtype=np.float64)
            if int(np.isfinite(values).sum()) >= 2:
                columns.append(values)
                labels.append(label)
                colors.append(color)
        if not columns:
            continue
        title, factor = _scaled(name, columns)
        scaled = tuple(factor * column for column in columns)
        plots.append(Plot(name, title, time, tuple(labels), tuple(colors), scaled))
    return plots


def _flat(row: dict[str, Any]) -> dict[str, Any]:
    """The figures with energies and momentum as numbers of their own."""
    flat = {**row, **row.get("energy", {})}
    momentum = row.get("momentum")
    if isinstance(momentum, list | tuple) and len(momentum) == 3:
        flat.update(zip(("momentum_x", "momentum_y", "momentum_z"), momentum, strict=True))
    return flat


def _number(value: object) -> float:
    return float(value) if isinstance(value, int | float) else float("nan")


def _scaled(name: str, columns: list[np.ndarray]) -> tuple[str, float]:
    """Title with a readable unit, and the factor into it."""
    unit = _UNITS.get(name, "")
    if unit == "":
        return name, 1.0
    if unit == "%":
        return f"{name} [%]", 100.0
    top = max(float(np.nanmax(np.abs(column))) for column in columns)
    fitting = [(size, sign) for size, sign in _PREFIXES if top >= size]
    size, sign = fitting[0] if fitting and name == "Energy" else (1.0, "")
    return f"{name} [{sign}{unit}]", 1.0 / size
