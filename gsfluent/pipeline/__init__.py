"""Stages: each an ``nn.Module``, containers in, containers out; ``gsfluent run`` chains them.

Beside them the functions around an object's solid (docs/solid.md).
"""

from __future__ import annotations

import importlib
from typing import Any

_PUBLIC: dict[str, str] = {
    "Stage": "gsfluent.pipeline.stage",
    "Reconstruct": "gsfluent.pipeline.reconstruct",
    "Isolate": "gsfluent.pipeline.isolate",
    "Fill": "gsfluent.pipeline.fill",
    "Texture": "gsfluent.pipeline.texture",
    "label_regions": "gsfluent.pipeline.regions",
    "Simulate": "gsfluent.pipeline.simulate",
    "Repair": "gsfluent.pipeline.repair",
    "Render": "gsfluent.pipeline.render",
    "Lamp": "gsfluent.pipeline.light",
    "Lighting": "gsfluent.pipeline.light",
    "bake_light": "gsfluent.pipeline.bake",
    "SignedDistance": "gsfluent.pipeline.solid_field",
    "find_solid": "gsfluent.pipeline.solid_source",
    "closed_mesh": "gsfluent.pipeline.solid_mesh",
    "save_mesh": "gsfluent.pipeline.solid_mesh",
    "clean_floaters": "gsfluent.pipeline.solid_clean",
    "thin_shells": "gsfluent.pipeline.solid_thin",
}

__all__ = list(_PUBLIC)


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"module 'gsfluent.pipeline' has no attribute {name!r}")
    value = getattr(importlib.import_module(_PUBLIC[name]), name)
    globals()[name] = value
    return value
