"""Lamps, shadow maps, shading, occlusion, baking."""

from gsfluent._lazy import lazy

__getattr__, __dir__, __all__ = lazy(
    __name__,
    {
        "gsfluent.pipeline.light.albedo": ("Albedo",),
        "gsfluent.pipeline.light.bake": ("bake_light",),
        "gsfluent.pipeline.light.environment": ("sky_and_ground",),
        "gsfluent.pipeline.light.from_shot": ("changed", "gloss_of", "light_of", "looks_of"),
        "gsfluent.pipeline.light.lamps": (
            "Lamp",
            "Lighting",
            "SHININESS",
            "SOFTNESS",
            "SPECULAR",
            "pack_lamps",
        ),
        "gsfluent.pipeline.light.normals": ("Grid", "grid_for", "occupancy_cell", "splat_normals"),
        "gsfluent.pipeline.light.occlusion": ("Occupancy",),
        "gsfluent.pipeline.light.shade": ("arriving", "surface_points", "to_display", "to_linear"),
        "gsfluent.pipeline.light.shadow_maps": ("Bulk", "Lit", "bulk", "faces_of", "shadow_maps"),
    },
)
