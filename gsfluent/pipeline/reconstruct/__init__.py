"""Photographs -> Gaussians; the object apart from its background."""

from gsfluent._lazy import lazy

__getattr__, __dir__, __all__ = lazy(
    __name__,
    {
        "gsfluent.pipeline.reconstruct.evaluate": ("HOLD_OUT", "evaluate", "write_report"),
        "gsfluent.pipeline.reconstruct.isolate": ("Isolate",),
        "gsfluent.pipeline.reconstruct.recipe": ("recipe_for",),
        "gsfluent.pipeline.reconstruct.stage": ("Reconstruct",),
    },
)
