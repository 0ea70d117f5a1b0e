"""What the dispatcher is told of the operators beside their kernels: shapes, missing gradients."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

Shapes = Callable[..., Tensor | tuple[Tensor, ...] | None]


def fakes(**shapes: Shapes) -> None:
    """Register shape functions, for torch.compile and opcheck: empty outputs of the arguments."""
    for name, shape in shapes.items():
        torch.library.register_fake(f"gsfluent::{name}", shape)


def no_gradient(message: str, *names: str) -> None:
    """Say so when somebody wants the gradient of an operator that has none."""

    def refuse(ctx: Any, *grads: Tensor) -> None:
        raise NotImplementedError(message)

    for name in names:
        torch.library.register_autograd(f"gsfluent::{name}", refuse)
