"""Fracture problems with known answers."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(
    __name__,
    "brittle",
    brittle="plain",
)
