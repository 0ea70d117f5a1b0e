"""What a crack leaves of splats: sites, faces, cuts, gaps; the Repair stage."""

from gsfluent._lazy import lazy

__getattr__, __dir__, __all__ = lazy(
    __name__,
    {
        "gsfluent.pipeline.cracks.gaps": ("Cracks",),
        "gsfluent.pipeline.cracks.stage": ("CrackHistory", "METHODS", "Repair", "Repaired"),
    },
)
