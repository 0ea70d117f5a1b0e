"""What a photograph of a cut says: exemplar, mask, light, stains, parts."""

from gsfluent._lazy import lazy

__getattr__, __dir__, __all__ = lazy(
    __name__,
    {
        "gsfluent.pipeline.texture.photo": ("metrics",),
        "gsfluent.pipeline.texture.photo.exemplar": (
            "Exemplar",
            "Exemplars",
            "PhotoOptions",
            "each",
            "load_exemplar",
            "load_exemplars",
            "one_per_axis",
            "with_skin",
        ),
        "gsfluent.pipeline.texture.photo.metrics": (
            "depth_profile_error",
            "lab_histogram_distance",
            "neighbour_slice_ratio",
            "patch_distance",
            "volume_slices",
        ),
        "gsfluent.pipeline.texture.photo.parts": ("read_parts", "resized_parts"),
        "gsfluent.pipeline.texture.photo.profile": (
            "depth_profile",
            "match_colors",
            "profile_volume",
            "surface_profile",
        ),
    },
)
