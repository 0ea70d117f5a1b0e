"""The charts at the side of the page."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

from gsfluent.viewer.model.plots import NOW, Plot, plots_of

if TYPE_CHECKING:
    import viser

    from gsfluent.viewer.model.timeline import Timeline

_HEIGHT = 118
_WIDTH = 300.0
_EVERY = 0.1  # seconds between two moves of the line while playing


class PlotPanel:
    """Charts that follow the timeline."""

    def __init__(self, server: viser.ViserServer, timeline: Timeline) -> None:
        self._server, self._timeline = server, timeline
        self._panel: Any = None
        self._tab: Any = None
        self._charts: dict[str, Any] = {}
        self._plots: dict[str, Plot] = {}
        self._marked = 0.0
        self.update(0.0)

    def update(self, now: float) -> None:
        """Read the figures anew; the line goes to ``now`` [s]."""
        plots = plots_of(self._timeline.facts())
        self._plots = {plot.name: plot for plot in plots}
        if plots and self._panel is None:
            self._panel = self._server.gui.add_panel()
            self._panel.dock_left()
            self._panel.set_width(_WIDTH)
            self._tab = self._panel.add_tab("Over time")
        for plot in plots:
            if plot.name not in self._charts:
                with self._tab:
                    self._charts[plot.name] = _chart(self._server, plot, now)
        for name in set(self._charts) - set(self._plots):
            self._charts.pop(name).remove()
        self.mark(now, at_once=True)

    def mark(self, now: float, *, at_once: bool = False) -> None:
        """Move the line to ``now`` [s]; too frequent moves are left out unless ``at_once``."""
        moment = time.monotonic()
        if not at_once and moment - self._marked < _EVERY:
            return
        self._marked = moment
        for name, chart in self._charts.items():
            plot = self._plots[name]
            chart.data = plot.columns(now)
            if chart.title != plot.title:
                chart.title = plot.title


def _chart(server: viser.ViserServer, plot: Plot, now: float) -> Any:
    series: list[dict[str, Any]] = [{"label": "t [s]"}]
    for label, color in zip(plot.labels, plot.colors, strict=True):
        series.append({"label": label, "stroke": color, "width": 2, "points": {"show": False}})
    series.append(
        {"label": "now", "stroke": NOW, "width": 1.5, "scale": "now", "points": {"show": False}}
    )
    axes = tuple({"size": size, "font": "11px sans-serif", "gap": 2} for size in (28, 46))
    return server.gui.add_uplot(
        data=plot.columns(now),
        series=tuple(series),  # type: ignore[arg-type]
        title=plot.title,
        scales={"x": {"time": False}, "now": {"auto": False, "range": (0.0, 1.0)}},
        axes=axes,  # type: ignore[arg-type]
        legend={"live": False},
        height=_HEIGHT,
        padding=(8, 20, 0, 0),
    )
