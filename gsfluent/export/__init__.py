"""A finished simulation in other programs' formats."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(
    __name__,
    frames="NOBODY FrameSequence Moment",
    write="ExportOptions export write_exports",
)
