"""PhysGaussian's model folders and JSON configs."""

from gsfluent._lazy import lazy

__getattr__, __dir__, __all__ = lazy(
    __name__,
    {
        "gsfluent.config.physgaussian.read": ("convert",),
    },
)
