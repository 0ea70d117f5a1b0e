"""Charts of speed against accuracy: ladders of settings, one JSON line per run, fronts, pages.

:mod:`~gsfluent.lab.charts.record` is the line that every script and verb of the lab reads and
writes.
"""
