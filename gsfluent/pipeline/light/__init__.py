"""Lamps, shadow maps, shading, occlusion, baking."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(
    __name__,
    albedo="Albedo",
    bake="bake_light",
    environment="sky_and_ground",
    from_shot="changed clear_of gloss_of light_of looks_of plates_of transmission_of",
    glass="as_seen on_a_face",
    lamps="Lamp Lighting SHININESS SOFTNESS SPECULAR pack_lamps",
    normals="Grid grid_for occupancy_cell plate_normals splat_normals",
    occlusion="Occupancy",
    shade="arriving irradiance pixel_rays surface_points to_display to_linear",
    shadow_maps="Bulk Lit bulk faces_of shadow_maps",
    wetness="Wetness wet_colors wet_gloss",
)
