"""What a training changes becomes splats, and gradients go back; rules of shape between steps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gsfluent._check import check_tensor
from gsfluent.ops._register import fakes, no_gradient


class Activated(NamedTuple):
    """Splats as :func:`gsfluent.ops.rasterize` takes them."""

    scales: Tensor
    """Standard deviations, [N, 3]."""
    opacities: Tensor
    """Peak opacities, [N]."""
    sh: Tensor
    """Spherical harmonics, [N, (degree + 1)^2, 3]."""


class RawSlopes(NamedTuple):
    """Gradients with respect to what :func:`activate` is given, shaped like it."""

    scales: Tensor
    opacities: Tensor
    sh0: Tensor
    sh_rest: Tensor


def activate(
    scales: Tensor, opacities: Tensor, sh0: Tensor, sh_rest: Tensor, degree: int
) -> Activated:
    """Scales by the exponential, opacities by the logistic function, harmonics in one tensor.

    Args:
        scales: Logarithms of the standard deviations, [N, 3], or [N, 1] for all axes; float32 or
            float64.
        opacities: Logits, [N].
        sh0: Constant harmonics, [N, 1, 3].
        sh_rest: The others, [N, R, 3].
        degree: Of the harmonics in use, 0 to 3; R has room for it.

    Returns:
        The splats.

    Raises:
        TypeError: Not tensors, or a wrong dtype.
        ValueError: A shape, device or degree does not fit.

    Gradient: by hand, :func:`activate_backward`.
    Determinism: bit-identical for any number of threads, and on CUDA from run to run.
    Source: Kerbl et al. 2023, section 5.1.
    """
    op = "activate"
    check_tensor(op, "scales", scales, shape=("N", None))
    n = scales.shape[0]
    check_tensor(op, "opacities", opacities, shape=(n,), like=scales)
    check_tensor(op, "sh0", sh0, shape=(n, 1, 3), like=scales)
    check_tensor(op, "sh_rest", sh_rest, shape=(n, None, 3), like=scales)
    if scales.shape[1] not in (1, 3):
        raise ValueError(f"{op}: scales must have 1 or 3 columns, got {list(scales.shape)}")
    room = math.isqrt(1 + sh_rest.shape[1]) - 1
    if not 0 <= degree <= min(3, room):
        raise ValueError(
            f"{op}: degree must lie in 0..{min(3, room)} for {sh_rest.shape[1]} coefficients in "
            f"sh_rest, got {degree}"
        )
    return Activated(*torch.ops.gsfluent.activate.default(scales, opacities, sh0, sh_rest, degree))


def activate_backward(
    splats: Activated,
    grad_scales: Tensor,
    grad_opacities: Tensor,
    grad_sh: Tensor,
    *,
    columns: int = 3,
    rest: int = 0,
    size: float = 0.0,
    needle: float = 0.0,
    aspect: float = 6.0,
    opacity: float = 0.0,
    mark: Tensor | None = None,
) -> RawSlopes:
    """Adjoint of :func:`activate`, with the penalties of a training added.

    The penalties are ``size sum(scales) + needle sum(max(0, longest / middle axis - aspect)) +
    opacity sum(opacities)``; of equal axes the first is the longer, and none is taken as shorter
    than 1e-9.

    Args:
        splats: What :func:`activate` returned.
        grad_scales: Gradient with respect to the scales, [N, 3].
        grad_opacities: The same of the opacities, [N].
        grad_sh: The same of the harmonics in use, [N, K, 3].
        columns: Of the raw scales, 3 or 1.
        rest: Coefficients of ``sh_rest``, at least K - 1; those not in use get 0.
        size: Weight of the scales.
        needle: Weight of the excess of needles; only with 3 columns.
        aspect: Aspect from which a splat is a needle.
        opacity: Weight of the opacities.
        mark: A scalar that becomes NaN where a scale or opacity is not finite; else not touched.

    Returns:
        The gradients of the raw parameters.

    Raises:
        TypeError: Not tensors, or a wrong dtype.
        ValueError: A shape, device or number does not fit.

    Gradient: none.
    Determinism: bit-identical for any number of threads, and on CUDA from run to run.
    """
    op = "activate_backward"
    scales = check_tensor(op, "splats.scales", splats.scales, shape=("N", 3))
    n = scales.shape[0]
    check_tensor(op, "splats.opacities", splats.opacities, shape=(n,), like=scales)
    check_tensor(op, "grad_scales", grad_scales, shape=(n, 3), like=scales)
    check_tensor(op, "grad_opacities", grad_opacities, shape=(n,), like=scales)
    check_tensor(op, "grad_sh", grad_sh, shape=(n, None, 3), like=scales)
    if mark is not None:
        check_tensor(op, "mark", mark, shape=(), like=scales)
    if columns not in (1, 3):
        raise ValueError(f"{op}: columns must be 1 or 3, got {columns}")
    if not 1 <= grad_sh.shape[1] <= 1 + rest:
        raise ValueError(
            f"{op}: grad_sh must have 1 to {1 + rest} coefficients, got {list(grad_sh.shape)}"
        )
    for name, value in (("size", size), ("needle", needle), ("opacity", opacity)):
        if not math.isfinite(value):
            raise ValueError(f"{op}: {name} must be finite, got {value}")
    return RawSlopes(
        *torch.ops.gsfluent.activate_backward.default(
            scales,
            splats.opacities,
            grad_scales,
            grad_opacities,
            grad_sh,
            columns,
            rest,
            size,
            needle,
            aspect,
            opacity,
            mark,
        )
    )


@torch.no_grad()
def clamp_aspect(scales: Tensor, most: float) -> None:
    """Shorten, in place, each splat's longest axis to so many times the middle one.

    Args:
        scales: Logarithms of the standard deviations, [N, 3], contiguous; changed in place.
        most: Largest ratio, at least 1.

    Raises:
        TypeError: Not a tensor, or a wrong dtype.
        ValueError: A shape or number does not fit, or the tensor is not contiguous.

    Gradient: none.
    Determinism: bit-identical for any number of threads, and on CUDA from run to run.
    """
    op = "clamp_aspect"
    check_tensor(op, "scales", scales, shape=("N", 3))
    if not scales.is_contiguous():
        raise ValueError(f"{op}: scales must be contiguous; it is changed in place")
    if not 1.0 <= most < math.inf:
        raise ValueError(f"{op}: most must be finite and at least 1, got {most}")
    torch.ops.gsfluent.clamp_aspect.default(scales, most)
    torch.autograd.graph.increment_version([scales])


@torch.no_grad()
def shorten_axes(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    away: Tensor,
    *,
    origin: Sequence[float],
    voxel: float,
    overhang: float,
) -> Tensor:
    """Share of each splat's axes that ends at most ``overhang`` beyond a body, [N, 3].

    An axis ends where the opacity has fallen to 0.02: ``sqrt(2 log(o / 0.02))`` deviations from the
    centre, at both ends. The share is found by eight halvings; at least 0.02 is left, also of what
    has its centre farther out. An axis within a thousandth of the overhang is left whole, so that
    what was cut once is not cut again.

    Args:
        means: Centres [world units], [N, 3]; float32 or float64.
        quats: Rotations wxyz, [N, 4]; one without a direction turns nothing.
        scales: Standard deviations [world units], [N, 3].
        opacities: Peak opacities, [N].
        away: How far the points of a grid lie outside the body [voxels], [X, Y, Z]; between them
            it is trilinear, and off the grid the distance to the grid is added.
        origin: Where the grid's first point lies [world units].
        voxel: Distance of the grid's points [world units], positive.
        overhang: How far an axis may reach beyond the body [world units].

    Returns:
        Shares in [0.02, 1].

    Raises:
        TypeError: Not tensors, or a wrong dtype.
        ValueError: A shape, device or number does not fit.

    Gradient: none.
    Determinism: bit-identical for any number of threads, and on CUDA from run to run.
    """
    op = "shorten_axes"
    check_tensor(op, "means", means, shape=("N", 3))
    n = means.shape[0]
    check_tensor(op, "quats", quats, shape=(n, 4), like=means)
    check_tensor(op, "scales", scales, shape=(n, 3), like=means)
    check_tensor(op, "opacities", opacities, shape=(n,), like=means)
    check_tensor(op, "away", away, shape=(None, None, None), like=means)
    if away.numel() == 0:
        raise ValueError(f"{op}: away must hold a value, got {list(away.shape)}")
    if len(origin) != 3 or not 0.0 < voxel < math.inf:
        raise ValueError(
            f"{op}: origin must have three values and voxel be positive, got {list(origin)} and "
            f"{voxel}"
        )
    found: Tensor = torch.ops.gsfluent.shorten_axes.default(
        means, quats, scales, opacities, away, [float(x) for x in origin], voxel, overhang
    )
    return found


def _activated(scales: Tensor, *others: Any) -> tuple[Tensor, ...]:
    n, degree = scales.shape[0], others[-1]
    shapes = ((n, 3), (n,), (n, (degree + 1) ** 2, 3))
    return tuple(scales.new_empty(shape) for shape in shapes)


def _raw(scales: Tensor, *others: Any) -> tuple[Tensor, ...]:
    n, columns, rest = scales.shape[0], others[4], others[5]
    shapes = ((n, columns), (n,), (n, 1, 3), (n, rest, 3))
    return tuple(scales.new_empty(shape) for shape in shapes)


fakes(
    activate=_activated,
    activate_backward=_raw,
    clamp_aspect=lambda *inputs: None,
    shorten_axes=lambda means, *rest: means.new_empty(means.shape),
)
no_gradient("activate: its gradient is activate_backward, called by hand", "activate")
no_gradient("shorten_axes has no gradient", "shorten_axes")
