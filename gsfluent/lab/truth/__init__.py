"""Objects whose inside, light and pictures are known."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(
    __name__,
    interiors="KnownInterior known_interior",
    interiors_judge="Judge",
)
