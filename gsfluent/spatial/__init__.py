"""Neighbours, voxels, densities, distances, winding numbers."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(
    __name__,
    blue_noise="blue_cylinder",
    density="GridBox choose_grid density_field",
    mesh_distance="grid_winding mesh_body oriented_samples signed_distances",
    mesh_file="ENDINGS in_metres is_mesh load_mesh mesh_files read_parts up_axes",
    mesh_surface="R2 surface_points",
    neighbours="nearest nearest_in_group nearest_rows",
    pieces="hilbert_code sample signed_depth small_pieces",
    shape="cluster lone_points robust_box thin_parts",
    standing="upright",
    voxels="distance_transform grown nearest_empty small_convolutions surface",
    winding="winding_numbers",
    zbuffer="nearest_points",
)
