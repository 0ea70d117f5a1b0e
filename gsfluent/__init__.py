"""gsfluent: photographs of an object in, the object in pieces out, as Gaussians with an inside.

The public surface is lazy: importing gsfluent costs torch and nothing else.

    >>> import gsfluent as gf
    >>> gaussians = gf.load("melon.ply")            # doctest: +SKIP
    >>> solid = gf.pipeline.Fill()(gaussians)       # doctest: +SKIP
"""

from __future__ import annotations

from gsfluent._lazy import lazy

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = lazy(
    __name__,
    {
        "gsfluent": (
            "ops",
            "pipeline",
            "data",
            "demo",
            "io",
            "materials",
            "targets",
            "geometry",
            "metrics",
            "errors",
        ),
        "gsfluent.data": ("Gaussians", "Camera", "Capture", "Frame", "Solid", "Particles"),
        "gsfluent.scene.scene": ("Scene",),
        "gsfluent.io": ("load", "save", "load_capture"),
        "gsfluent.config": ("load_shot",),
        "gsfluent._load": ("has_cuda",),
    },
)
__all__ += ["__version__"]
