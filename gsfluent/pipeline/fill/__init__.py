"""Gaussians inside a solid; the Fill stage."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(
    __name__,
    mesh_skin="SPLATS mesh_gaussians",
    stage="Fill fill_resolution visible_extent",
)
