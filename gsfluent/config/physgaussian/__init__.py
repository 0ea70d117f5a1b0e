"""PhysGaussian's model folders and JSON configs."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(
    __name__,
    read="convert",
    space="model_file",
)
