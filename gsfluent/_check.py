"""The one wording for wrong tensors: ``{op}: {argument} must {requirement}, got {what came}``."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

FLOATING = (torch.float32, torch.float64)


def check_tensor(
    op: str,
    name: str,
    value: object,
    *,
    shape: Sequence[int | str | None] | None = None,
    dtype: torch.dtype | tuple[torch.dtype, ...] | None = FLOATING,
    like: Tensor | None = None,
) -> Tensor:
    """Check type, dtype, shape and device of one tensor argument.

    Args:
        op: Operator name, first word of the message.
        name: Argument name.
        value: What the caller passed.
        shape: Expected sizes; an int must match, ``None`` or a letter (``"N"``) is free.
        dtype: Accepted dtype or dtypes; ``None`` accepts any.
        like: Tensor whose device (and, for floating tensors, dtype) must be shared.

    Returns:
        The tensor itself.

    Raises:
        TypeError: Not a tensor, or a wrong dtype.
        ValueError: Wrong shape or device.
    """
    if not isinstance(value, Tensor):
        raise TypeError(f"{op}: {name} must be a torch.Tensor, got {type(value).__name__}")
    if dtype is not None:
        allowed = dtype if isinstance(dtype, tuple) else (dtype,)
        if value.dtype not in allowed:
            names = " or ".join(str(d).removeprefix("torch.") for d in allowed)
            got = str(value.dtype).removeprefix("torch.")
            raise TypeError(f"{op}: {name} must be {names}, got {got}")
    if shape is not None:
        wrong = value.dim() != len(shape) or any(
            isinstance(want, int) and want != have
            for want, have in zip(shape, value.shape, strict=True)
        )
        if wrong:
            want_text = "[" + ", ".join("*" if s is None else str(s) for s in shape) + "]"
            raise ValueError(f"{op}: {name} must have shape {want_text}, got {list(value.shape)}")
    if like is not None:
        if value.device != like.device:
            raise ValueError(f"{op}: {name} must be on {like.device}, got {value.device}")
        if like.is_floating_point() and value.is_floating_point() and value.dtype != like.dtype:
            want_name = str(like.dtype).removeprefix("torch.")
            got = str(value.dtype).removeprefix("torch.")
            raise TypeError(f"{op}: {name} must be {want_name} like the first tensor, got {got}")
    return value
