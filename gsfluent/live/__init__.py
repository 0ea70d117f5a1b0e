"""A session that one can poke while it runs."""

from gsfluent._lazy import lazy

__getattr__, __dir__, __all__ = lazy(
    __name__,
    {
        "gsfluent.live.player": ("AT_REST", "FAILED", "LivePlayer", "PAUSED", "RUNNING", "Status"),
        "gsfluent.live.scene": ("open_stage",),
        "gsfluent.live.session": ("CRACKS", "LiveSession"),
    },
)
