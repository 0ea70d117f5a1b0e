"""gsfluent fit: a shot and what was seen, to numbers of its materials."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(__name__, job="fit_to", guided="guide_to", broken="pieces_to")
