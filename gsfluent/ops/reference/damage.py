"""The damage field on a dense grid in plain PyTorch: the definition of ``damage_solve``, for tests.

Written from docs/theory/phase-field.md, not from the operator; run it in float64.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gsfluent.ops.reference.mpm import stencil
from gsfluent.ops.reference.phase_field import DRIVE_MAX, EMPTY

OMEGA = 1.5
"""Over-relaxation."""
_PAD = 3


def damage_solve(
    drive: Tensor,
    volume: Tensor,
    position: Tensor,
    damage: Tensor,
    *,
    dx: float,
    length: Tensor,
    model: str = "at1",
    sweeps: int = 4,
) -> tuple[Tensor, Tensor, Tensor]:
    """One solve of one field.

    Args:
        drive: H over its threshold, [N].
        volume: At rest [m^3], [N].
        position: [m], [N, 3].
        damage: d of each point, [N].
        dx: Node spacing [m].
        length: l of each point [m], [N].
        model: ``at1`` or ``at2``.
        sweeps: Of red-black SOR.

    Returns:
        ``(damage [N], nodes [X, Y, Z], volumes [X, Y, Z])``.
    """
    node, weight, _ = stencil(position, dx)
    low = node.amin(dim=(0, 1)) - _PAD
    size = (node.amax(dim=(0, 1)) - low + 1 + _PAD).tolist()
    at = node - low
    flat = ((at[..., 0] * size[1] + at[..., 1]) * size[2] + at[..., 2]).reshape(-1)

    def total(value: Tensor) -> Tensor:
        out = value.new_zeros(size[0] * size[1] * size[2])
        return out.index_add(0, flat, (weight * value[:, None]).reshape(-1)).view(size)

    drive = drive.clamp(max=DRIVE_MAX)
    there = total(volume) > EMPTY * volume.max()
    v, vh, vk = (
        torch.where(there, total(volume * factor), 0.0)
        for factor in (torch.ones_like(drive), drive, 2.0 * length**2 / dx**2)
    )
    d = torch.where(there, total(volume * damage) / torch.where(there, v, 1.0), 0.0)
    diagonal, right = (vh, vh - v) if model == "at1" else (vh + 2.0 * v, vh)
    index = torch.meshgrid(*(torch.arange(s) for s in size), indexing="ij")
    parity = (sum(index) + int(low.sum())) % 2
    for _ in range(sweeps):
        for colour in (0, 1):
            around, pull = torch.zeros_like(d), torch.zeros_like(d)
            for axis in range(3):
                for step in (1, -1):
                    both = there & there.roll(step, axis)
                    edge = torch.where(both, 0.5 * (vk + vk.roll(step, axis)), 0.0)
                    around, pull = around + edge, pull + edge * d.roll(step, axis)
            weight_here = diagonal + around
            solved = (right + pull) / torch.where(weight_here > 0, weight_here, 1.0)
            new = (d + OMEGA * (solved - d)).clamp(0.0, 1.0)
            mine = there & (parity == colour) & (weight_here > 0)
            d = torch.where(mine, new, d)
    found = (weight * d.view(-1)[flat].view(weight.shape)).sum(dim=1)
    return torch.maximum(damage, found.clamp(0.0, 1.0)), d, v
