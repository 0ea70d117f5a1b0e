"""Maps over two axes: how long a run held in every cell, and what broke it."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsfluent.figure.style import INK, new_figure, save_png

HOLDS = "#cfe9dc"
NOT_RUN = "#f4f4f4"
Value = float | str


@dataclass(frozen=True)
class Cell:
    """One point of a map."""

    step: int | None  # steps to the first violation, None where it held
    letter: str = ""  # of the kind of violation


@dataclass(frozen=True)
class Mark:
    """A named point, such as where another program stands."""

    x: Value  # value of the horizontal axis, a number between two of its values too
    y: Value  # of the vertical one
    name: str  # its words


@dataclass(frozen=True)
class Plane:
    """One panel."""

    title: str  # over it
    subtitle: str  # under the title: the variant
    x_label: str  # words of the horizontal axis
    y_label: str  # words of the vertical axis
    xs: Sequence[Value]  # values along x, [X]: rising numbers, or words
    ys: Sequence[Value]  # values along y, [Y]
    cells: Mapping[tuple[int, int], Cell]  # (column, row) -> cell; what is missing was not run
    limit: int  # steps that a run had at most
    star: tuple[int, int] | None = None  # column and row of the default, or None
    marks: Sequence[Mark] = ()  # named points


def place_of(values: Sequence[Value], value: Value) -> float | None:
    """Where a value lies among those of an axis, counted in cells from 0; None outside.

    Numbers between two of them are placed by their logarithm where all are positive.
    """
    if isinstance(value, str) or isinstance(values[0], str):
        return float(values.index(value)) if value in values else None
    numbers = [float(v) for v in values]
    if not numbers[0] <= value <= numbers[-1]:
        return None
    log = all(v > 0 for v in numbers)
    for i, (low, high) in enumerate(itertools.pairwise(numbers)):
        if low <= value <= high:
            part = math.log(value / low) / math.log(high / low) if log else (value - low)
            return i + (part if log else part / (high - low))
    return 0.0  # a single value


def _words(value: Value) -> str:
    if isinstance(value, str):
        return value
    if value == 0 or 1e-3 <= abs(value) < 1e4:
        return f"{value:.4g}"
    mantissa, exponent = f"{value:.1e}".split("e")
    mantissa = mantissa.removesuffix(".0")
    return f"{'' if mantissa == '1' else mantissa + '·'}10$^{{{int(exponent)}}}$"


def draw_planes(
    planes: Sequence[Plane | None],
    path: str | Path,
    *,
    kinds: Mapping[str, str],
    columns: int = 2,
    dpi: int = 110,
    cell: tuple[float, float] = (0.36, 0.24),
) -> Path:
    """Draw panels beside each other into one PNG.

    A cell is green where the run held, and goes from dark (at once) to light (late) where it did
    not, with the letter of what broke.

    Args:
        planes: The panels, row by row; None leaves a gap.
        path: Of the PNG.
        kinds: Letter -> words, for the line below; those that occur are named.
        columns: Panels side by side.
        dpi: Of the PNG.
        cell: Least width and height of a cell [inches].

    Raises:
        ValueError: No panels.
        RunError: The file cannot be written.
    """
    drawn = [p for p in planes if p is not None]
    if not drawn:
        raise ValueError("draw_planes: no panels")
    columns = min(columns, len(planes))
    lines = math.ceil(len(planes) / columns)
    wide = max(len(p.xs) for p in drawn)
    tall = max(len(p.ys) for p in drawn)
    width = min(1.7 + cell[0] * wide, 6.6)
    height = 1.35 + cell[1] * tall
    with new_figure(width * columns, height * lines + 0.35) as figure:
        grid = figure.subplots(lines, columns, squeeze=False).ravel()
        for axes, plane in zip(grid, planes, strict=False):
            if plane is None:
                axes.remove()
            else:
                _draw(axes, plane)
        for axes in grid[len(planes) :]:
            axes.remove()
        seen = {c.letter for p in drawn for c in p.cells.values() if c.step is not None}
        words = ["green: holds", *(f"{k}: {kinds[k]}" for k in kinds if k in seen)]
        if any(p.star for p in drawn):
            words.append("★ default")
        figure.supxlabel("   ".join(words), fontsize=7.5, color=INK)
        return save_png(figure, path, dpi=dpi)


def _draw(axes: Any, plane: Plane) -> None:
    from matplotlib import colormaps
    from matplotlib.colors import to_hex
    from matplotlib.patches import Rectangle

    heat = colormaps["YlOrRd_r"]
    axes.grid(False)
    for i in range(len(plane.xs)):
        for j in range(len(plane.ys)):
            cell = plane.cells.get((i, j))
            color, ink = (NOT_RUN if cell is None else HOLDS), INK
            if cell is not None and cell.step is not None:
                late = math.log1p(cell.step) / math.log1p(max(plane.limit, 1))
                color = to_hex(heat(0.08 + 0.80 * min(late, 1.0)))
                ink = "#ffffff" if late < 0.5 else INK
            axes.add_patch(
                Rectangle((i - 0.5, j - 0.5), 1, 1, facecolor=color, edgecolor="#ffffff", lw=0.8)
            )
            if cell is not None and cell.step is not None:
                axes.text(
                    i, j, cell.letter, ha="center", va="center", fontsize=6.5, color=ink,
                    clip_on=True,
                )  # fmt: skip
    if plane.star is not None:
        axes.plot(
            *plane.star, marker="*", markersize=11, color=INK, markeredgecolor="#ffffff",
            markeredgewidth=0.8, linestyle="none",
        )  # fmt: skip
    for n, mark in enumerate(plane.marks):
        x, y = place_of(plane.xs, mark.x), place_of(plane.ys, mark.y)
        if x is None or y is None:
            continue
        for edge, width in (("#ffffff", 3.0), ("#31579c", 1.6)):  # a ring: the letter stays legible
            axes.plot(
                x, y, marker="o", markersize=11, markerfacecolor="none", markeredgecolor=edge,
                markeredgewidth=width,
            )  # fmt: skip
        right = x > 0.5 * len(plane.xs)
        axes.annotate(
            mark.name, (x, y), xytext=(-8 if right else 8, 7 + 7 * (n % 2)),
            textcoords="offset points", ha="right" if right else "left", fontsize=6.5,
            color="#1b3157",
            bbox={"facecolor": "#ffffff", "alpha": 0.75, "edgecolor": "none", "pad": 0.6},
        )  # fmt: skip
    axes.set_xlim(-0.5, len(plane.xs) - 0.5)
    axes.set_ylim(-0.5, len(plane.ys) - 0.5)
    crowded = isinstance(plane.xs[0], str) or len(plane.xs) > 9
    axes.set_xticks(range(len(plane.xs)), [_words(v) for v in plane.xs], fontsize=7,
                    rotation=45 if crowded else 0)  # fmt: skip
    axes.set_yticks(range(len(plane.ys)), [_words(v) for v in plane.ys], fontsize=7)
    axes.tick_params(length=0)
    axes.set_xlabel(plane.x_label, fontsize=8)
    if not isinstance(plane.ys[0], str):
        axes.set_ylabel(plane.y_label, fontsize=8)
    axes.set_title(f"{plane.title}\n" if plane.subtitle else plane.title, fontsize=8.5)
    if plane.subtitle:
        axes.text(
            0, 1.02, plane.subtitle, transform=axes.transAxes, fontsize=8, color=INK, va="bottom"
        )  # fmt: skip
    for side in axes.spines.values():
        side.set_visible(False)
