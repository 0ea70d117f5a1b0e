"""What a capture says before anything is learned: views, hull, which way is up."""

from gsfluent._lazy import lazy

__getattr__, __dir__, __all__ = lazy(
    __name__,
    {
        "gsfluent.pipeline.capture.hull": (
            "Ground",
            "Hull",
            "centre_hull",
            "contradiction",
            "focus_point",
            "hull_grid",
            "hull_points",
            "inside_masks",
            "lattice",
            "masked_views",
            "visual_hull",
        ),
        "gsfluent.pipeline.capture.orient": (
            "DEFAULT_SIZE",
            "Orientation",
            "look_at_point",
            "make_frame",
            "near_points",
            "orient",
            "upright_rotation",
        ),
        "gsfluent.pipeline.capture.views": ("TrainView", "cropped", "halved", "read_views"),
    },
)
