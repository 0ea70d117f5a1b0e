"""gsfluent's answers to FractureBench."""

from gsfluent._lazy import lazy

__getattr__, __dir__, __all__ = lazy(
    __name__,
    {
        "gsfluent.lab.frozen.answer": ("run_case",),
    },
)
