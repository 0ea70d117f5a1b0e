"""What the viewer knows: sources of frames, the time line, what is looked at."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(
    __name__,
    "look",
    color="Legend splat_colors",
    live_source="LiveSource factor",
    look="Cut Look angles direction",
    pace="Pace",
    playback="Playback",
    plots="NOW Plot plots_of",
    source="RunSource Source",
    timeline="Timeline",
)
