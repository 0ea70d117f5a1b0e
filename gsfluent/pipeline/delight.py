"""The captured shading divided out of the splats' colours, as far as one capture allows.

A capture sees ``c = a E(n)``: albedo times what the light of that day gave at each normal. With one
capture the two cannot be told apart in general; what can is a smooth ``E`` of low order (spherical
harmonics of degree 2, :mod:`gsfluent.pipeline.environment`) under a prior on the albedo: splats of
one neighbourhood that have the same chromaticity are mostly of one paint (Horn 1974; Barron and
Malik 2015 use both priors), and paint does not know which way the surface looks.

For pairs of splats with alike chromaticity, ``log c_i - log c_j = log E(n_i) - log E(n_j)`` up to
differences of paint, which are outliers: solved by Gauss-Newton on E with Geman-McClure weights.
Cast shadows, highlights, light that bounced off coloured things next to the object, and any paint
that follows the normal (a ball painted dark below) stay in or are taken for light: those are the
limits of one capture. The mean brightness cannot be known; it is kept.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize

from gsfluent import geometry
from gsfluent.data import INTERIOR, Gaussians
from gsfluent.pipeline.render_normals import estimate_normals
from gsfluent.pipeline.shade import harmonics, to_display, to_linear

__all__ = ["Delighting", "delight", "estimate_shading"]

_SAMPLES = 6000  # splats that the light is estimated from
_PARTNERS = 24  # pairs per splat
_CANDIDATES = 160  # of which the most alike in chromaticity are taken
_CHROMA = 0.03  # spread of chromaticities that are one paint
_STEPS = 12
_RIDGE = 1e-3  # pull toward even light
_LEAST = 0.15  # of the mean: the light is nowhere believed darker
_DARK = 0.01  # linear: too dark to say anything
_SEED = 0


class Delighting(NamedTuple):
    """The light of a capture.

    Attributes:
        coefficients: E over its mean on the surface, spherical harmonics of degree 2, [9].
        strength: Standard deviation of E over its mean on the surface.
        spread: Median of ``|log c_i - log c_j|`` over the pairs, before and after.
    """

    coefficients: Tensor
    strength: float
    spread: tuple[float, float]


@torch.no_grad()
def estimate_shading(gaussians: Gaussians, *, normals: Tensor | None = None) -> Delighting:
    """Estimate the light that the colours were captured in.

    Args:
        gaussians: The object as captured, not broken.
        normals: Outward normals [N, 3]; estimated when None.
    """
    normals = estimate_normals(gaussians) if normals is None else normals
    skin = normals.norm(dim=-1) > 0.15
    if gaussians.labels is not None:
        skin &= gaussians.labels != INTERIOR
    linear = to_linear(gaussians.colors()).double()
    grey = linear.mean(-1)
    skin &= (grey > _DARK) & (gaussians.opacities > 0.3)
    index = skin.nonzero()[:, 0]
    even = torch.zeros(9, dtype=torch.float64, device=grey.device)
    even[0] = 1.0 / 0.28209479177387814
    if index.numel() < 100:
        return Delighting(even, 0.0, (0.0, 0.0))
    generator = torch.Generator().manual_seed(_SEED)
    picked = torch.randperm(index.numel(), generator=generator)[:_SAMPLES].to(index.device)
    index = index[picked]
    basis = harmonics(normalize(normals[index].double(), dim=-1))
    level = grey[index].log()
    chroma = linear[index] / linear[index].sum(-1, keepdim=True)
    first, second = _pairs(chroma, generator)
    alike = torch.exp(-0.5 * ((chroma[first] - chroma[second]).norm(dim=-1) / _CHROMA) ** 2)
    target = level[first] - level[second]
    found = _solve(basis, first, second, target, alike, even)
    light = (basis @ found).clamp(min=_LEAST)
    found = found / light.mean()
    light = light.log()
    rest = (target - light[first] + light[second]).abs()
    relative = (basis @ found).clamp(min=_LEAST)
    return Delighting(
        found, float(relative.std()), (float(target.abs().median()), float(rest.median()))
    )


def delight(
    gaussians: Gaussians,
    shading: Delighting | None = None,
    *,
    strength: float = 1.0,
    normals: Tensor | None = None,
) -> Gaussians:
    """Splats with the captured light divided out of their colours; splats of the inside unchanged.

    Args:
        gaussians: The object as captured, not broken.
        shading: From :func:`estimate_shading`; found here when None.
        strength: Share of it that is divided out, 0 to 1.
        normals: Outward normals [N, 3]; estimated when None.
    """
    normals = estimate_normals(gaussians) if normals is None else normals
    if shading is None:
        shading = estimate_shading(gaussians, normals=normals)
    light = harmonics(normalize(normals.double(), dim=-1)) @ shading.coefficients
    light = light.clamp(min=_LEAST).pow(strength).to(gaussians.means)
    # deep below the skin the normal says nothing
    light = torch.where(normals.norm(dim=-1) > 0.05, light, 1.0)
    if gaussians.labels is not None:
        light = torch.where(gaussians.labels == INTERIOR, 1.0, light)
    before = gaussians.colors()
    after = to_display(to_linear(before) / light[:, None])
    ratio = after / before.clamp(min=1.0 / 255.0)
    sh = gaussians.sh * ratio[:, None]
    sh[:, 0] = geometry.rgb_to_sh0(after)
    return gaussians.replace(sh=sh)


def _pairs(chroma: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Rows of splats and of partners of alike chromaticity, each [M]."""
    count = chroma.shape[0]
    candidates = torch.randint(count, (count, _CANDIDATES), generator=generator).to(chroma.device)
    apart = (chroma[:, None] - chroma[candidates]).norm(dim=-1)
    near = apart.topk(_PARTNERS, largest=False).indices
    second = torch.gather(candidates, 1, near).reshape(-1)
    first = torch.arange(count, device=chroma.device).repeat_interleave(_PARTNERS)
    return first, second


def _solve(
    basis: Tensor, first: Tensor, second: Tensor, target: Tensor, alike: Tensor, start: Tensor
) -> Tensor:
    """Coefficients [9] of E by Gauss-Newton on log E with Geman-McClure weights."""
    found = start.clone()
    scale = 1.0
    for step in range(_STEPS):
        light = (basis @ found).clamp(min=_LEAST)
        slope = basis / light[:, None]
        rest = target - light.log()[first] + light.log()[second]
        scale = max(0.1, 2.0 * float(rest.abs().median()) if step else 1.0)
        weight = alike / (1.0 + (rest / scale).square()).square()
        jacobian = slope[first] - slope[second]
        normal = jacobian.T @ (weight[:, None] * jacobian)
        normal += _RIDGE * weight.sum() * torch.eye(9, dtype=normal.dtype, device=normal.device)
        gain = jacobian.T @ (weight * rest) - _RIDGE * weight.sum() * (found - start)
        move = torch.linalg.solve(normal, gain)
        move[0] = 0.0  # the mean is not known
        found = found + move.clamp(-0.5, 0.5)
    return found
