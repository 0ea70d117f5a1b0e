"""What a capture says before anything is learned: views, hull, which way is up."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(
    __name__,
    carve="carve_cavities",
    front="photographers_side splats_side",
    hull=(
        "Ground Hull centre_hull contradiction focus_point hull_grid hull_points "
        "inside_masks lattice masked_views visual_hull"
    ),
    orient=(
        "DEFAULT_SIZE Orientation below_support camera_up look_at_point make_frame near_points "
        "orient upright_rotation"
    ),
    views="TrainView cropped halved read_views",
)
