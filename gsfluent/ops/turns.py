"""Rotations as quaternions and as matrices, by one call each.

:mod:`gsfluent.geometry` says what they are; it works them out operation by operation where somebody
wants a gradient.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gsfluent._check import check_tensor
from gsfluent._load import HAS_CUDA_KERNELS
from gsfluent.ops._register import fakes, no_gradient


def served(*values: Tensor) -> bool:
    """Whether the operators serve these: float32 or float64, all alike, no gradient wanted."""
    first = values[0]
    return (
        first.dtype in (torch.float32, torch.float64)
        and (first.device.type == "cpu" or (first.is_cuda and HAS_CUDA_KERNELS))
        and all(v.dtype == first.dtype and v.device == first.device for v in values)
        and not (torch.is_grad_enabled() and any(v.requires_grad for v in values))
    )


def quats_to_matrices(quats: Tensor) -> Tensor:
    """Rotation matrices [N, 3, 3] of quaternions (wxyz, of any length) [N, 4].

    One without direction, or that is not finite, gives the identity.

    Args:
        quats: Shape [N, 4], float32 or float64.

    Raises:
        TypeError: A wrong dtype.
        ValueError: A wrong shape.

    Gradient: none.
    """
    check_tensor("quats_to_matrices", "quats", quats, shape=("N", 4))
    made: Tensor = torch.ops.gsfluent.quats_to_matrices.default(quats)
    return made


def matrices_to_quats(matrices: Tensor) -> Tensor:
    """Unit quaternions (wxyz, w >= 0) [N, 4] of rotation matrices [N, 3, 3] (Shepperd 1978).

    Args:
        matrices: Shape [N, 3, 3], float32 or float64.

    Raises:
        TypeError: A wrong dtype.
        ValueError: A wrong shape.

    Gradient: none.
    """
    check_tensor("matrices_to_quats", "matrices", matrices, shape=("N", 3, 3))
    made: Tensor = torch.ops.gsfluent.matrices_to_quats.default(matrices)
    return made


def quat_products(left: Tensor, right: Tensor) -> Tensor:
    """Hamilton products [N, 4]: first ``right``, then ``left``.

    Args:
        left: Shape [N, 4], float32 or float64.
        right: The same.

    Raises:
        TypeError: A wrong dtype.
        ValueError: A wrong shape or device.

    Gradient: none.
    """
    check_tensor("quat_products", "left", left, shape=("N", 4))
    check_tensor("quat_products", "right", right, shape=left.shape, like=left)
    made: Tensor = torch.ops.gsfluent.quat_products.default(left, right)
    return made


fakes(
    quats_to_matrices=lambda q: q.new_empty((len(q), 3, 3)),
    matrices_to_quats=lambda m: m.new_empty((len(m), 4)),
    quat_products=lambda a, b: a.new_empty(a.shape),
)
no_gradient(
    "turns: no gradient; gsfluent.geometry has one",
    "quats_to_matrices", "matrices_to_quats", "quat_products",
)  # fmt: skip
