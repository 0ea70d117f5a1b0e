"""Photographs -> Gaussians; the object apart from its background."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(
    __name__,
    evaluate="HOLD_OUT evaluate write_report",
    isolate="Isolate",
    recipe="recipe_for",
    stage="Reconstruct",
)
