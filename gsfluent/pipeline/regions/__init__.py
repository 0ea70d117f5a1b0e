"""Labels of photographs -> parts of a solid."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(
    __name__,
    stage="Regions",
    vote="Skin find_skin",
)
