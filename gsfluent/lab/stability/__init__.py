"""Maps of where a run first breaks a law."""

from gsfluent._lazy import lazy

__getattr__, __dir__, __all__ = lazy(
    __name__,
    {
        "gsfluent.lab.stability.maps": ("read",),
        "gsfluent.lab.stability.peers": ("marks", "measured"),
        "gsfluent.lab.stability.report": ("verdict", "write_all"),
        "gsfluent.lab.stability.run": ("chosen", "run_maps"),
    },
)
