"""Fracture problems with known answers."""

from gsfluent._lazy import lazy

__getattr__, __dir__, __all__ = lazy(
    __name__,
    {
        "gsfluent.lab.problems.fracture": ("brittle",),
        "gsfluent.lab.problems.fracture.brittle": ("plain",),
    },
)
