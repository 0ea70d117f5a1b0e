"""The captured shading divided out of the splats' colours, as far as one capture allows.

A capture sees ``c = a E(n)``: albedo times what the light of that day gave at each normal. With one
capture the two cannot be told apart in general; what can is a smooth ``E`` of low order (spherical
harmonics of degree 2, :mod:`gsfluent.pipeline.light.environment`) under a prior on the
albedo: splats of
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
from gsfluent.pipeline.light.normals import estimate_normals
from gsfluent.pipeline.light.shade import harmonics, to_display, to_linear
from gsfluent.results.frames import SavedFrame

_SAMPLES = 3000  # splats that the light is estimated from
_PARTNERS = 40  # pairs per splat
# Spread of chromaticities that are one paint: coloured light tints paint, so not too narrow.
_CHROMA = 0.04
_STEPS = 12
_RIDGE = 1e-3  # pull toward even light
_LEAST = 0.15  # of the mean: the light is nowhere believed darker
_DARK = 0.01  # linear: too dark to say anything
_FEWEST = 100  # splats that light can be estimated from
_SEED = 0


class Shading(NamedTuple):
    """The light of a capture.

    Attributes:
        coefficients: E over its mean on the surface, spherical harmonics of degree 2, one column
            per colour, [9, 3].
        strength: Standard deviation of E over its mean on the surface.
        spread: Median of ``|log c_i - log c_j|`` over the pairs, before and after.
    """

    coefficients: Tensor
    strength: float
    spread: tuple[float, float]


@torch.no_grad()
def estimate_shading(gaussians: Gaussians, *, normals: Tensor | None = None) -> Shading:
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
    if index.numel() < _FEWEST:
        return Shading(even[:, None].expand(9, 3), 0.0, (0.0, 0.0))
    generator = torch.Generator().manual_seed(_SEED)
    picked = torch.randperm(index.numel(), generator=generator)[:_SAMPLES].to(index.device)
    index = index[picked]
    basis = harmonics(normalize(normals[index].double(), dim=-1))
    level = linear[index].clamp(min=1e-4).log()
    chroma = linear[index] / linear[index].sum(-1, keepdim=True)
    count = index.numel()
    first = torch.arange(count, device=index.device).repeat_interleave(_PARTNERS)
    second = torch.randint(count, (count * _PARTNERS,), generator=generator).to(index.device)
    alike = torch.exp(-0.5 * ((chroma[first] - chroma[second]).norm(dim=-1) / _CHROMA) ** 2)
    target = level[first] - level[second]
    columns = [_solve(basis, first, second, target[:, c], alike, even) for c in range(3)]
    found = torch.stack(columns, 1)
    found = found / (basis @ found).clamp(min=_LEAST).mean(0)
    light = (basis @ found).clamp(min=_LEAST)
    rest = target - light.log()[first] + light.log()[second]
    sure = alike > 0.5
    before, after = (values[sure].abs().median() for values in (target, rest))
    return Shading(found, float(light.mean(-1).std()), (float(before), float(after)))


def to_albedo(
    gaussians: Gaussians, *, strength: float = 1.0, normals: Tensor | None = None
) -> Gaussians:
    """Splats with the captured light divided out of their colours; splats of the inside unchanged.

    Args:
        gaussians: The object as captured, not broken.
        strength: Share of the light that is divided out, 0 to 1.
        normals: Outward normals [N, 3]; estimated when None.
    """
    normals = estimate_normals(gaussians) if normals is None else normals
    shading = estimate_shading(gaussians, normals=normals)
    light = harmonics(normalize(normals.double(), dim=-1)) @ shading.coefficients
    light = light.clamp(min=_LEAST).pow(strength).to(gaussians.means)
    # deep below the skin the normal says nothing
    light = torch.where(normals.norm(dim=-1, keepdim=True) > 0.05, light, 1.0)
    if gaussians.labels is not None:
        light = torch.where((gaussians.labels == INTERIOR)[:, None], 1.0, light)
    before = gaussians.colors()
    after = to_display(to_linear(before) / light)
    ratio = after / before.clamp(min=1.0 / 255.0)
    sh = gaussians.sh * ratio[:, None]
    sh[:, 0] = geometry.rgb_to_sh0(after)
    return gaussians.replace(sh=sh)


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


class Albedo:
    """The captured light of a film's objects, found in its first frame, while they are whole.

    Each body has a light of its own, because events turn bodies before they move. Splats that the
    repair adds take the factor of the material point that they follow.

    Args:
        first: The first frame of the film.
        strength: Share of the captured light that is divided out, 0 to 1.
    """

    def __init__(self, first: SavedFrame, strength: float) -> None:
        gaussians = first.gaussians
        count = gaussians.count
        factor = torch.ones(count, 3, dtype=gaussians.dtype, device=gaussians.device)
        normals = estimate_normals(gaussians)
        anchor = first.anchor.long().clamp(min=0)
        body = torch.where(first.anchor >= 0, first.body[anchor].long(), -1)
        body = torch.where(first.ids >= 0, body, -1)
        before = gaussians.colors()
        for number in body.unique().tolist():
            if number < 0:
                continue
            mine = (body == number).nonzero()[:, 0]
            part = gaussians.select(mine)
            after = to_albedo(part, strength=strength, normals=normals[mine]).colors()
            factor[mine] = after / before[mine].clamp(min=1.0 / 255.0)
        # by number of the splat, and by point for splats that come later
        known = (first.ids >= 0) & (body >= 0)
        self._by_id = torch.ones(int(first.ids.clamp(min=0).amax()) + 1, 3).to(factor)
        self._by_id[first.ids[known]] = factor[known]
        points = first.positions.shape[0]
        total = torch.zeros(points, 3).to(factor).index_add_(0, anchor[known], factor[known])
        number_of = (
            torch.zeros(points)
            .to(factor)
            .index_add_(0, anchor[known], torch.ones_like(factor[known, 0]))
        )
        mean = total / number_of.clamp(min=1.0)[:, None]
        self._by_point = torch.where(number_of[:, None] > 0, mean, 1.0)

    def apply(self, frame: SavedFrame) -> Gaussians:
        """The splats of a frame without the captured light."""
        ids, anchor = frame.ids, frame.anchor.long()
        old = (ids >= 0) & (ids < self._by_id.shape[0])
        factor = self._by_id[torch.where(old, ids, 0)]
        point = self._by_point[anchor.clamp(0, self._by_point.shape[0] - 1)]
        follows = (ids >= 0) & (anchor >= 0)
        factor = torch.where(old[:, None], factor, torch.where(follows[:, None], point, 1.0))
        gaussians = frame.gaussians
        sh = gaussians.sh * factor[:, None]
        sh[:, 0] = geometry.rgb_to_sh0(gaussians.colors() * factor)
        return gaussians.replace(sh=sh)
