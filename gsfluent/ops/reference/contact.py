"""Contact between fields in plain PyTorch, every node at once: the definition, for tests.

Written from docs/theory/contact.md, not from the kernels; run it in float64. Differentiable on the
piece (touching or not, sticking or sliding, which normal) the forward pass is on.
"""

from __future__ import annotations

import itertools

import torch
from torch import Tensor

STEPS = list(itertools.product((-1, 0, 1), repeat=3))
"""The node itself (13th of 27) and its neighbours."""
LIGHT = 1e-4  # of the heaviest neighbour: below it a centroid is not trusted
ROUGH = (0.1, 0.2)  # cells by which one body's own direction must part better, and clearly better


def _unit(vector: Tensor) -> tuple[Tensor, Tensor]:
    """Unit vectors and lengths [..., 1], without a 0 / 0 in the gradient."""
    squared = (vector * vector).sum(-1, keepdim=True)
    zero = squared == 0
    length = torch.where(zero, 0.0, torch.where(zero, 1.0, squared).sqrt())
    return vector / torch.where(zero, 1.0, length), length


def contact_normal(mass: tuple[Tensor, Tensor], moment: tuple[Tensor, Tensor]) -> tuple:
    """Unit normal out of the first body and where there is one.

    Args:
        mass: Of both bodies at the node and its neighbours in the order of ``STEPS``, [..., 27].
        moment: First moments in cells [kg], [..., 27, 3].

    Returns:
        Normals [..., 3]; bool [...].
    """
    step = mass[0].new_tensor(STEPS)
    weight = torch.where(step == 0, 1.0, 0.5).prod(-1, keepdim=True)
    heaviest = [m.amax(-1, keepdim=True) for m in mass]
    out, known = [], []
    for m, largest in zip(moment, heaviest, strict=True):
        direction, length = _unit(-(weight * m).sum(-2))
        out.append(direction)
        known.append(length > 1e-6 * largest)
    mean, length = _unit(out[0] - out[1])
    opposed = length >= 0.1
    mean = torch.where(opposed, mean, out[0])
    candidate = torch.stack([mean, out[0], -out[1]], dim=-2)  # [..., 3, 3]
    ends = []
    for m, first, largest, sign in zip(mass, moment, heaviest, (1.0, -1.0), strict=True):
        trusted = m > LIGHT * largest
        center = step + first / torch.where(trusted, m, 1.0)[..., None]
        along = sign * torch.einsum("...ok,...ck->...co", center, candidate)
        ends.append(torch.where(trusted[..., None, :], along, -16.0).amax(-1))
    gap = -(ends[0] + ends[1])
    second = (gap[..., 2] > gap[..., 1])[..., None]
    better = torch.where(second, gap[..., 2:], gap[..., 1:2]) - gap[..., :1]
    share = ((better - ROUGH[0]) / (ROUGH[1] - ROUGH[0])).clamp(0.0, 1.0)
    share = torch.where(opposed, share, (better > 0).to(share.dtype))
    own = torch.where(second, -out[1], out[0])
    mixed, size = _unit(mean + share * (own - mean))
    both = known[0] & known[1]
    normal = torch.where(both, mixed, torch.where(known[0], out[0], -out[1]))
    some = torch.where(both, size > 0.1, known[0] | known[1])
    return normal, some.squeeze(-1)


def contact(
    velocity: tuple[Tensor, Tensor],
    mass: tuple[Tensor, Tensor],
    moment: tuple[Tensor, Tensor],
    law: tuple[float, float, float],
) -> tuple[Tensor, Tensor, Tensor]:
    """One pair of fields at every node: new velocities of both and where they touched.

    Args:
        velocity: [..., 3] [m/s].
        mass: Of the node and its neighbours [kg], [..., 27]; 0 where there is none.
        moment: [kg], [..., 27, 3].
        law: Friction, restitution, gap in cells.
    """
    friction, restitution, gap = law
    n, touch = contact_normal(mass, moment)
    ma, mb = mass[0][..., 13, None], mass[1][..., 13, None]
    shared = (ma > 0) & (mb > 0)
    ma, mb = torch.where(shared, ma, 1.0), torch.where(shared, mb, 1.0)
    apart = ((moment[1][..., 13, :] / mb - moment[0][..., 13, :] / ma) * n).sum(-1, keepdim=True)
    relative = velocity[0] - velocity[1]
    approach = (relative * n).sum(-1, keepdim=True)
    touch = touch[..., None] & shared & (apart <= gap) & (approach > 0)
    reduced = ma * mb / (ma + mb)
    jn = (1 + restitution) * reduced * approach
    slip = relative - approach * n
    _, speed = _unit(slip)
    # min(friction j_n, m_r |slip|) slip / |slip|, without the 0 / 0 of a node that does not slide.
    slides = (friction * jn < reduced * speed) & (speed > 0)
    drag = torch.where(slides, friction * jn / torch.where(slides, speed, 1.0), reduced)
    impulse = torch.where(touch, jn * n + drag * slip, 0.0)
    return velocity[0] - impulse / ma, velocity[1] + impulse / mb, touch.squeeze(-1)


def pairs(bits: Tensor) -> Tensor:
    """int64 [K] of bit masks -> bool [K, K]."""
    place = torch.arange(len(bits), device=bits.device)
    return (bits[:, None] >> place & 1).bool()


def groups(merged: Tensor, present: Tensor) -> Tensor:
    """Fields that move as one at each node: the pairs between present fields, transitively.

    Args:
        merged: bool [K, K].
        present: Fields with mass at each node, bool [K, ...].

    Returns:
        bool [..., K, K]; a present field is in its own group.
    """
    k = len(merged)
    here = present.movedim(0, -1)
    linked = (merged | merged.mT | torch.eye(k, dtype=torch.bool, device=merged.device)).expand(
        *here.shape, k
    )
    linked = linked & here[..., None] & here[..., None, :]
    for _ in range(k.bit_length()):
        linked = (linked.double() @ linked.double()) > 0
    return linked


def merge(velocity: Tensor, mass: Tensor, group: Tensor) -> Tensor:
    """Common velocity of every group: [K, ..., 3] from mass [K, ..., 1] and groups [..., K, K]."""
    share = group.to(mass.dtype) * mass.squeeze(-1).movedim(0, -1)[..., None, :]
    total = share.sum(-1, keepdim=True)
    share = share / torch.where(total > 0, total, 1.0)
    common = torch.einsum("...fg,g...c->f...c", share, velocity)
    return torch.where(mass > 0, common, velocity)
