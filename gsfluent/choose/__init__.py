"""The cheapest setting that meets an error."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(
    __name__,
    choose="QUICK",
    shot="chart_shot choose_stage readable shot_scene",
)
