"""Stages: each an ``nn.Module``, containers in, containers out; ``gsfluent run`` chains them.

Beside them the functions around an object's solid (docs/theory/solid.md).
"""

from __future__ import annotations

import importlib
from typing import Any

_PUBLIC: dict[str, str] = {
    "Stage": "gsfluent.progress",
    "Reconstruct": "gsfluent.pipeline.reconstruct.stage",
    "Isolate": "gsfluent.pipeline.reconstruct.isolate",
    "Fill": "gsfluent.pipeline.fill.stage",
    "Texture": "gsfluent.pipeline.texture",
    "label_regions": "gsfluent.pipeline.regions.project",
    "Simulate": "gsfluent.pipeline.simulate.stage",
    "Repair": "gsfluent.pipeline.cracks.stage",
    "Render": "gsfluent.pipeline.render.stage",
    "Lamp": "gsfluent.pipeline.light.lamps",
    "Lighting": "gsfluent.pipeline.light.lamps",
    "bake_light": "gsfluent.pipeline.light.bake",
    "SignedDistance": "gsfluent.pipeline.solid.field",
    "find_solid": "gsfluent.pipeline.solid.source",
    "closed_mesh": "gsfluent.pipeline.solid.mesh",
    "save_mesh": "gsfluent.pipeline.solid.mesh",
    "clean_floaters": "gsfluent.pipeline.reconstruct.floaters",
    "thin_shells": "gsfluent.pipeline.solid.walls",
}

__all__ = list(_PUBLIC)


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"module 'gsfluent.pipeline' has no attribute {name!r}")
    value = getattr(importlib.import_module(_PUBLIC[name]), name)
    globals()[name] = value
    return value
