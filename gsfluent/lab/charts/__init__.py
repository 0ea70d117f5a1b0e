"""Charts of speed against accuracy: ladders of settings, one JSON line per run, fronts, pages.

:mod:`~gsfluent.lab.charts.record` is the line that every script and verb of the lab reads and
writes.
"""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(
    __name__,
    chart="run",
    draw="gathered of_records",
    ladder="ladder",
    quality="chart_quality gathered",
    record="commit machine now",
)
