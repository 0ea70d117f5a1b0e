"""Many tasks, each once; shots that differ, their table and their contact sheet."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(
    __name__,
    bucket="fetch is_store",
    engine="Outcome map required",
    folder="SweepFolder",
    shots="plan_sweep run_sweep",
    tasks="read_sweep",
)
