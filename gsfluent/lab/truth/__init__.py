"""Objects whose inside, light and pictures are known."""

from gsfluent._lazy import lazy

__getattr__, __dir__, __all__ = lazy(
    __name__,
    {
        "gsfluent.lab.truth.interiors": ("KnownInterior", "known_interior"),
        "gsfluent.lab.truth.interiors_judge": ("Judge",),
    },
)
