"""Labels of photographs -> parts of a solid."""

from gsfluent._lazy import lazy

__getattr__, __dir__, __all__ = lazy(
    __name__,
    {
        "gsfluent.pipeline.regions.stage": ("Regions",),
        "gsfluent.pipeline.regions.vote": ("Skin", "find_skin"),
    },
)
