"""gsfluent: photographs of an object in, the object in pieces out, as Gaussians with an inside.

The public surface is lazy: importing gsfluent costs torch and nothing else.

    >>> import gsfluent as gf
    >>> gaussians = gf.load("melon.ply")            # doctest: +SKIP
    >>> solid = gf.pipeline.Fill()(gaussians)       # doctest: +SKIP
"""

from __future__ import annotations

import importlib
from typing import Any

__version__ = "0.1.0"

# name -> (module, attribute or None for the module itself)
_PUBLIC: dict[str, tuple[str, str | None]] = {
    "ops": ("gsfluent.ops", None),
    "pipeline": ("gsfluent.pipeline", None),
    "data": ("gsfluent.data", None),
    "io": ("gsfluent.io", None),
    "materials": ("gsfluent.materials", None),
    "geometry": ("gsfluent.geometry", None),
    "metrics": ("gsfluent.metrics", None),
    "errors": ("gsfluent.errors", None),
    "Gaussians": ("gsfluent.data", "Gaussians"),
    "Camera": ("gsfluent.data", "Camera"),
    "Capture": ("gsfluent.data", "Capture"),
    "Frame": ("gsfluent.data", "Frame"),
    "Solid": ("gsfluent.data", "Solid"),
    "Particles": ("gsfluent.data", "Particles"),
    "Scene": ("gsfluent.scene.scene", "Scene"),
    "load": ("gsfluent.io", "load"),
    "save": ("gsfluent.io", "save"),
    "load_capture": ("gsfluent.io", "load_capture"),
    "load_shot": ("gsfluent.config", "load_shot"),
    "has_cuda": ("gsfluent._load", "has_cuda"),
}

__all__ = ["__version__", *_PUBLIC]


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"module 'gsfluent' has no attribute {name!r}")
    module_name, attribute = _PUBLIC[name]
    module = importlib.import_module(module_name)
    value = module if attribute is None else getattr(module, attribute)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
