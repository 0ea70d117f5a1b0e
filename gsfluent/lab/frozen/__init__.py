"""gsfluent's answers to FractureBench."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(
    __name__,
    answer="clock run_case",
)
