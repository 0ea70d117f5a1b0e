"""A session that one can poke while it runs."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(
    __name__,
    player="AT_REST FAILED LivePlayer PAUSED RUNNING Status",
    scene="open_stage",
    session="CRACKS LiveSession",
)
