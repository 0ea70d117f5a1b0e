"""What was measured of other programs."""

from gsfluent._lazy import lazy

__getattr__, __dir__, __all__ = lazy(
    __name__,
    {
        "gsfluent.lab.peers.known": ("find",),
    },
)
