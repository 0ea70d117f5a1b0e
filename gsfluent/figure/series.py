"""Curves over one common axis, a panel per quantity."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from gsfluent.figure.style import COLORS, FAILED, INK, OURS, new_figure, to_svg

Values = Sequence[float | int | None]
WIDE, HIGH = 4.6, 2.7
"""Size of a panel with its labels [inches]."""
LEFT, RIGHT, LOW, ABOVE = 0.75, 0.15, 0.5, 0.3
"""What its labels take of that [inches]."""


@dataclass(frozen=True)
class Panel:
    """One set of axes."""

    title: str  # over it
    unit: str  # along its vertical axis
    # name -> values over the common axis; None and NaN are gaps
    series: Mapping[str, Values] = field(default_factory=dict)
    bar: float | None = None  # A level to draw, such as a limit, or None
    whole: bool = False  # whether values are counts: no fractions along the axis
    log: bool = False  # logarithmic values; zeros are gaps then


def _numbers(values: Values, log: bool) -> list[float]:
    plain = [math.nan if v is None else float(v) for v in values]
    return [v if not log or v > 0.0 else math.nan for v in plain]


def curves(along: Sequence[float], label: str, panels: Sequence[Panel]) -> str:
    """Draw panels below and beside each other.

    Args:
        along: Common horizontal axis, [N].
        label: Its name and unit.
        panels: What to draw; a panel without any number is left out.

    Returns:
        An ``<svg>`` element; empty when nothing is left to draw.

    Raises:
        ValueError: A series has another length than ``along``.
    """
    columns = 2
    for panel in panels:
        for name, values in panel.series.items():
            if len(values) != len(along):
                raise ValueError(f"{panel.title}, {name}: {len(values)} values over {len(along)}")
    drawn = [
        p
        for p in panels
        if any(math.isfinite(v) for values in p.series.values() for v in _numbers(values, p.log))
    ]
    if not drawn:
        return ""
    columns = min(columns, len(drawn))
    rows = math.ceil(len(drawn) / columns)
    width, height = WIDE * columns, HIGH * rows
    with new_figure(width, height, fitted=False) as figure:
        # margins by hand: to find them takes longer than to draw
        left, right, low, high = LEFT / width, RIGHT / width, LOW / height, ABOVE / height
        figure.subplots_adjust(
            left=left, right=1.0 - right, bottom=low, top=1.0 - high,
            wspace=(LEFT + RIGHT) / (WIDE - LEFT - RIGHT),
            hspace=(LOW + ABOVE) / (HIGH - LOW - ABOVE),
        )  # fmt: skip
        grid = figure.subplots(rows, columns, squeeze=False).ravel()
        for axes, panel in zip(grid, drawn, strict=False):
            colors = (OURS, *COLORS)
            for i, (name, values) in enumerate(panel.series.items()):
                numbers = _numbers(values, panel.log)
                # a value between two gaps would be no line at all
                alone = sum(map(math.isfinite, numbers)) < 0.5 * len(numbers)
                mark, color = ("." if alone else None), colors[i % len(colors)]
                axes.plot(along, numbers, color=color, label=name, linewidth=1.4, marker=mark)
            if panel.bar is not None:
                axes.axhline(panel.bar, color=FAILED, linewidth=0.9, linestyle=(0, (5, 3)))
            if panel.log:
                axes.set_yscale("log")
            elif panel.whole:
                axes.yaxis.get_major_locator().set_params(integer=True)
            axes.set_title(panel.title)
            axes.set_ylabel(panel.unit)
            axes.set_xlabel(label, color=INK)
            if len(panel.series) > 1:
                axes.legend()
        for axes in grid[len(drawn) :]:
            axes.remove()
        return to_svg(figure)
