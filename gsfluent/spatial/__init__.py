"""Neighbours, voxels, densities, distances, winding numbers."""

from gsfluent._lazy import lazy

__getattr__, __dir__, __all__ = lazy(
    __name__,
    {
        "gsfluent.spatial.density": ("GridBox", "choose_grid", "density_field"),
        "gsfluent.spatial.mesh_distance": (
            "load_mesh",
            "mesh_body",
            "oriented_samples",
            "signed_distances",
        ),
        "gsfluent.spatial.neighbours": ("nearest", "nearest_rows"),
        "gsfluent.spatial.pieces": ("hilbert_code", "sample", "signed_depth", "small_pieces"),
        "gsfluent.spatial.shape": ("cluster", "lone_points", "robust_box", "thin_parts"),
        "gsfluent.spatial.voxels": ("distance_transform", "grown", "nearest_empty", "surface"),
        "gsfluent.spatial.winding": ("winding_numbers",),
        "gsfluent.spatial.zbuffer": ("nearest_points",),
    },
)
