"""Heat in a simulation: between points, floor and air, and what it does to matter."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(
    __name__,
    ladder="thawing",
    looks="Heat",
    touching="touching",
)
