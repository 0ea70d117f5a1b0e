"""Stages: each an ``nn.Module``, containers in, containers out; ``gsfluent run`` chains them."""

from __future__ import annotations

import importlib
from typing import Any

_PUBLIC: dict[str, str] = {
    "Stage": "gsfluent.pipeline.stage",
    "Reconstruct": "gsfluent.pipeline.reconstruct",
    "Isolate": "gsfluent.pipeline.isolate",
    "Fill": "gsfluent.pipeline.fill",
    "Texture": "gsfluent.pipeline.texture",
    "Simulate": "gsfluent.pipeline.simulate",
    "Repair": "gsfluent.pipeline.repair",
    "Render": "gsfluent.pipeline.render",
}

__all__ = list(_PUBLIC)


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"module 'gsfluent.pipeline' has no attribute {name!r}")
    value = getattr(importlib.import_module(_PUBLIC[name]), name)
    globals()[name] = value
    return value
