"""One step of Adam over several tensors at once, in place, rows that were not seen left out."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from gsfluent._check import check_tensor
from gsfluent.ops._register import fakes

_OP = "adam_step"


@torch.no_grad()
def adam_step(
    parameters: Sequence[Tensor],
    gradients: Sequence[Tensor | None],
    exp_avg: Sequence[Tensor],
    exp_avg_sq: Sequence[Tensor],
    *,
    lr: float | Sequence[float],
    step: int,
    betas: tuple[float, float] = (0.9, 0.999),
    eps: float = 1e-8,
    visible: Tensor | None = None,
) -> None:
    """Advance parameters and their moments by one step of Adam.

    ``m += (1 - beta1) (g - m)``, ``v = beta2 v + (1 - beta2) g^2``,
    ``p -= lr m / (1 - beta1^t) / (sqrt(v / (1 - beta2^t)) + eps)``: ``torch.optim.Adam`` without
    weight decay, to rounding.

    A row (index of the first axis) is left out, value and moments untouched, where ``visible`` says
    so, or where its gradient in this tensor holds NaN or Inf: one bad splat must not poison its
    moments for the rest of the run. Nothing is read back from the GPU.

    Args:
        parameters: Tensors with at least one axis, contiguous, all float32 or all float64, on one
            device; changed in place.
        gradients: Their gradients, same shapes; a tensor whose gradient is None is left out.
        exp_avg: First moments, same shapes, contiguous; changed in place.
        exp_avg_sq: Second moments, same shapes, contiguous; changed in place.
        lr: Step size, at least 0; one for all, or one per tensor.
        step: Number of this step, from 1; sets the bias correction.
        betas: Decay of the moments, each in [0, 1).
        eps: Added to the root of the second moment, at least 0.
        visible: Rows that take part: bool, or int32 of which positive ones do (``radii`` of
            :func:`rasterize`; their largest over several cameras), shape [N] with N the rows of
            every tensor; all when None.

    Raises:
        TypeError: Not tensors, or a wrong dtype.
        ValueError: Lengths, shapes, devices or numbers do not fit, or a tensor that is changed is
            not contiguous.

    Gradient: none; gradients are not recorded.
    Determinism: bit-identical for any number of threads, and on CUDA from run to run.
    Source: Kingma and Ba 2015, algorithm 1; rows left out as in Mallick et al. 2024 (Taming 3DGS).
    """
    rates = (
        [float(lr)] * len(parameters) if isinstance(lr, (int, float)) else [float(x) for x in lr]
    )
    lengths = (len(parameters), len(gradients), len(exp_avg), len(exp_avg_sq), len(rates))
    if len(set(lengths)) != 1:
        raise ValueError(
            f"{_OP}: parameters, gradients, exp_avg, exp_avg_sq and lr must be equally many, "
            f"got {', '.join(map(str, lengths))}"
        )
    _check_numbers(rates, step, betas, eps)
    chosen = [i for i, g in enumerate(gradients) if g is not None]
    like = check_tensor(_OP, "parameters[0]", parameters[0]) if parameters else None
    dense: list[Tensor] = []
    for i in chosen:
        gradient = gradients[i]
        assert gradient is not None and like is not None
        parameter = check_tensor(_OP, f"parameters[{i}]", parameters[i], like=like)
        if parameter.dim() == 0:
            raise ValueError(f"{_OP}: parameters[{i}] must have at least one axis, got a scalar")
        dense.append(_check_state(f"gradients[{i}]", gradient, parameter).contiguous())
        changed = (("parameters", parameters), ("exp_avg", exp_avg), ("exp_avg_sq", exp_avg_sq))
        for name, tensors in changed:
            if not _check_state(f"{name}[{i}]", tensors[i], parameter).is_contiguous():
                raise ValueError(f"{_OP}: {name}[{i}] must be contiguous; it is changed in place")
    if not chosen or like is None:
        return
    if visible is not None:
        check_tensor(_OP, "visible", visible, dtype=(torch.bool, torch.int32), like=like)
        for i in chosen:
            if visible.shape != parameters[i].shape[:1]:
                raise ValueError(
                    f"{_OP}: visible must have shape {list(parameters[i].shape[:1])} like the rows "
                    f"of parameters[{i}], got {list(visible.shape)}"
                )
        visible = visible.contiguous()
    changed_tensors = [[group[i] for i in chosen] for group in (parameters, exp_avg, exp_avg_sq)]
    torch.ops.gsfluent.adam_step(
        changed_tensors[0],
        dense,
        changed_tensors[1],
        changed_tensors[2],
        [rates[i] for i in chosen],
        *betas,
        eps,
        step,
        visible,
    )
    # a backward pass that saved an old value must notice
    torch.autograd.graph.increment_version([t for group in changed_tensors for t in group])


def _check_state(name: str, value: Tensor, parameter: Tensor) -> Tensor:
    return check_tensor(_OP, name, value, shape=tuple(parameter.shape), like=parameter)


def _check_numbers(
    rates: Sequence[float], step: int, betas: tuple[float, float], eps: float
) -> None:
    if not all(0.0 <= rate < math.inf for rate in rates):
        raise ValueError(f"{_OP}: lr must be finite and at least 0, got {list(rates)}")
    if isinstance(step, bool) or not isinstance(step, int):
        raise TypeError(f"{_OP}: step must be an int, got {type(step).__name__}")
    if step < 1:
        raise ValueError(f"{_OP}: step must be at least 1, got {step}")
    if len(betas) != 2 or not all(0.0 <= beta < 1.0 for beta in betas):
        raise ValueError(f"{_OP}: betas must be two numbers in [0, 1), got {betas}")
    if not 0.0 <= eps < math.inf:
        raise ValueError(f"{_OP}: eps must be finite and at least 0, got {eps}")


fakes(adam_step=lambda *inputs: None)
