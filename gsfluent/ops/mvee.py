"""Minimum-volume enclosing ellipsoids: of points, and of the overlap of two Gaussians."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gsfluent._check import check_tensor
from gsfluent.ops._register import fakes, no_gradient


def _check_finite(op: str, name: str, value: Tensor) -> None:
    if torch.compiler.is_compiling() or bool(torch.isfinite(value).all()):
        return
    first = int((~torch.isfinite(value)).reshape(value.shape[0], -1).any(1).nonzero()[0])
    raise ValueError(f"{op}: {name} must be finite, got NaN or infinity in row {first}")


def mvee(
    points: Tensor, *, tolerance: float = 5e-4, max_iterations: int = 100
) -> tuple[Tensor, Tensor]:
    """Smallest ellipsoid around each set of points.

    The ellipsoid is ``(x - center)^T shape^-1 (x - center) <= 1``; every point lies inside.

    Args:
        points: Point sets [any length unit], shape [B, N, 3], N >= 1, float32 or float64.
        tolerance: Fraction by which the volume may exceed the smallest one, > 0: the multipliers
            of the fit prove it. float32 resolves about 1e-4.
        max_iterations: Bound on the Newton steps per fit, of which 8 to 15 are usual; the result
            contains its points even when it stops early.

    Returns:
        ``(center, shape)``, [B, 3] and [B, 3, 3]. A set that is flat, a line or a single point
        gets the ellipsoid of its own dimension, with the missing semi-axes at 1e-4 of the longest
        (so that ``shape`` stays positive definite).

    Raises:
        TypeError: ``points`` is not a float32 or float64 tensor.
        ValueError: Wrong shape, no points, a non-finite coordinate, or a bad tolerance.

    Gradient: none.
    Source: primal-dual interior-point method on the lifted problem (Sun and Freund 2004 compare
    such methods), ten unknowns per step; derivation in docs/theory/mvee.md. Fracture-GS uses
    Khachiyan's.
    """
    check_tensor("mvee", "points", points, shape=("B", "N", 3))
    if points.shape[0] and not points.shape[1]:
        raise ValueError("mvee: points must hold at least one point per set, got N = 0")
    if not (tolerance > 0.0 and math.isfinite(tolerance)):
        raise ValueError(f"mvee: tolerance must be positive, got {tolerance}")
    if not 0 <= max_iterations < 2**31:
        raise ValueError(f"mvee: max_iterations must not be negative, got {max_iterations}")
    _check_finite("mvee", "points", points)
    center, shape = torch.ops.gsfluent.mvee.default(points, float(tolerance), int(max_iterations))
    return center, shape


_ORDER = (0, 4, 8, 1, 2, 5)
# In the order of LensFault (csrc/core/mvee/lens.h), of the first Gaussian and of the second.
_NOT_FINITE = "finite, got NaN or infinity in row {}"
_FAULTS = [
    (f"{name}_{side}", what)
    for side in "ab"
    for name, what in (
        ("mean", _NOT_FINITE),
        ("cov", _NOT_FINITE),
        ("cov", "positive definite, row {} is not"),
    )
]


def _packed(op: str, name: str, value: Tensor, like: Tensor, batch: int) -> Tensor:
    """[B, 6] form of a covariance given as [B, 6] or [B, 3, 3]."""
    if isinstance(value, Tensor) and value.dim() == 3:
        check_tensor(op, name, value, shape=(batch, 3, 3), like=like)
        return value.reshape(batch, 9)[:, list(_ORDER)]
    check_tensor(op, name, value, shape=(batch, 6), like=like)
    return value


def _raise_faults(op: str, faults: Tensor, batch: int) -> None:
    """Raise for the first row the kernel found fault with; one wait for the device."""
    if torch.compiler.is_compiling() or not batch:
        return
    for (name, what), left in zip(_FAULTS, faults.tolist(), strict=True):
        if left:
            raise ValueError(f"{op}: {name} must be {what.format(batch - left)}")


def mvee_lens(
    mean_a: Tensor,
    cov_a: Tensor,
    mean_b: Tensor,
    cov_b: Tensor,
    *,
    radius: float = 2.0,
    flat: float = 0.0,
) -> tuple[Tensor, Tensor, Tensor]:
    """Gaussian around the overlap of two Gaussians' ellipsoids.

    Each Gaussian stands for ``(x - mean)^T cov^-1 (x - mean) <= radius^2``. Balls, and ellipsoids
    of equal shape, have a closed form; so has one inside the other. Other pairs are fitted: the
    result contains the overlap to 1e-5 of its size, and its volume is within 1e-3 of the smallest
    (docs/measured/mvee.md). float32 covariances hold axis ratios up to about 100 to that accuracy;
    more extreme ones are widened until they contain the overlap.

    Args:
        mean_a: Centres [m], [B, 3], float32 or float64.
        cov_a: Covariances [m^2], [B, 6] (xx, yy, zz, xy, xz, yz) or [B, 3, 3].
        mean_b: Centres [m], [B, 3].
        cov_b: Covariances [m^2], in the layout of ``cov_a``.
        radius: Size of the ellipsoids in standard deviations, > 0.
        flat: Least ratio of the semi-axes, from 0 to 1, measured where the smallest ellipsoid
            ``t q_a + (1 - t) q_b <= 1`` is a ball: keeps the ellipsoid of a vanishing overlap from
            becoming a disc. 0 gives the smallest ellipsoid.

    Returns:
        ``(mean, cov, overlap)``: [B, 3], covariances in the layout of ``cov_a``, and bool [B].
        Without overlap the covariance is zero and the mean is the midpoint.

    Raises:
        TypeError: A tensor has a wrong dtype.
        ValueError: A shape or device is wrong, a value is not finite, a covariance is not
            positive definite, ``radius`` is not positive, or ``flat`` is not in [0, 1].

    Gradient: none.
    Source: Fracture-GS (transition Gaussians); closed form from John's conditions, and the fit of
    unlike ellipsoids, derived in docs/theory/mvee.md.
    """
    op = "mvee_lens"
    check_tensor(op, "mean_a", mean_a, shape=("B", 3))
    batch = mean_a.shape[0]
    check_tensor(op, "mean_b", mean_b, shape=(batch, 3), like=mean_a)
    if not (radius > 0.0 and math.isfinite(radius)):
        raise ValueError(f"{op}: radius must be positive, got {radius}")
    if not 0.0 <= flat <= 1.0:
        raise ValueError(f"{op}: flat must lie in [0, 1], got {flat}")
    packed_a = _packed(op, "cov_a", cov_a, mean_a, batch)
    packed_b = _packed(op, "cov_b", cov_b, mean_a, batch)
    mean, cov, overlap, faults = torch.ops.gsfluent.mvee_lens.default(
        mean_a, packed_a, mean_b, packed_b, float(radius), float(flat)
    )
    _raise_faults(op, faults, batch)
    if cov_a.dim() == 3:
        cov = cov[:, [0, 3, 4, 3, 1, 5, 4, 5, 2]].reshape(batch, 3, 3)
    return mean, cov, overlap


fakes(
    mvee=lambda points, *rest: (
        points.new_empty((len(points), 3)),
        points.new_empty((len(points), 3, 3)),
    ),
    mvee_lens=lambda mean, *rest: (
        mean.new_empty((len(mean), 3)),
        mean.new_empty((len(mean), 6)),
        mean.new_empty((len(mean),), dtype=torch.bool),
        mean.new_empty((6,), dtype=torch.int64),
    ),
)
no_gradient("mvee: no gradient with respect to points", "mvee")
no_gradient("mvee_lens: no gradient", "mvee_lens")
