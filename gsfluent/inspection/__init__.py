"""Looking without computing: captures, parts, comparisons, doctor."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(
    __name__,
    capture="inspect",
    compare="compare",
    doctor="examine",
    shot="inspect_shot inspect_solid",
)
