"""What is matter: signed distances from splats, masks, depths or a mesh."""

from gsfluent._lazy import lazy

__getattr__, __dir__, __all__ = lazy(
    __name__,
    {
        "gsfluent.pipeline.solid.colors": (
            "keep_skin",
            "skin_colors",
            "skin_weights",
            "surface_colors",
        ),
        "gsfluent.pipeline.solid.evidence": ("Evidence", "SolidOptions"),
        "gsfluent.pipeline.solid.field": ("SignedDistance",),
        "gsfluent.pipeline.solid.hollow": ("cavity_volume",),
        "gsfluent.pipeline.solid.mesh": ("is_mesh", "mesh_to"),
        "gsfluent.pipeline.solid.source": ("find_solid",),
        "gsfluent.pipeline.solid.tsdf": ("depth_views",),
        "gsfluent.pipeline.solid.walls": ("thin_shells", "walls"),
    },
)
