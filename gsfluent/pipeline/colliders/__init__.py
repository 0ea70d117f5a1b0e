"""Rigid things and blades while they move."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(
    __name__,
    blades="BladeSet",
    grips="strongest",
    proximity="box_gaps boxes distance proximity_pairs time_to_meet",
    rigid="RigidSet",
    splats="bare_points bare_splats blade_splats rigid_splats",
)
