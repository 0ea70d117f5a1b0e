"""Carrying splats by a deformation gradient: rotation, stretch-limited deformation, new axes."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from gsfluent._check import check_tensor
from gsfluent.ops._register import fakes, no_gradient


def polar_clamped(deformation: Tensor, lo: float = 0.3, hi: float = 2.0) -> tuple[Tensor, Tensor]:
    """Rotation and stretch-clamped copy of deformation gradients.

    With ``F = U diag(s) V^T`` (U, V rotations; the smallest s carries the sign of det F) the
    results are ``R = U V^T`` and ``U diag(clamp(s, lo, hi)) V^T``. To carry a Gaussian: covariance
    ``F' S F'^T`` with the clamped F', colour (SH) and normals rotated by R.

    Args:
        deformation: Deformation gradients F, shape [N, 3, 3], float32 or float64.
        lo: Smallest stretch kept [-], > 0. A reflected F (det < 0) has its smallest stretch raised
            to ``lo``, i.e. it is un-inverted.
        hi: Largest stretch kept [-], >= lo.

    Returns:
        ``(R, F_clamped)``, both [N, 3, 3]. R is a rotation (det +1) for every input; a matrix with
        a non-finite entry yields the identity in both.

    Raises:
        TypeError: ``deformation`` is not a float32 or float64 tensor.
        ValueError: Wrong shape, or not ``0 < lo <= hi``.

    Gradient: deformation, of both results; zero where a stretch is held at a bound, and where the
    rotation itself jumps (a turn over) that of a hair away. One-sided Jacobi, 6 fixed sweeps
    (Hestenes 1958); see csrc/core/svd3.h.
    """
    check_tensor("polar_clamped", "deformation", deformation, shape=("N", 3, 3))
    if not (0.0 < lo <= hi and math.isfinite(hi)):
        raise ValueError(f"polar_clamped: bounds must satisfy 0 < lo <= hi, got lo={lo}, hi={hi}")
    rotation, clamped = torch.ops.gsfluent.polar_clamped.default(deformation, float(lo), float(hi))
    return rotation, clamped


def covariance_axes(covariance: Tensor) -> tuple[Tensor, Tensor]:
    """Quaternions and standard deviations of covariances.

    Axes come longest first, each at least 1e-6 of the longest. A covariance that is not finite
    gives the identity and zeros.

    Args:
        covariance: Packed xx, yy, zz, xy, xz, yz [m^2], shape [N, 6], float32 or float64.

    Returns:
        ``(quats, scales)``: wxyz [N, 4] and [m] [N, 3].

    Raises:
        TypeError: A wrong dtype.
        ValueError: A wrong shape.

    Gradient: none. One-sided Jacobi (Hestenes 1958).
    """
    check_tensor("covariance_axes", "covariance", covariance, shape=("N", 6))
    quats, scales = torch.ops.gsfluent.covariance_axes.default(covariance)
    return quats, scales


def carry_axes(
    quats: Tensor, scales: Tensor, map: Tensor, rotation: Tensor, *, rigid: float
) -> tuple[Tensor, Tensor]:
    """Axes of Gaussians carried by deforming matter: covariance ``A S A^T``.

    Where no entry of ``map - rotation`` exceeds ``rigid`` a Gaussian is turned and keeps its scales
    exactly; elsewhere the new axes are the singular vectors and values of ``A R(q) diag(s)``.

    Args:
        quats: Orientations at rest, wxyz, shape [N, 4], float32 or float64; zero counts as the
            identity.
        scales: Standard deviations at rest [m], shape [N, 3].
        map: Deformations A, shape [N, 3, 3].
        rotation: Their rotations, shape [N, 3, 3].
        rigid: See above, >= 0.

    Returns:
        ``(quats, scales)`` now, unit quaternions [N, 4] and [N, 3]. A map that is not finite leaves
        the Gaussian as it was.

    Raises:
        TypeError: A tensor has a wrong dtype.
        ValueError: A shape or device is wrong, or ``rigid`` is negative.

    Gradient: none. PhysGaussian, section 3.3, with total instead of elastic deformation.
    """
    op = "carry_axes"
    check_tensor(op, "quats", quats, shape=("N", 4))
    n = quats.shape[0]
    check_tensor(op, "scales", scales, shape=(n, 3), like=quats)
    check_tensor(op, "map", map, shape=(n, 3, 3), like=quats)
    check_tensor(op, "rotation", rotation, shape=(n, 3, 3), like=quats)
    if not rigid >= 0.0:
        raise ValueError(f"{op}: rigid must not be negative, got {rigid}")
    new_quats, new_scales = torch.ops.gsfluent.carry_axes.default(
        quats, scales, map, rotation, float(rigid)
    )
    return new_quats, new_scales


def carry_place(
    places: Tensor,
    owner: Tensor,
    near: Tensor,
    parted: Tensor,
    rest: Tensor,
    position: Tensor,
    map: Tensor,
    width: Tensor,
) -> tuple[Tensor, Tensor]:
    """Where places at rest have gone with the material points around them.

    ``m = sum_k w_k (x_k + A_k (m0 - X_k))`` over the neighbours of a place's own point that have
    not parted from it, ``w_k ~ exp(-|m0 - X_k|^2 / 2 width^2)``, at least 1e-12, sum one; the map
    there is ``sum_k w_k A_k``.

    Args:
        places: m0 [m], shape [P, 3], float32 or float64.
        owner: Own point of each, int64 [P].
        near: Neighbours of every point, itself among them, int64 [N, K].
        parted: Which of them have parted from it, bool [N, K].
        rest: Points X at rest [m], [N, 3].
        position: Points x now [m], [N, 3].
        map: What each point does to small vectors, A, [N, 3, 3].
        width: Width of the blend at each point [m], [N].

    Returns:
        Places now [P, 3] and maps [P, 3, 3]. A place without any neighbour stays where it was.

    Raises:
        TypeError: A tensor has a wrong dtype.
        ValueError: A shape or device is wrong.

    Gradient: none.
    """
    op = "carry_place"
    check_tensor(op, "places", places, shape=("P", 3))
    check_tensor(op, "rest", rest, shape=("N", 3), like=places)
    n, count = rest.shape[0], places.shape[0]
    check_tensor(op, "owner", owner, shape=(count,), dtype=torch.int64, like=places)
    check_tensor(op, "near", near, shape=(n, "K"), dtype=torch.int64, like=places)
    check_tensor(op, "parted", parted, shape=(n, near.shape[1]), dtype=torch.bool, like=places)
    check_tensor(op, "position", position, shape=(n, 3), like=places)
    check_tensor(op, "map", map, shape=(n, 3, 3), like=places)
    check_tensor(op, "width", width, shape=(n,), like=places)
    means, blend = torch.ops.gsfluent.carry_place.default(
        places, owner, near, parted, rest, position, map, width
    )
    return means, blend


def cut_at_cells(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    *,
    owner: Tensor,
    near: Tensor,
    opened: Tensor,
    rest: Tensor,
    slack: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Gaussians cut where the cells of their own points border on points that moved away.

    A face lies halfway between a splat's point and such a neighbour. It cuts a splat that reaches
    within two standard deviations of it, unless a third point's cell begins there. What is left has
    the mean and the variance of the part on the near side: with ``t`` the distance of the face in
    standard deviations and ``h = phi(t) / Phi(t)``, ``mean' = mean - h S n / s`` and
    ``S' = S - (t h + h^2) (S n)(S n)^T / s^2``, ``s^2 = n^T S n``.

    Args:
        means: Centres [m], shape [M, 3], float32 or float64.
        quats: Orientations, wxyz, [M, 4].
        scales: Standard deviations [m], [M, 3].
        owner: Point of each, int64 [M].
        near: Neighbours of every point, int64 [N, K].
        opened: Which of them have moved away, bool [N, K].
        rest: Points at rest [m], [N, 3].
        slack: Standard deviations by which cuts stay outside of the faces.

    Returns:
        Which were cut, bool [M], and all means, quats and scales.

    Raises:
        TypeError: A tensor has a wrong dtype.
        ValueError: A shape or device is wrong.

    Gradient: none.
    """
    op = "cut_at_cells"
    check_tensor(op, "means", means, shape=("M", 3))
    count = means.shape[0]
    check_tensor(op, "quats", quats, shape=(count, 4), like=means)
    check_tensor(op, "scales", scales, shape=(count, 3), like=means)
    check_tensor(op, "rest", rest, shape=("N", 3), like=means)
    points = rest.shape[0]
    check_tensor(op, "owner", owner, shape=(count,), dtype=torch.int64, like=means)
    check_tensor(op, "near", near, shape=(points, "K"), dtype=torch.int64, like=means)
    check_tensor(op, "opened", opened, shape=near.shape, dtype=torch.bool, like=means)
    cut, new_means, new_quats, new_scales = torch.ops.gsfluent.cut_at_cells.default(
        means, quats, scales, owner, near, opened, rest, float(slack)
    )
    return cut, new_means, new_quats, new_scales


def cut_by_planes(
    means: Tensor,
    covariance: Tensor,
    *,
    first: Tensor,
    normal: Tensor,
    distance: Tensor,
    share: Tensor | None = None,
    whole: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Parts of Gaussians below planes, one plane after another; see :func:`cut_at_cells`.

    Args:
        means: Centres [m], shape [N, 3], float32 or float64.
        covariance: Packed xx, yy, zz, xy, xz, yz [m^2], [N, 6].
        first: First plane of each and the end of the last, ascending, int64 [N + 1].
        normal: Unit vectors to the planes, [P, 3].
        distance: Distances of the planes along them [m], [P]; infinite for none.
        share: How far each cuts, 0 to 1, [P]; all the way when absent.
        whole: Where the distances count from [m], [N, 3]; the means when absent.

    Returns:
        Means [N, 3], quats wxyz [N, 4] and scales [m] [N, 3].

    Raises:
        TypeError: A tensor has a wrong dtype.
        ValueError: A shape or device is wrong.

    Gradient: none.
    """
    op = "cut_by_planes"
    check_tensor(op, "means", means, shape=("N", 3))
    count = means.shape[0]
    check_tensor(op, "covariance", covariance, shape=(count, 6), like=means)
    check_tensor(op, "first", first, shape=(count + 1,), dtype=torch.int64, like=means)
    check_tensor(op, "normal", normal, shape=("P", 3), like=means)
    share = torch.ones_like(distance) if share is None else share
    whole = means if whole is None else whole
    for name, value in (("distance", distance), ("share", share)):
        check_tensor(op, name, value, shape=(normal.shape[0],), like=means)
    check_tensor(op, "whole", whole, shape=(count, 3), like=means)
    new_means, quats, scales = torch.ops.gsfluent.cut_by_planes.default(
        means, whole, covariance, first, normal, distance, share
    )
    return new_means, quats, scales


def link_states(
    position: Tensor,
    apart: Tensor,
    near: Tensor,
    piece: Tensor,
    *,
    none: Tensor,
    together: float,
    loose: float,
    open: float,
    back: float,
    broken: Tensor | None = None,
    before: tuple[Tensor, Tensor] | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """What of the links between points and their neighbours has parted, and where gaps show.

    A link is as long as ``r`` times its length at rest. It has parted when its ends are of two
    pieces, or r is above a limit: ``together`` within a piece, ``loose`` where an end is broken or
    in no piece. Of the links that have parted those show a gap whose r is above ``open``. What has
    parted or shows a gap does so down to ``back`` times its limit.

    Args:
        position: Points now [m], shape [M, 3], M >= N, float32 or float64.
        apart: Lengths at rest [m], [N, K].
        near: Neighbours of every point, int64 [N, K]; one that is no row counts as the point.
        piece: Piece of each point, int32 [M], negative for none.
        none: What stands for no link: parted, without a gap, bool [N, K].
        together: Limit of r within a piece.
        loose: Limit of r elsewhere.
        open: r from which a gap shows.
        back: See above.
        broken: Broken points, bool [M].
        before: What had parted and what showed a gap at the last look, both bool [N, K].

    Returns:
        What has parted and what shows a gap, both bool [N, K], and r, [N, K]; 1 for a point and
        itself.

    Raises:
        TypeError: A tensor has a wrong dtype.
        ValueError: A shape or device is wrong.

    Gradient: none.
    """
    op = "link_states"
    check_tensor(op, "position", position, shape=("M", 3))
    count = position.shape[0]
    check_tensor(op, "near", near, shape=("N", "K"), dtype=torch.int64, like=position)
    if near.shape[0] > count:
        raise ValueError(f"{op}: position has {count} rows for {near.shape[0]} points; pass all")
    check_tensor(op, "apart", apart, shape=near.shape, like=position)
    check_tensor(op, "piece", piece, shape=(count,), dtype=torch.int32, like=position)
    check_tensor(op, "none", none, shape=near.shape, dtype=torch.bool, like=position)
    if broken is not None:
        check_tensor(op, "broken", broken, shape=(count,), dtype=torch.bool, like=position)
    for value in before or ():
        check_tensor(op, "before", value, shape=near.shape, dtype=torch.bool, like=position)
    parted, opened, ratio = torch.ops.gsfluent.link_states.default(
        position, apart, near, piece, broken, *(before or (None, None)), none,
        float(together), float(loose), float(open), float(back),
    )  # fmt: skip
    return parted, opened, ratio


def _like_both(a: Tensor, b: Tensor, *rest: object) -> tuple[Tensor, Tensor]:
    return a.new_empty(a.shape), b.new_empty(b.shape)


fakes(
    polar_clamped=lambda f, lo, hi: _like_both(f, f),
    covariance_axes=lambda c: (c.new_empty((len(c), 4)), c.new_empty((len(c), 3))),
    carry_axes=_like_both,
    carry_place=lambda p, *rest: (p.new_empty(p.shape), p.new_empty((len(p), 3, 3))),
    cut_at_cells=lambda m, q, s, owner, *rest: (
        owner.new_empty(owner.shape, dtype=torch.bool),
        *(v.new_empty(v.shape) for v in (m, q, s)),
    ),
    link_states=lambda p, apart, near, *rest: (
        *(near.new_empty(near.shape, dtype=torch.bool) for _ in range(2)),
        apart.new_empty(apart.shape),
    ),
    cut_by_planes=lambda m, *rest: tuple(m.new_empty((len(m), n)) for n in (3, 4, 3)),
)


def _polar_setup(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor]) -> None:
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(inputs[0])
    ctx.bounds = inputs[1:]


def _polar_backward(ctx: Any, g_turn: Tensor | None, g_shape: Tensor | None) -> Any:
    """For ``U f(S) V^T``, with ``M = U^T dF V``: entries ``((a + b) M_ij + (a - b) M_ji) / 2``.

    ``a = (f_j - f_i) / (s_j - s_i)``, the slope of f where both are one, and
    ``b = (f_j + f_i) / (s_j + s_i)``; on the diagonal the slope. This map is its own adjoint.
    """
    (given,) = ctx.saved_tensors
    lo, hi = ctx.bounds
    finite = torch.isfinite(given).all(dim=2).all(dim=1)
    eye = torch.eye(3, dtype=given.dtype, device=given.device)
    u, s, vh = torch.linalg.svd(torch.where(finite[:, None, None], given, eye))
    flip_u, flip_v = torch.linalg.det(u).sign(), torch.linalg.det(vh).sign()
    ones = torch.ones_like(flip_u)
    u = u * torch.stack([ones, ones, flip_u], dim=1)[:, None, :]
    vh = vh * torch.stack([ones, ones, flip_v], dim=1)[:, :, None]
    s = s * torch.stack([ones, ones, flip_u * flip_v], dim=1)
    apart, both = s[:, None, :] - s[:, :, None], s[:, None, :] + s[:, :, None]
    small = torch.finfo(s.dtype).eps ** 0.5 * s[:, :1, None].clamp(min=1e-30)
    both = torch.where(both.abs() < small, small, both)
    found = torch.zeros_like(given)
    for grad, value, slope in (
        (g_turn, torch.ones_like(s), torch.zeros_like(s)),
        (g_shape, s.clamp(lo, hi), ((s > lo) & (s < hi)).to(s)),
    ):
        if grad is None:
            continue
        inner = u.mT @ grad @ vh.mT
        near = 0.5 * (slope[:, None, :] + slope[:, :, None])
        rise = (value[:, None, :] - value[:, :, None]) / torch.where(apart == 0, 1.0, apart)
        a = torch.where(apart.abs() < small, near, rise)
        b = (value[:, None, :] + value[:, :, None]) / both
        moved = 0.5 * ((a + b) * inner + (a - b) * inner.mT)
        index = torch.arange(3, device=s.device)
        moved[:, index, index] = slope * inner[:, index, index]
        found = found + u @ moved @ vh
    return torch.where(finite[:, None, None], found, 0.0), None, None


torch.library.register_autograd(
    "gsfluent::polar_clamped", _polar_backward, setup_context=_polar_setup
)
no_gradient(
    "axes of Gaussians: no gradient", "carry_place", "covariance_axes", "carry_axes",
    "cut_at_cells", "cut_by_planes", "link_states",
)  # fmt: skip
