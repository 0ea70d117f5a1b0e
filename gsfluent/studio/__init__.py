"""``gsfluent studio``: from a file to a film on one page in the browser."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(__name__, serve="serve_studio")
