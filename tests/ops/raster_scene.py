"""Scenes shared by the rasterizer's tests: built from a seed, small enough for the reference."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

WIDTH, HEIGHT = 50, 38  # neither is a multiple of the tile


def camera() -> tuple[Tensor, Tensor]:
    """A camera at the origin looking along +z with a slight turn; viewmat and K in float64."""
    angle = torch.tensor(0.1, dtype=torch.float64)
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[0, 0] = viewmat[2, 2] = angle.cos()
    viewmat[0, 2], viewmat[2, 0] = angle.sin(), -angle.sin()
    viewmat[:3, 3] = torch.tensor([-0.2, 0.05, 0.3])
    K = torch.tensor([[60.0, 0, 26.0], [0, 62.0, 18.0], [0, 0, 1]], dtype=torch.float64)
    return viewmat, K


def cameras(count: int) -> tuple[Tensor, Tensor]:
    """Cameras around the one above: viewmats [count, 4, 4] and Ks [count, 3, 3] in float64."""
    viewmat, K = camera()
    step = torch.arange(count, dtype=torch.float64)
    viewmats, Ks = viewmat.repeat(count, 1, 1), K.repeat(count, 1, 1)
    viewmats[:, 0, 3] += 0.3 * step
    viewmats[:, 2, 3] += 0.2 * step
    Ks[:, :2, :2] *= 1.0 + 0.1 * step[:, None, None]
    return viewmats, Ks


def scene(count: int, *, degree: int = 3, seed: int = 1) -> dict[str, Tensor]:
    """Random float64 Gaussians in front of :func:`camera`, with all optional inputs but groups."""
    g = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=g, dtype=torch.float64)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=g, dtype=torch.float64)

    means = normal(count, 3) * 0.5
    means[:, 2] += 3.0
    return {
        "means": means,
        "opacities": 0.05 + 0.95 * uniform(count),
        "quats": normal(count, 4),
        "scales": 0.02 + 0.2 * uniform(count, 3),
        "sh": 0.3 * normal(count, (degree + 1) ** 2, 3),
        "background": uniform(3),
        "normals": normal(count, 3),
        "means2d_offset": 0.5 * normal(count, 2),
    }


HARD = ("behind", "border", "needles", "points", "huge", "transparent", "coincident", "opaque")


def hard_scene(kind: str, count: int = 60) -> dict[str, Tensor]:
    """A scene of :func:`scene`, half of whose Gaussians are of one of the kinds in ``HARD``."""
    inputs = scene(count, degree=1, seed=21)
    g = torch.Generator().manual_seed(22)
    half = torch.arange(count) % 2 == 0
    many = int(half.sum())

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=g, dtype=torch.float64)

    means, scales, opacities = inputs["means"], inputs["scales"], inputs["opacities"]
    if kind == "behind":  # and beside the camera, some closer than the near plane
        means[half, 2] = uniform(-3.0, 0.3, many)
    elif kind == "border":
        means[half, 0] = means[half, 2] * torch.where(uniform(0, 1, many) < 0.5, -0.6, 0.45)
        means[half, 1] *= 2.5
    elif kind == "needles":
        scales[half] = torch.stack([uniform(0.5, 2.0, many), *uniform(1e-6, 1e-3, 2, many)], -1)
    elif kind == "points":
        scales[half] = 0.0
    elif kind == "huge":
        scales[half] = 10 ** uniform(0.0, 3.0, many, 3)
        opacities[half] *= 0.3
    elif kind == "transparent":
        opacities[half] = torch.where(uniform(0, 1, many) < 0.2, 0.0, uniform(0.0, 0.02, many))
    elif kind == "coincident":
        for value in (means, scales, inputs["quats"]):
            value[half] = value[0].clone()
    elif kind == "opaque":  # the cap binds, pixels stop early
        opacities[half] = uniform(0.9, 3.0, many)
        scales[half] *= 3
    else:
        raise ValueError(kind)
    return inputs


def render(op: Any, inputs: dict[str, Tensor], **options: Any) -> Any:
    """Call `op` (the operator or the reference) on a scene."""
    viewmat, K = camera()
    rest = {k: v for k, v in inputs.items() if k not in ("means", "opacities")}
    return op(inputs["means"], inputs["opacities"], viewmat, K, WIDTH, HEIGHT, **rest, **options)


def relative_error(value: Tensor, expected: Tensor) -> float:
    """Largest difference over the largest expected magnitude."""
    scale = expected.abs().max().clamp(min=1e-30)
    return ((value.double() - expected.double()).abs().max() / scale).item()
