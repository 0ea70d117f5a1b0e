"""What was seen, for :class:`gsfluent.pipeline.Fit`: points, clouds, masks, a force, pieces."""

from gsfluent._lazy import lazy

__getattr__, __dir__, __all__ = lazy(
    __name__,
    {
        "gsfluent.targets.points": ("Points", "Clouds"),
        "gsfluent.targets.masks": ("Masks",),
        "gsfluent.targets.force": ("Force",),
        "gsfluent.targets.pieces": ("Pieces",),
    },
)
