"""Functional operators: tensors in, tensors out; a CPU and a CUDA kernel and a reference for each.

Every operator is registered with the PyTorch dispatcher as ``torch.ops.gsfluent.<name>``.
"""

from __future__ import annotations

import importlib
from typing import Any

from gsfluent import _load  # noqa: F401  (loads the compiled libraries)

_PUBLIC: dict[str, str] = {
    "Blocks": "gsfluent.ops.mpm",
    "build_blocks": "gsfluent.ops.mpm",
    "p2g": "gsfluent.ops.mpm",
    "grid_update": "gsfluent.ops.mpm",
    "g2p": "gsfluent.ops.mpm",
    "collider_row": "gsfluent.ops.collider",
    "collider_distance": "gsfluent.ops.collider",
    "advance_colliders": "gsfluent.ops.collider",
    "blade_rows": "gsfluent.ops.blade",
    "blade_sides": "gsfluent.ops.blade",
    "merged_fields": "gsfluent.ops.blade",
    "return_mapping": "gsfluent.ops.plasticity",
    "elastic_energy": "gsfluent.ops.plasticity",
    "wave_speed": "gsfluent.ops.plasticity",
    "MpmState": "gsfluent.ops.differentiable",
    "material_params": "gsfluent.ops.differentiable",
    "mpm_state": "gsfluent.ops.differentiable",
    "mpm_step": "gsfluent.ops.differentiable",
    "rollout": "gsfluent.ops.differentiable",
    "Solver": "gsfluent.ops.solver",
    "SolverError": "gsfluent.ops.solver",
    "polar_clamped": "gsfluent.ops.deform",
    "covariance_axes": "gsfluent.ops.deform",
    "carry_axes": "gsfluent.ops.deform",
    "carry_place": "gsfluent.ops.deform",
    "mvee": "gsfluent.ops.mvee",
    "mvee_lens": "gsfluent.ops.mvee",
    "Rendered": "gsfluent.ops.raster",
    "rasterize": "gsfluent.ops.raster",
    "Bulk": "gsfluent.ops.density",
    "splat_bulk": "gsfluent.ops.density",
    "occupancy": "gsfluent.ops.density",
    "density_normals": "gsfluent.ops.density",
    "shade": "gsfluent.ops.shade",
    "Photometric": "gsfluent.ops.losses",
    "photometric_loss": "gsfluent.ops.losses",
    "ssim": "gsfluent.ops.losses",
    "adam_step": "gsfluent.ops.adam",
}

__all__ = list(_PUBLIC)


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"module 'gsfluent.ops' has no attribute {name!r}")
    module = importlib.import_module(_PUBLIC[name])
    # all names of the module at once: importing gsfluent.ops.mvee has just put the module under the
    # name of its function
    siblings = [n for n, home in _PUBLIC.items() if home == _PUBLIC[name]]
    globals().update({n: getattr(module, n) for n in siblings})
    return globals()[name]
