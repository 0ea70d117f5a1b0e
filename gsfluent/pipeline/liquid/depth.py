"""Which points of a liquid lie deep in it, where nobody sees them."""

from __future__ import annotations

import torch
from torch import Tensor

CELL = 1.5
"""Edge of a cell, in spacings: inside a liquid none is empty."""
_SIDE = 1 << 20


def deep(position: Tensor, spacing: float) -> Tensor:
    """Points around which all cells within two are occupied.

    Args:
        position: Points [m], [N, 3].
        spacing: Their distance inside the liquid [m].

    Returns:
        bool [N].
    """
    cell = torch.floor(position.double() / (CELL * spacing)).long()
    cell = (cell - cell.amin(dim=0) + 2).clamp(max=_SIDE - 3)
    keys, home = torch.unique(
        (cell[:, 0] * _SIDE + cell[:, 1]) * _SIDE + cell[:, 2], return_inverse=True
    )
    step = torch.tensor([-1, 0, 1], device=keys.device)
    around = ((step[:, None, None] * _SIDE + step[:, None]) * _SIDE + step).flatten()
    near = keys[:, None] + around
    place = torch.searchsorted(keys, near).clamp(max=keys.shape[0] - 1)
    there = keys[place] == near
    full = there.all(dim=1)
    return (there & full[place]).all(dim=1)[home]
