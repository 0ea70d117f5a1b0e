"""Error against cost, log-log: dots, fronts as staircases, failures on a rail at the top."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from gsfluent.figure.style import COLORS, FAILED, INK, OURS, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclasses.dataclass(frozen=True)
class Dot:
    """One run."""

    method: str  # whose
    cost: float  # where it stands on the x axis; NaN or infinite for none
    error: float  # where it stands on the y axis; NaN or infinite for none
    label: str = ""  # what distinguishes it, shown where it lies on its front
    failed: bool = False  # it broke off
    free: bool = False  # it differs from another run in time only


@dataclasses.dataclass(frozen=True)
class Panel:
    """One case."""

    title: str  # its heading
    dots: Sequence[Dot]  # all runs
    # of each method the dots that no other one beats, from cheap to dear
    fronts: Mapping[str, Sequence[Dot]]
    band: float | None = None  # run-to-run spread: errors below mean nothing; None for none
    xlabel: str = ""  # of the x axis; empty for the figure's own
    ylabel: str = ""  # likewise
    highest: float = 1.0  # errors of this and more are drawn on a rail, with a triangle
    note: str = ""  # what its error is, in small letters under the heading


@dataclasses.dataclass(frozen=True)
class Rates:
    """Cost of a point and a step against the number of points."""

    points: Mapping[str, Sequence[float]]  # per method: points of each run
    ns: Mapping[str, Sequence[float]]  # per method: nanoseconds per point and step of each run
    # nanoseconds that the bytes of a point take at the machine's bandwidth; None for none
    floor: float | None = None
    floor_label: str = ""  # what the floor is


def colors_of(methods: Sequence[str], ours: str = "gsfluent") -> dict[str, str]:
    """A colour for each method; ours is always the same."""
    others = [m for m in methods if m != ours]
    found = {m: COLORS[i % len(COLORS)] for i, m in enumerate(others)}
    return {m: OURS if m == ours else found[m] for m in methods}


@contextmanager
def draw(
    panels: Sequence[Panel],
    rates: Rates | None = None,
    *,
    title: str = "",
    xlabel: str = "wall time over simulated time",
    ylabel: str = "error",
    columns: int = 3,
    ours: str = "gsfluent",
) -> Iterator[Figure]:
    """Yield the figure; save it inside the block.

    Args:
        panels: One per case, in order.
        rates: The last panel; None for none.
        title: Above all.
        xlabel: Of panels that have none of their own.
        ylabel: Likewise.
        columns: Panels side by side.
        ours: Method that is drawn in its own colour and last, over the others.

    Raises:
        ValueError: Nothing to draw.
    """
    count = len(panels) + (rates is not None)
    if count == 0:
        raise ValueError("pareto: nothing to draw")
    columns = min(columns, count)
    lines = math.ceil(count / columns)
    names = list(dict.fromkeys(d.method for p in panels for d in p.dots))
    color = colors_of(names, ours)
    with new_figure(4.85 * columns, 3.75 * lines + 0.5) as figure:
        axes = [figure.add_subplot(lines, columns, i + 1) for i in range(count)]
        for i, (panel, ax) in enumerate(zip(panels, axes, strict=False)):
            bottom = i + columns >= count
            _panel(ax, panel, color, ours)
            ax.set_xlabel(panel.xlabel or (xlabel if bottom else ""))
            ax.set_ylabel(panel.ylabel or (ylabel if i % columns == 0 else ""))
        if rates is not None:
            _rates(axes[-1], rates, color)
        _legend(figure, names, color)
        if title:
            figure.suptitle(title, x=0.01, ha="left", fontweight="bold")
        yield figure


def _finite(value: float) -> bool:
    return math.isfinite(value) and value > 0.0


def _panel(ax: Axes, panel: Panel, color: Mapping[str, str], ours: str) -> None:
    from matplotlib.ticker import NullFormatter

    good = [d for d in panel.dots if not d.failed and _finite(d.cost) and _finite(d.error)]
    seen = [d for d in good if d.error < panel.highest]
    rail = [d for d in panel.dots if d.failed or (d in good and d.error >= panel.highest)]
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.xaxis.set_minor_formatter(NullFormatter())  # within a decade their names would overlap
    _heading(ax, panel.title, panel.note)
    low = min((d.error for d in seen), default=1e-3) / 2.5
    high = max((d.error for d in seen), default=1e-1) * 2.0
    middle = math.sqrt(low * high)  # at least a decade and a half, so that ticks have names
    low, high = min(low, middle / 5.6), max(high, middle * 5.6)
    costs = [d.cost for d in panel.dots if _finite(d.cost)] or [1.0]
    left, right = min(costs) / 3.0, max(costs) * 2.0
    middle = math.sqrt(left * right)
    left, right = min(left, middle / 5.6), max(right, middle * 5.6)
    top = high * (high / low) ** 0.09
    ax.set_xlim(left, right)
    ax.set_ylim(low, top)
    ax.set_autoscale_on(False)
    _iso(ax, left, right, low, high)
    if panel.band is not None and panel.band > low:
        ax.axhspan(low, panel.band, color="#f0e6c8", alpha=0.7, zorder=0, lw=0)
        ax.annotate(
            "run-to-run band", (right, low), (-4, 4), textcoords="offset points",
            ha="right", va="bottom", fontsize=7, color="#7a6420",
        )  # fmt: skip
    # what is expensive to see comes first, what matters comes last and lies on top
    order = sorted(color, key=lambda m: m == ours)
    for name in order:
        mine = [d for d in seen if d.method == name]
        free = [d for d in mine if d.free]
        trading = [d for d in mine if not d.free]
        ax.plot([d.cost for d in trading], [d.error for d in trading], "o", ms=2.6, mew=0,
                color=color[name], alpha=0.75, zorder=3)  # fmt: skip
        ax.plot([d.cost for d in free], [d.error for d in free], "|", ms=6.5, mew=0.9,
                color=color[name], alpha=0.9, zorder=3)  # fmt: skip
        stairs = [d for d in panel.fronts.get(name, ()) if d.error < panel.highest]
        _stairs(ax, stairs, color[name], right, strong=name == ours)
    if rail:
        level = high * (high / low) ** 0.045
        ax.axhline(high, color=INK, lw=0.6, ls=":")
        for d in rail:
            cost = d.cost if _finite(d.cost) else right / 1.15
            ax.plot([cost], [level], "x" if d.failed else "^", ms=4.5, mew=1.2, zorder=4,
                    color=color[d.method])  # fmt: skip


def _heading(ax: Axes, title: str, note: str) -> None:
    ax.set_title(title, pad=15.0 if note else 6.0)
    ax.annotate(note, (0.0, 1.0), (0, 4), xycoords="axes fraction", textcoords="offset points",
                fontsize=7.5, color="#555555")  # fmt: skip


def _iso(ax: Axes, left: float, right: float, low: float, high: float) -> None:
    """Lines on which time times error is the same."""
    for power in range(math.floor(math.log10(left * low)), math.ceil(math.log10(right * high)) + 1):
        product = 10.0**power
        ax.plot([left, right], [product / left, product / right], "--", lw=0.5, color="#c9c9c9",
                zorder=1)  # fmt: skip


def _stairs(ax: Axes, dots: Sequence[Dot], color: str, right: float, *, strong: bool) -> None:
    if not dots:
        return
    xs = [d.cost for d in dots] + [right]
    ys = [d.error for d in dots] + [dots[-1].error]
    ax.step(xs, ys, where="post", color=color, lw=1.7 if strong else 1.1, zorder=4 + strong)
    ax.plot(xs[:-1], ys[:-1], "o", ms=4.2, color=color, mec="white", mew=0.5, zorder=5 + strong)
    if strong:
        _labels(ax, dots, color)


def _labels(ax: Axes, dots: Sequence[Dot], color: str) -> None:
    """Names along a front, each once while it stays the same, none over another."""
    from matplotlib.patheffects import withStroke

    width, height = (math.log10(b / a) for a, b in (ax.get_xlim(), ax.get_ylim()))
    placed: list[tuple[float, float]] = []
    said = None
    for d in dots:
        x, y = math.log10(d.cost) / width, math.log10(d.error) / height
        if d.label == said or not d.label:
            continue
        if any(abs(x - px) < 0.3 and abs(y - py) < 0.06 for px, py in placed):
            continue
        placed.append((x, y))
        said = d.label
        # left of a staircase is room, but for what stands at the edge
        share = x - math.log10(ax.get_xlim()[0]) / width
        side, shift = ("right", -4) if share > 0.011 * len(d.label) else ("left", 2)
        ax.annotate(
            d.label, (d.cost, d.error), (shift, -4), textcoords="offset points", ha=side, va="top",
            fontsize=6.5, color=color, zorder=7, path_effects=[withStroke(linewidth=2.0,
            foreground="white")],
        )  # fmt: skip


def _rates(ax: Axes, rates: Rates, color: Mapping[str, str]) -> None:
    ax.set_xscale("log")
    ax.set_yscale("log")
    _heading(ax, "cost of a point and a step", rates.floor_label and f"line: {rates.floor_label}")
    ax.set_xlabel("points")
    ax.set_ylabel("ns per point and step")
    for name, points in rates.points.items():
        ax.plot(points, rates.ns[name], "o", ms=2.8, mew=0, alpha=0.75,
                color=color.get(name, INK))  # fmt: skip
    if rates.floor is not None:
        ax.axhline(rates.floor, color=FAILED, lw=1.0)


def _legend(figure: Figure, names: Sequence[str], color: Mapping[str, str]) -> None:
    from matplotlib.lines import Line2D

    marks = [Line2D([], [], color=color[n], marker="o", ms=4, lw=1.4, label=n) for n in names]
    grey: dict[str, Any] = {"color": "#555555", "ls": "none"}
    marks += [
        Line2D([], [], marker="|", ms=7, label="differs in time only", **grey),
        Line2D([], [], marker="x", ms=5, label="broke off", **grey),
        Line2D([], [], marker="^", ms=5, label="as wrong as no answer", **grey),
        Line2D([], [], color="#c9c9c9", ls="--", lw=0.8, label="time x error the same"),
    ]
    columns = min(len(marks), 9, max(2, int(figure.get_figwidth() / 1.9)))
    figure.legend(handles=marks, loc="outside lower center", ncols=columns)
