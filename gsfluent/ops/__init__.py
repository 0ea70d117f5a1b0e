"""Functional operators: tensors in, tensors out; a CPU and a CUDA kernel and a reference for each.

Every operator is registered with the PyTorch dispatcher as ``torch.ops.gsfluent.<name>``.
"""

from __future__ import annotations

from gsfluent import _load  # noqa: F401  (loads the compiled libraries)
from gsfluent._lazy import lazy

__getattr__, __dir__, __all__ = lazy(
    __name__,
    {
        "gsfluent.ops.mpm": ("Blocks", "build_blocks", "p2g", "grid_update", "g2p"),
        "gsfluent.ops.collider": ("collider_row", "collider_distance", "advance_colliders"),
        "gsfluent.ops.grip": ("grip_rows",),
        "gsfluent.ops.blade": ("blade_rows", "blade_sides", "merged_fields"),
        "gsfluent.ops.plasticity": (
            "return_mapping",
            "elastic_energy",
            "softening_paths",
            "wave_speed",
        ),
        "gsfluent.ops.viscous": ("viscous_step", "viscous_energy"),
        "gsfluent.ops.damage": ("damage_solve",),
        "gsfluent.ops.differentiable": (
            "MpmState",
            "material_params",
            "mpm_state",
            "mpm_step",
            "rollout",
        ),
        "gsfluent.ops.solver": ("Solver", "SolverError"),
        "gsfluent.ops.average": ("kernel_average",),
        "gsfluent.ops.inertia": ("inertial_shares",),
        "gsfluent.ops.heat": (
            "conduct",
            "enthalpy",
            "lattice_cells",
            "lattice_links",
            "temperature",
        ),
        "gsfluent.ops.deform": (
            "polar_clamped",
            "covariance_axes",
            "carry_axes",
            "carry_place",
            "cut_at_cells",
            "cut_by_planes",
            "link_states",
        ),
        "gsfluent.ops.faces": ("FaceFit", "FaceSites", "face_elements", "find_faces"),
        "gsfluent.ops.mvee": ("mvee", "mvee_lens"),
        "gsfluent.ops.raster": ("Recorded", "Rendered", "rasterize", "rasterize_recorded"),
        "gsfluent.ops.density": ("Bulk", "splat_bulk", "occupancy", "density_normals"),
        "gsfluent.ops.spatial": (
            "box_blur",
            "distance_transform",
            "hashes",
            "label_boxes",
            "largest_shares",
            "margin_counts",
            "nearest_points",
            "nearest_labels",
            "trilinear",
            "value_noise",
        ),
        "gsfluent.ops.graph": ("components", "link_costs", "nearest_seeds"),
        "gsfluent.ops.shade": ("shade",),
        "gsfluent.ops.texture": ("patch_votes", "quantile_shift", "rows_between"),
        "gsfluent.ops.losses": ("Photometric", "photometric_loss", "photometric_slopes", "ssim"),
        "gsfluent.ops.adam": ("adam_step",),
        "gsfluent.ops.activation": (
            "Activated",
            "activate",
            "activate_backward",
            "clamp_aspect",
            "shorten_axes",
        ),
    },
)
