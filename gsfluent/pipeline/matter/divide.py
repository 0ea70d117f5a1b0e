"""Splats that are wide beside the points they follow, divided into ones that are not.

A flat patch of skin may be one splat over many points. Where it breaks, its points part, but it
cannot: it ends in a blur that the crack does not have. So it is made of smaller ones before
anything moves: a lattice of narrower Gaussians of the same colour, whose opacities are found such
that together they hide at the centres and midway between what the wide one of opacity o hid::

    1 - prod_j (1 - o_j g_ij) = o exp(-sum_a x_ia^2 / (2 s_a^2))

In units of the narrow ones this depends on the opacity and on how many there are along each axis.
"""

from __future__ import annotations

import functools

import torch
from torch import Tensor

from gsfluent import geometry
from gsfluent.data import SURFACE, Gaussians

NARROW = 0.75
"""Standard deviation of the parts at most, as a share of the widest that is left alone."""
STEP = 1.5
"""Distance of their centres, in their standard deviations."""
MOST = 1_000_000
"""Parts that all splats together become at most; for more, wider ones are left alone."""
_REACH = 2.4  # deviations of the wide splat up to which it is made anew
_HALF = (0, 60, 11, 3)  # parts to each side at most, of splats with so many wide axes
_LEAST = 1.0 / 255.0  # opacity below which a part is left out
_OPAQUE = 0.99
_OPACITIES = 65  # of wide splats that are fitted; what lies between is interpolated
_TOGETHER = {"cpu": 1 << 20}  # numbers of the fit that are worked on at once: as the cache is
_TOGETHER_ELSEWHERE = 1 << 24  # where launches cost more than memory
_ROUNDS = 12  # of the multiplicative fit; more change nothing to see


def divide_wide(splats: Gaussians, widest: float) -> Gaussians:
    """Replace skin with a standard deviation above ``widest`` by lattices of narrower splats.

    What is inside is not divided: where it is laid open, faces hide it.

    Args:
        splats: At rest, N.
        widest: Largest standard deviation that is left [length units of the splats], positive.

    Returns:
        The splats without the wide ones, in their order, then the parts; ``splats`` itself when
        none is wide.
    """
    skin = torch.ones_like(splats.opacities, dtype=torch.bool)
    if splats.labels is not None:
        skin = splats.labels == SURFACE
    while True:
        wide = skin & (splats.scales > widest).any(dim=1)
        if not bool(wide.any()):
            return splats
        rows = wide.nonzero()[:, 0]
        across = splats.scales[rows] > widest
        most = torch.tensor(_HALF, device=rows.device)[across.sum(dim=1)]
        half = torch.ceil(_REACH * splats.scales[rows] / (NARROW * widest * STEP) - 0.5).long()
        half = torch.where(across, half.clamp(min=1).minimum(most[:, None]), 0)
        if float(geometry.product(2.0 * half + 1.0).sum()) <= MOST:
            break
        widest *= 1.25
    parts = [splats.select(~wide)]
    for counts in torch.unique(half, dim=0):
        mine = rows[(half == counts).all(dim=1)]
        parts.append(_parts(splats.select(mine), counts))
    return Gaussians.cat(parts)


def _parts(wide: Gaussians, counts: Tensor) -> Gaussians:
    """Wide splats [M] as lattices of ``counts`` [3] narrower ones to each side."""
    ratio, lattice, table = _table(tuple(counts.tolist()), counts.device)
    row = wide.opacities.clamp(0.0, _OPAQUE) / _OPAQUE * (_OPACITIES - 1)
    low = row.long().clamp(max=_OPACITIES - 2)
    opacity = torch.lerp(table[low], table[low + 1], (row - low)[:, None])
    narrow = wide.scales / ratio
    source, part = (opacity > _LEAST).nonzero().unbind(dim=1)
    axes = geometry.quaternion_to_matrix(wide.quats)
    place = lattice[part] * narrow[source]
    return wide.select(source).replace(
        means=wide.means[source] + (axes[source] @ place[..., None])[..., 0],
        scales=narrow[source],
        opacities=opacity[source, part],
    )


@functools.lru_cache(maxsize=64)
def _table(counts: tuple[int, ...], device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """Splats of ``counts`` parts to each side, whatever they are.

    Returns:
        By how much parts are narrower [3], their places [L, 3], and their opacities
        [_OPACITIES, L] by the splat's own.
    """
    n = torch.tensor(counts, device=device)
    ratio = torch.where(n > 0, STEP * (n + 0.5) / _REACH, 1.0)  # of the deviations
    lattice, places = (_lattice([f * m for m in counts], STEP / f, ratio) for f in (1, 2))
    known = torch.linspace(0.0, _OPAQUE, _OPACITIES, device=device)
    hidden = known[:, None] * torch.exp(-0.5 * (places / ratio).square().sum(dim=1))
    return ratio, lattice, _opacities(-torch.log1p(-hidden), places, lattice)


def _lattice(counts: list[int], step: float, like: Tensor) -> Tensor:
    """Places -n .. n times ``step`` along three axes, [L, 3]."""
    axes = [torch.arange(-n, n + 1, device=like.device) for n in counts]
    return torch.cartesian_prod(*axes).to(torch.float32) * step


def _opacities(depth: Tensor, places: Tensor, lattice: Tensor) -> Tensor:
    """Opacities [M, L] of parts that come to optical depths [M, P] at places [P, 3].

    Multiplicative rounds (Richardson 1972, Lucy 1974): they never leave 0..1.
    """
    seen = torch.exp(-0.5 * (places[:, None] - lattice[None]).square().sum(dim=2))
    share = seen / seen.sum(dim=0)
    opacity = -torch.expm1(-(depth @ share) / seen.sum(dim=1).mean())
    most = _TOGETHER.get(depth.device.type, _TOGETHER_ELSEWHERE)
    together = max(1, most // seen.numel())  # rows
    for _ in range(_ROUNDS):
        found = torch.cat(
            [-torch.log1p(-some[:, None] * seen).sum(dim=2) for some in opacity.split(together)]
        )
        opacity = (opacity * ((depth / found.clamp(min=1e-12)) @ share)).clamp(max=_OPAQUE)
    return opacity
