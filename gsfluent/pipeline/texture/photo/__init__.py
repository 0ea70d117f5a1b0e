"""What a photograph of a cut says: exemplar, mask, light, stains, parts."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(
    __name__,
    "metrics",
    exemplar=(
        "Exemplar Exemplars PhotoOptions each load_exemplar load_exemplars one_per_axis with_skin"
    ),
    metrics=(
        "depth_profile_error lab_histogram_distance neighbour_slice_ratio patch_distance "
        "volume_slices"
    ),
    parts="read_parts resized_parts",
    profile="depth_profile match_colors profile_volume surface_profile",
)
