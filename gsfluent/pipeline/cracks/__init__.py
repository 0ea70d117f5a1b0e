"""What a crack leaves of splats: sites, faces, cuts, gaps; the Repair stage."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(
    __name__,
    gaps="Cracks",
    sites="matter_colors skin_colors_at",
    stage="CrackHistory METHODS Repair Repaired",
)
