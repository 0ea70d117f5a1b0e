"""Stages: each an ``nn.Module``, containers in, containers out; ``gsfluent run`` chains them.

Beside them the functions around an object's solid (docs/theory/solid.md).
"""

from __future__ import annotations

from gsfluent._lazy import lazy

__getattr__, __dir__, __all__ = lazy(
    __name__,
    {
        "gsfluent.pipeline.stage": ("Stage",),
        "gsfluent.pipeline.reconstruct.stage": ("Reconstruct",),
        "gsfluent.pipeline.reconstruct.isolate": ("Isolate",),
        "gsfluent.pipeline.fill.stage": ("Fill",),
        "gsfluent.pipeline.texture": ("Texture",),
        "gsfluent.pipeline.regions.stage": ("Regions",),
        "gsfluent.pipeline.regions.project": ("label_regions",),
        "gsfluent.pipeline.simulate.stage": ("Simulate",),
        "gsfluent.pipeline.cracks.stage": ("Repair",),
        "gsfluent.pipeline.render.stage": ("Render",),
        "gsfluent.pipeline.carrying.stage": ("Carry",),
        "gsfluent.pipeline.fit.breaks": ("FitPieces",),
        "gsfluent.pipeline.fit.guidance": ("Guide",),
        "gsfluent.pipeline.fit.stage": ("Fit",),
        "gsfluent.pipeline.fit.video_prior": ("VideoPrior",),
        "gsfluent.pipeline.light.lamps": ("Lamp", "Lighting"),
        "gsfluent.pipeline.light.bake": ("bake_light",),
        "gsfluent.pipeline.solid.field": ("SignedDistance",),
        "gsfluent.pipeline.solid.source": ("find_solid",),
        "gsfluent.pipeline.solid.mesh": ("closed_mesh", "save_mesh"),
        "gsfluent.pipeline.reconstruct.floaters": ("clean_floaters",),
        "gsfluent.pipeline.solid.walls": ("thin_shells",),
    },
)
