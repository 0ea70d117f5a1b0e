"""One Adam step in plain PyTorch: the definition the kernels are tested against."""

from __future__ import annotations

import torch
from torch import Tensor


def adam_step(
    parameter: Tensor,
    gradient: Tensor,
    exp_avg: Tensor,
    exp_avg_sq: Tensor,
    *,
    lr: float,
    step: int,
    betas: tuple[float, float] = (0.9, 0.999),
    eps: float = 1e-8,
    visible: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Kingma and Ba 2015, algorithm 1, of one tensor, out of place; see ``gsfluent.ops``.

    Args:
        parameter: Shape [N, ...].
        gradient: Its gradient.
        exp_avg: First moment.
        exp_avg_sq: Second moment.
        lr: Step size.
        step: Number of this step, from 1.
        betas: Decay of the moments.
        eps: Added to the root of the second moment.
        visible: Rows that take part, bool or int32 (positive), shape [N].

    Returns:
        New parameter, first and second moment; rows that were left out are unchanged.
    """
    first = betas[0] * exp_avg + (1.0 - betas[0]) * gradient
    second = betas[1] * exp_avg_sq + (1.0 - betas[1]) * gradient.square()
    mean = first / (1.0 - betas[0] ** step)
    spread = second / (1.0 - betas[1] ** step)
    value = parameter - lr * mean / (spread.sqrt() + eps)
    part = torch.isfinite(gradient)
    while part.dim() > 1:
        part = part.all(-1)
    if visible is not None:
        part = part & (visible > 0)
    part = part.reshape(-1, *[1] * (gradient.dim() - 1))
    return (
        torch.where(part, value, parameter),
        torch.where(part, first, exp_avg),
        torch.where(part, second, exp_avg_sq),
    )
