"""Rigid things and blades while they move."""

from gsfluent._lazy import lazy

__getattr__, __dir__, __all__ = lazy(
    __name__,
    {
        "gsfluent.pipeline.colliders.blades": ("BladeSet",),
        "gsfluent.pipeline.colliders.proximity": (
            "box_gaps",
            "boxes",
            "distance",
            "proximity_pairs",
            "time_to_meet",
        ),
        "gsfluent.pipeline.colliders.rigid": ("RigidSet",),
        "gsfluent.pipeline.colliders.splats": (
            "bare_points",
            "bare_splats",
            "blade_splats",
            "rigid_splats",
        ),
    },
)
