"""Charts of speed against accuracy: ladders of settings, one JSON line per run, fronts, pages.

:mod:`~gsfluent.lab.charts.record` is the line that every script and verb of the lab reads and
writes.
"""

from gsfluent._lazy import lazy

__getattr__, __dir__, __all__ = lazy(
    __name__,
    {
        "gsfluent.lab.charts.chart": ("run",),
        "gsfluent.lab.charts.draw": ("gathered", "of_records"),
        "gsfluent.lab.charts.ladder": ("ladder",),
        "gsfluent.lab.charts.quality": ("chart_quality", "gathered"),
        "gsfluent.lab.charts.record": ("commit", "machine", "now"),
    },
)
