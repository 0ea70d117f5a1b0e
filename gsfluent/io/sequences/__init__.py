"""Moving points and meshes of any program, read from its files."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(__name__, read="read_sequence", sequence="Sequence")
