"""What is matter: signed distances from splats, masks, depths or a mesh."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(
    __name__,
    colors="keep_skin skin_colors skin_weights surface_colors surface_colors_at",
    evidence="Evidence SolidOptions",
    field="SignedDistance",
    hollow="cavity_volume",
    mesh="mesh_to",
    source="find_solid",
    tsdf="depth_views",
    walls="WALL_CELLS thin_shells walls",
)
