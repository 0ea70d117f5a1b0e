"""What was measured of other programs."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(
    __name__,
    known="find",
)
