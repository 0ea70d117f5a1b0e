"""Maps of where a run first breaks a law."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(
    __name__,
    maps="read",
    peers="marks measured",
    report="verdict write_all",
    run="chosen run_maps",
)
