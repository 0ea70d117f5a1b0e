"""Gaussians inside a solid; the Fill stage."""

from gsfluent._lazy import lazy

__getattr__, __dir__, __all__ = lazy(
    __name__,
    {
        "gsfluent.pipeline.fill.stage": ("Fill", "fill_resolution", "visible_extent"),
    },
)
