"""Enclosing ellipsoids in plain PyTorch: what ``mvee`` and ``mvee_lens`` are tested against."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def mvee(
    points: Tensor, *, tolerance: float = 1e-4, max_iterations: int = 1000
) -> tuple[Tensor, Tensor]:
    """Smallest ellipsoid around each set, by Khachiyan's algorithm with away steps.

    Args:
        points: [B, N, 3], spanning three dimensions, finite.
        tolerance: Relative optimality gap.
        max_iterations: Bound on the iterations.

    Returns:
        ``(center, shape)``, [B, 3] and [B, 3, 3], scaled to contain every point.
    """
    batch = points.shape[0]
    lifted = torch.cat([points, torch.ones_like(points[..., :1])], dim=2)
    rows = torch.arange(batch, device=points.device)
    # Start from extreme points in three independent directions (Kumar and Yildirim 2005).
    weight = torch.zeros_like(points[..., 0])
    direction, before = torch.zeros_like(points[:, 0]), torch.zeros_like(points[:, 0])
    direction[:, 0] = 1.0
    for axis in range(3):
        along = (points @ direction[..., None])[..., 0]
        ends = along.argmax(1), along.argmin(1)
        for j in ends:
            weight[rows, j] += 1.0 / 6.0
        difference = points[rows, ends[0]] - points[rows, ends[1]]
        if axis == 0:
            zero = torch.zeros_like(difference[:, 0])
            direction = torch.stack([-difference[:, 1], difference[:, 0], zero], dim=1)
        else:
            direction = torch.linalg.cross(before, difference, dim=1)
        before = difference
    for _ in range(max_iterations):
        moment = (lifted * weight[..., None]).mT @ lifted
        m = (lifted @ torch.linalg.inv(moment) * lifted).sum(2)
        high, j_high = m.max(1)
        low, j_low = torch.where(weight > 0, m, torch.inf).min(1)
        if bool((torch.maximum(high - 4.0, 4.0 - low) <= 4.0 * tolerance).all()):
            break
        toward = high - 4.0 >= 4.0 - low
        j, value = torch.where(toward, j_high, j_low), torch.where(toward, high, low)
        step = (value - 4.0) / (4.0 * (value - 1.0))
        owned = weight[rows, j]
        limit = -owned / (1.0 - owned)
        drop = ~toward & ((value <= 1.0) | (step <= limit))
        step = torch.where(drop, limit, step)
        weight = (1.0 - step)[:, None] * weight
        weight[rows, j] = torch.where(drop, 0.0, weight[rows, j] + step)
    center = (weight[..., None] * points).sum(1)
    offset = points - center[:, None]
    shape = 3.0 * (offset * weight[..., None]).mT @ offset
    reach = (offset @ torch.linalg.inv(shape) * offset).sum(2).amax(1).clamp(min=1.0)
    return center, reach[:, None, None] * shape


def fibonacci_directions(count: int, like: Tensor) -> Tensor:
    """Evenly spread unit vectors, [count, 3]."""
    i = torch.arange(count, dtype=like.dtype, device=like.device)
    z = 1.0 - (2.0 * i + 1.0) / count
    angle = math.pi * (3.0 - 5.0**0.5) * i
    r = (1.0 - z * z).sqrt()
    return torch.stack([r * angle.cos(), r * angle.sin(), z], dim=1)


def lens_points(
    mean_a: Tensor, cov_a: Tensor, mean_b: Tensor, cov_b: Tensor, *, radius: float, count: int
) -> tuple[Tensor, Tensor]:
    """Boundary points of the overlap of each pair of ellipsoids, and whether there is any.

    Args:
        mean_a: Centres, [B, 3].
        cov_a: Covariances, [B, 3, 3].
        mean_b: Centres, [B, 3].
        cov_b: Covariances, [B, 3, 3].
        radius: Size of the ellipsoids in standard deviations.
        count: Points per pair.

    Returns:
        ``(points [B, count, 3], overlap [B])``; points of a pair without overlap mean nothing.
    """
    w_a = torch.linalg.inv(cov_a) / radius**2
    w_b = torch.linalg.inv(cov_b) / radius**2

    def depth(lam: Tensor) -> tuple[Tensor, Tensor]:
        """Min over x of lam q_a + (1 - lam) q_b and its minimizer."""
        a, b = lam[:, None, None] * w_a, (1.0 - lam)[:, None, None] * w_b
        x = torch.linalg.solve(a + b, a @ mean_a[..., None] + b @ mean_b[..., None])[..., 0]
        value = ((x - mean_a)[:, None] @ a @ (x - mean_a)[..., None])[:, 0, 0]
        value = value + ((x - mean_b)[:, None] @ b @ (x - mean_b)[..., None])[:, 0, 0]
        return value, x

    lo, hi = torch.zeros_like(mean_a[:, 0]), torch.ones_like(mean_a[:, 0])
    for _ in range(100):
        left, right = lo + (hi - lo) / 3.0, hi - (hi - lo) / 3.0
        below = depth(left)[0] < depth(right)[0]
        lo, hi = torch.where(below, left, lo), torch.where(below, hi, right)
    deepest, inner = depth(0.5 * (lo + hi))

    v = fibonacci_directions(count, mean_a)
    spread = torch.linalg.cholesky(torch.linalg.inv(w_a + w_b))
    v = v[None] @ spread.mT
    distance = torch.full(v.shape[:2], torch.inf, dtype=v.dtype, device=v.device)
    for mean, w in ((mean_a, w_a), (mean_b, w_b)):
        off = inner - mean
        a = (v @ w * v).sum(2)
        b = (v @ w @ off[..., None])[..., 0]
        c = (off[:, None] @ w @ off[..., None])[:, 0] - 1.0
        root = (b * b - a * c).clamp(min=0.0).sqrt()
        distance = torch.minimum(distance, (root - b) / a)
    return inner[:, None] + distance[..., None] * v, deepest < 1.0


def mvee_lens(
    mean_a: Tensor,
    cov_a: Tensor,
    mean_b: Tensor,
    cov_b: Tensor,
    *,
    radius: float = 2.0,
    count: int = 600,
) -> tuple[Tensor, Tensor, Tensor]:
    """Smallest ellipsoid around densely sampled overlaps, as a Gaussian; see ``gsfluent.ops``.

    No closed form and no lower bound on the semi-axes: what the kernels' special cases are
    compared with.

    Args:
        mean_a: Centres, [B, 3].
        cov_a: Covariances, [B, 3, 3].
        mean_b: Centres, [B, 3].
        cov_b: Covariances, [B, 3, 3].
        radius: Size of the ellipsoids in standard deviations.
        count: Boundary points per pair.

    Returns:
        ``(mean, cov, overlap)``.
    """
    points, overlap = lens_points(mean_a, cov_a, mean_b, cov_b, radius=radius, count=count)
    center, shape = 0.5 * (mean_a + mean_b), torch.zeros_like(cov_a)
    if bool(overlap.any()):
        c, s = mvee(points[overlap], tolerance=2e-3, max_iterations=300)
        center[overlap], shape[overlap] = c, s / radius**2
    return center, shape, overlap
