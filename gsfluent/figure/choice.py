"""The picture of a choice by error: what every setting costs and what is expected of it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gsfluent.figure.style import COLORS, FAILED, INK, OURS, new_figure, save_png


def draw_choice(result: Mapping[str, Any], path: str | Path) -> Path:
    """Draw predicted error against predicted seconds, both logarithmic.

    Args:
        result: ``chart.json``: ``settings``, ``bound``, ``floor``, ``floor_of``, ``chosen``,
            ``enough`` and ``sure``.
        path: PNG to write.

    Returns:
        The path.
    """
    with new_figure(7.2, 4.4) as figure:
        axes = figure.add_subplot()
        axes.set_xscale("log")
        axes.set_yscale("log")
        for number, cfl in enumerate(sorted({s["cfl"] for s in result["settings"]})):
            rows = [s for s in result["settings"] if s["cfl"] == cfl and s["seconds"] > 0.0]
            rows.sort(key=lambda s: s["cells"])
            x = [s["seconds"] for s in rows]
            y = [100.0 * s["error"] for s in rows]
            off = [
                [100.0 * max(0.0, s["error"] - s["low"]) for s in rows],
                [100.0 * max(0.0, s["high"] - s["error"]) for s in rows],
            ]
            color = COLORS[1 + number]
            axes.errorbar(
                x, y, yerr=off, fmt="o-", color=color, markersize=3.5, linewidth=1.0,
                elinewidth=0.8, capsize=2.0, label=f"CFL {cfl:g}, 5 % to 95 %",
            )  # fmt: skip
            if number == 0:
                for at, value, row in zip(x, y, rows, strict=True):
                    axes.annotate(
                        str(row["cells"]), (at, value), xytext=(0, -11), color=color,
                        textcoords="offset points", fontsize=7, ha="center",
                    )  # fmt: skip
        bound = 100.0 * result["bound"]
        axes.axhline(bound, color=INK, linewidth=1.0, linestyle="--", label=f"asked: {bound:g} %")
        if result["floor"] > 0.0:
            axes.axhspan(
                1e-9, 100.0 * result["floor"], color=FAILED, alpha=0.10, linewidth=0.0,
                label=f"chance alone ({result['floor_of']})",
            )  # fmt: skip
        marked = result["chosen"] or result["enough"]
        if marked is not None:
            met = result["chosen"] is not None
            word = f"chosen, {100 * result['sure']:.0f} % sure" if met else "finer buys nothing"
            axes.plot(
                [marked["seconds"]], [100.0 * marked["error"]], "o", color=OURS, markersize=11,
                fillstyle="none", markeredgewidth=2.0, label=f"{marked['cells']} cells: {word}",
            )  # fmt: skip
        values = [100.0 * s[k] for s in result["settings"] for k in ("low", "high") if s[k] > 0.0]
        values += [bound, 100.0 * result["floor"]]
        axes.set_ylim(0.7 * min(v for v in values if v > 0.0), 1.4 * max(values))
        axes.set_xlabel("predicted time of the whole simulation [s]; numbers are cells")
        axes.set_ylabel("predicted error of the worst observable [%]")
        axes.set_title("Error and time of this shot, from its probes")
        axes.legend(loc="best")
        return save_png(figure, path)
