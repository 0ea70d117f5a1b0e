"""Smallest ellipsoid around an overlap, by dense sampling and zooming: the truth for ``mvee_lens``.

Shares no step with the kernels but the algebra of the two ellipsoids: rays from an inner point
instead of the rim's tangent, Khachiyan's algorithm instead of an interior-point method, random
zooming instead of Newton's method.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gsfluent.ops.reference.mvee import fibonacci_directions, mvee


class _Overlap:
    """The overlap of each pair as a set of rays from a point inside both."""

    def __init__(self, mean_a: Tensor, cov_a: Tensor, mean_b: Tensor, cov_b: Tensor, radius: float):
        self.means = mean_a, mean_b
        self.weights = tuple(torch.linalg.inv(c) / radius**2 for c in (cov_a, cov_b))
        w_a, w_b = self.weights
        low, high = torch.zeros_like(mean_a[:, 0]), torch.ones_like(mean_a[:, 0])
        for _ in range(80):  # the deepest point: both ellipsoids equally far around it
            t = (0.5 * (low + high))[:, None, None]
            a, b = t * w_a, (1.0 - t) * w_b
            x = torch.linalg.solve(a + b, a @ mean_a[..., None] + b @ mean_b[..., None])[..., 0]
            deeper = self.value(0, x) > self.value(1, x)
            low = torch.where(deeper, t[:, 0, 0], low)
            high = torch.where(deeper, high, t[:, 0, 0])
        self.inner = x
        # In these units the smaller of the two is round about the inner point.
        self.spread = torch.linalg.cholesky(torch.linalg.inv(w_a + w_b))

    def recentre(self, inner: Tensor, shape: Tensor) -> None:
        self.inner, self.spread = inner, torch.linalg.cholesky(shape)

    def value(self, which: int, x: Tensor) -> Tensor:
        off = x - self.means[which]
        return (off[:, None] @ self.weights[which] @ off[..., None])[:, 0, 0]

    def distances(self, v: Tensor) -> Tensor:
        """Where the rays ``v`` [B, N, 3] leave either ellipsoid, [2, B, N]."""
        out = []
        for mean, w in zip(self.means, self.weights, strict=True):
            off = self.inner - mean
            a = (v @ w * v).sum(2)
            b = (v @ w @ off[..., None])[..., 0]
            c = (off[:, None] @ w @ off[..., None])[:, 0] - 1.0
            root = (b * b - a * c).clamp(min=0.0).sqrt()
            out.append(torch.where(b > 0.0, -c / (b + root), (root - b) / a))
        return torch.stack(out)

    def surface(self, directions: Tensor) -> Tensor:
        """Surface points of the overlap along ``directions`` [B, N, 3]."""
        v = directions @ self.spread.mT
        return self.inner[:, None] + self.distances(v).amin(0)[..., None] * v


def _farthest(points: Tensor, center: Tensor, shape: Tensor) -> Tensor:
    off = points - center[:, None]
    return (off @ torch.linalg.inv(shape) * off).sum(2)


def mvee_lens_dense(
    mean_a: Tensor,
    cov_a: Tensor,
    mean_b: Tensor,
    cov_b: Tensor,
    *,
    radius: float = 2.0,
    rays: int = 2000,
    rounds: int = 10,
    seed: int = 0,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Bounds of the smallest volume around each overlap, float64.

    Args:
        mean_a: Centres, [B, 3]; every pair must overlap.
        cov_a: Covariances, [B, 3, 3].
        mean_b: Centres, [B, 3].
        cov_b: Covariances, [B, 3, 3].
        radius: Size of the ellipsoids in standard deviations.
        rays: Rays per pair from which the searches start.
        rounds: Searches for points outside the fit.
        seed: Of the zooming.

    Returns:
        ``(center [B, 3], shape [B, 3, 3], excess [B], points [B, N, 3])``: the smallest ellipsoid
        around N points of the overlap, whose volume no ellipsoid around the overlap falls short of
        by more than the tolerance of the fit (2e-5), and how far the overlap reaches out of it, as
        the largest squared distance less one.
    """
    generator = torch.Generator().manual_seed(seed)
    lens = _Overlap(mean_a.double(), cov_a.double(), mean_b.double(), cov_b.double(), radius)
    batch = mean_a.shape[0]
    start = fibonacci_directions(rays, lens.inner).expand(batch, -1, -1)
    for _ in range(3):  # rays spread evenly over the overlap itself, however flat
        dense = lens.surface(start)
        _, shape = mvee(dense[:, :: max(1, rays // 60)], tolerance=1e-2, max_iterations=300)
        lens.recentre(dense.mean(1), shape)
    dense = lens.surface(start)
    chosen = dense[:, :: max(1, rays // 60)]
    rows = torch.arange(batch)[:, None]
    for _ in range(rounds):
        center, shape = mvee(chosen, tolerance=1e-5, max_iterations=6000)
        top = _farthest(dense, center, shape).topk(24, dim=1).indices
        # Spread starts as well: the furthest rays may all lie about one maximum.
        spread = torch.randint(rays, (batch, 24), generator=generator)
        at = start[rows, torch.cat([top, spread], 1)]
        best = _farthest(lens.surface(at), center, shape)
        width = 0.15
        for _ in range(28):
            noise = torch.randn(batch, at.shape[1], 24, 3, generator=generator, dtype=torch.float64)
            near = at[:, :, None] + width * noise
            near = near / near.norm(dim=3, keepdim=True)
            q = _farthest(lens.surface(near.flatten(1, 2)), center, shape).view(near.shape[:3])
            value, index = q.max(2)
            better = value > best
            moved = near.gather(2, index[..., None, None].expand(-1, -1, 1, 3))[:, :, 0]
            at = torch.where(better[..., None], moved, at)
            best = torch.maximum(best, value)
            width *= 0.7
        excess = best.amax(1) - 1.0
        if bool((excess < 2e-5).all()):
            break
        # Keep what touches the fit, add what reaches out.
        touching = _farthest(chosen, center, shape).topk(min(60, chosen.shape[1]), dim=1).indices
        chosen = torch.cat([chosen[rows, touching], lens.surface(at)], 1)
    return center, shape, excess, chosen
