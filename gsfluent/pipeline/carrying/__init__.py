"""Splats carried by the points or the mesh of any program."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(
    __name__, binding="Binding bind", stage="CarriedFrame Carry carried"
)
