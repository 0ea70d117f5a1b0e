"""Splats that are wide beside the points they follow, divided into ones that are not.

A flat patch of skin may be one splat over many points. Where it breaks, its points part, but it
cannot: it ends in a blur that the crack does not have. So it is made of smaller ones before
anything moves: a lattice of narrower Gaussians of the same colour, whose opacities are found such
that together they hide at the centres and midway between what the wide one of opacity o hid::

    1 - prod_j (1 - o_j g_ij) = o exp(-sum_a x_ia^2 / (2 s_a^2))
"""

from __future__ import annotations

import torch
from torch import Tensor

from gsfluent import geometry
from gsfluent.data import SURFACE, Gaussians

NARROW = 0.75
"""Standard deviation of the parts, as a share of the widest that is left alone."""
STEP = 1.5
"""Distance of their centres, in their standard deviations."""
_REACH = 2.2  # deviations of the wide splat up to which it is made anew
_LEAST = 1.0 / 255.0  # opacity below which a part is left out
_OPAQUE = 0.99
_ROUNDS = 8  # of the multiplicative fit; more change nothing to see
MOST = 1_000_000
"""Parts that all splats together become at most; beyond that wider ones are left alone."""
_AT_ONCE = 4_000_000  # pairs of parts


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
        narrow = splats.scales[rows].clamp(max=NARROW * widest)
        narrow = torch.where(splats.scales[rows] > widest, narrow, splats.scales[rows])
        ratio = splats.scales[rows] / narrow
        half = torch.ceil(_REACH * ratio / STEP - 0.5).long().clamp(min=1)
        half = torch.where(ratio > 1.0, half, 0)
        if float((2.0 * half + 1.0).prod(dim=1).sum()) <= MOST:
            break
        widest *= 1.25
    parts = [splats.select(~wide)]
    for counts in torch.unique(half, dim=0):
        mine = (half == counts).all(dim=1).nonzero()[:, 0]
        lattice, places = (_lattice([f * int(n) for n in counts], STEP / f, rows) for f in (1, 2))
        pairs = lattice.shape[0] * places.shape[0]
        for some in mine.split(max(1, _AT_ONCE // pairs)):
            parts.append(_parts(splats.select(rows[some]), narrow[some], lattice, places))
    return Gaussians.cat(parts)


def _lattice(counts: list[int], step: float, like: Tensor) -> Tensor:
    """Places -n .. n times ``step`` along three axes, [L, 3]."""
    axes = [torch.arange(-n, n + 1, device=like.device) for n in counts]
    return torch.cartesian_prod(*axes).to(torch.float32) * step


def _parts(wide: Gaussians, narrow: Tensor, lattice: Tensor, places: Tensor) -> Gaussians:
    """Wide splats [M] as splats of deviations ``narrow`` [M, 3] on a lattice [L, 3] of these.

    They are held to the wide ones at ``places`` [P, 3], in the same unit.
    """
    fall = (places[None] * (narrow / wide.scales)[:, None]).square().sum(dim=2)
    hidden = wide.opacities.clamp(max=_OPAQUE)[:, None] * torch.exp(-0.5 * fall)
    opacity = _opacities(-torch.log1p(-hidden), places, lattice)
    place = lattice[None] * narrow[:, None]
    axes = geometry.quaternion_to_matrix(wide.quats)
    means = wide.means[:, None] + (axes[:, None] @ place[..., None])[..., 0]
    kept = opacity > _LEAST
    source, part = kept.nonzero().unbind(dim=1)
    return wide.select(source).replace(
        means=means[source, part], scales=narrow[source], opacities=opacity[source, part]
    )


def _opacities(depth: Tensor, places: Tensor, lattice: Tensor) -> Tensor:
    """Opacities [M, L] of parts that come to optical depths [M, P] at places [P, 3].

    Multiplicative rounds (Richardson 1972, Lucy 1974): they never leave 0..1.
    """
    seen = torch.exp(-0.5 * (places[:, None] - lattice[None]).square().sum(dim=2))
    share = seen / seen.sum(dim=0)
    opacity = -torch.expm1(-(depth @ share) / seen.sum(dim=1).mean())
    for _ in range(_ROUNDS):
        found = -torch.log1p(-opacity[:, None] * seen).sum(dim=2)
        opacity = (opacity * ((depth / found.clamp(min=1e-12)) @ share)).clamp(max=_OPAQUE)
    return opacity
