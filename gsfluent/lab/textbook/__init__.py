"""The textbook solver: MPM as papers print it, with its variants."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(
    __name__,
    grid="stencil",
    laws="advance measure",
    nacc="Nacc return_map",
    solver="Textbook Variant run_textbook",
    variant="Birth",
)
