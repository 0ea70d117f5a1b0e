"""The Pareto figure says what the numbers say."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from gsfluent.figure.pareto import Dot, Panel, Rates, colors_of, draw
from gsfluent.figure.style import OURS, save_png

pytest.importorskip("matplotlib")


def panel() -> Panel:
    ours = [Dot("gsfluent", 1.0, 0.1, "dx 0.1"), Dot("gsfluent", 4.0, 0.01, "dx 0.05")]
    dots = [
        *ours, Dot("gsfluent", 1.5, 0.1, "shuffled", free=True), Dot("peer", 20.0, 0.05),
        Dot("peer", 30.0, 1.7), Dot("peer", math.nan, math.inf, failed=True),
    ]  # fmt: skip
    return Panel("bar", dots, {"gsfluent": ours, "peer": dots[3:4]}, band=0.02)


def test_axes_hold_every_run_and_failures_stand_above_all_others(tmp_path: Path) -> None:
    rates = Rates({"gsfluent": [10.0, 100.0]}, {"gsfluent": [5.0, 4.0]}, 2.0, "208 bytes")
    with draw([panel()], rates, title="t") as figure:
        ax, cost = figure.axes
        assert ax.get_xscale() == ax.get_yscale() == cost.get_xscale() == "log"
        left, right = ax.get_xlim()
        low, high = ax.get_ylim()
        assert left < 1.0 and right > 30.0 and low < 0.01 and high > 0.1
        assert float(cost.lines[-1].get_ydata()[0]) == 2.0
        marks = {line.get_marker(): line for line in ax.lines if len(line.get_xdata()) == 1}
        rail = {m: float(marks[m].get_ydata()[0]) for m in ("x", "^")}
        assert rail["x"] == rail["^"] > 0.1 and rail["x"] < high
        stairs = [x for x in ax.lines if x.get_drawstyle() == "steps-post"]
        assert list(stairs[-1].get_ydata()) == [0.1, 0.01, 0.01]
        assert stairs[-1].get_color() == OURS
        assert any("208" in text.get_text() for text in cost.texts)
        assert any("band" in text.get_text() for text in ax.texts)
        path = save_png(figure, tmp_path / "a.png")
    assert path.stat().st_size > 5000


def test_ours_keeps_its_colour_whoever_stands_beside_it() -> None:
    assert colors_of(["gsfluent", "b"])["gsfluent"] == colors_of(["a", "gsfluent"])["gsfluent"]
    several = colors_of([f"m{i}" for i in range(6)])
    assert len(set(several.values())) == 6 and OURS not in several.values()


def test_nothing_to_draw_is_said() -> None:
    with pytest.raises(ValueError, match="nothing to draw"), draw([]):
        raise AssertionError
    # a case in which everything broke off has axes and its crosses all the same
    only = Panel("bar", [Dot("a", math.nan, math.inf, failed=True)], {"a": []})
    with draw([only]) as figure:
        assert any(line.get_marker() == "x" for line in figure.axes[0].lines)
