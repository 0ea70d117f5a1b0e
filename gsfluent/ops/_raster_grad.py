"""Autograd and shape rules of the operators behind :func:`gsfluent.ops.rasterize`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from gsfluent.ops._memory import is_shortage, refuse_pairs, shortage_error

# Positions in the schemas (csrc/library.cpp): tensor inputs come first, then these numbers.
_TENSORS = 14
_NUMBERS = (
    "width",
    "height",
    "antialiased",
    "contribution",
    "depth",
    "median_depth",
    "near",
    "far",
    "deterministic",
)
# Outputs with a gradient; the adjoint wants them, and the last four, back.
_IMAGE, _ALPHA, _DEPTH, _NORMAL = 0, 1, 2, 4
_DIFFERENTIABLE = (_IMAGE, _ALPHA, _DEPTH, _NORMAL)
# Inputs in the order of the adjoint's results.
_WITH_GRADIENT = (0, 1, 4, 5, 6, 7, 8, 9, 10, 12, 13)


def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    """Keep what the adjoint needs."""
    ctx.save_for_backward(*[output[k] for k in _DIFFERENTIABLE], *output[7:], *inputs[:_TENSORS])
    width, height, antialiased, _, depth, _, near, far, deterministic = inputs[_TENSORS:]
    ctx.numbers = (width, height, antialiased, depth, near, far, deterministic)
    ctx.mark_non_differentiable(*[t for k, t in enumerate(output) if k not in _DIFFERENTIABLE])
    ctx.set_materialize_grads(False)


def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
    """Gradients of all inputs of the operator."""
    result: list[Tensor | None] = [None] * (_TENSORS + len(_NUMBERS))
    wanted = [grads[k] for k in _DIFFERENTIABLE]
    if all(g is None for g in wanted):
        return tuple(result)
    saved = ctx.saved_tensors
    found = torch.ops.gsfluent.rasterize_backward.default(*wanted, *saved, *ctx.numbers)
    needed, given = ctx.needs_input_grad, saved[-_TENSORS:]
    for k, gradient in zip(_WITH_GRADIENT, found, strict=True):
        if needed[k] and given[k] is not None:
            result[k] = gradient
    return tuple(result)


class Rasterize(torch.autograd.Function):
    """The operator with its gradient, without the 0.1 ms of the dispatcher's Python rule."""

    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> tuple[Tensor, ...]:
        """Call the operator (autograd is off in here)."""
        output: tuple[Tensor, ...] = torch.ops.gsfluent.rasterize.default(*inputs)
        setup_context(ctx, inputs, output)
        return output

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        """See :func:`backward`."""
        given = [t for k, t in enumerate(ctx.saved_tensors[8:]) if ctx.needs_input_grad[k]]
        with guarded(ctx.saved_tensors, given):
            return backward(ctx, *grads)


@contextmanager
def guarded(saved: Sequence[Tensor | None], given: Sequence[Tensor | None]) -> Iterator[None]:
    """Say what memory the adjoint lacks: ``saved`` as it takes them, ``given`` with gradients."""
    image, instances, means = saved[0], saved[7], saved[8]
    assert image is not None and instances is not None and means is not None
    if instances.device.type == "cpu":
        # six moments and the features of the image, for each
        refuse_pairs(instances.numel(), 6 + image.shape[-1], image.element_size())
    try:
        yield
    except RuntimeError as error:
        if not is_shortage(error):
            raise
        need = sum(t.numel() * t.element_size() for t in given if t is not None)
        raise shortage_error(means.device)(
            f"rasterize: the gradients of {means.shape[0]} Gaussians need at least {need} "
            f"bytes ({need / 2**30:.1f} GiB) on {means.device}, which could not be allocated"
        ) from error


def adjoint(
    arguments: Sequence[Any], output: Sequence[Tensor], image: Tensor, alpha: Tensor | None
) -> tuple[Tensor, ...]:
    """Gradients from those of image and opacity, without autograd, in the operator's order."""
    width, height, antialiased, _, depth, _, near, far, deterministic = arguments[_TENSORS:]
    saved = (*[output[k] for k in _DIFFERENTIABLE], *output[7:], *arguments[:_TENSORS])
    numbers = (width, height, antialiased, depth, near, far, deterministic)
    with guarded(saved, arguments[:_TENSORS]):
        found: tuple[Tensor, ...] = torch.ops.gsfluent.rasterize_backward.default(
            image, alpha, None, None, *saved, *numbers
        )
    return found


torch.library.register_autograd("gsfluent::rasterize", backward, setup_context=setup_context)


@torch.library.register_fake("gsfluent::rasterize")
def _(*inputs: Any) -> tuple[Tensor, ...]:
    means, viewmat, colors, normals = (inputs[k] for k in (0, 2, 8, 10))
    width, height, _, contribution, depth, median_depth, *_ = inputs[_TENSORS:]
    n = means.shape[0]
    leading = tuple(viewmat.shape[:-2])
    channels = colors.shape[1] if colors is not None else 3
    plane = (*leading, height, width)
    # What is saved for the adjoint has the layout of the backend.
    unknown = torch.library.get_ctx().new_dynamic_size

    def real(*shape: Any) -> Tensor:
        return means.new_empty(shape)

    def whole(*shape: Any) -> Tensor:
        return means.new_empty(shape, dtype=torch.int32)

    return (
        real(*plane, channels),
        real(*plane),
        real(*plane) if depth else real(0),
        real(*plane) if median_depth else real(0),
        real(*plane, normals.shape[1]) if normals is not None else real(0),
        real(n if contribution else 0),
        whole(*leading, n),
        real(unknown(), unknown()),
        whole(unknown()),
        whole(unknown()),
        whole(unknown()),
    )


@torch.library.register_fake("gsfluent::rasterize_backward")
def _(*args: Any) -> tuple[Tensor, ...]:
    means = args[12]
    inputs = args[12 : 12 + _TENSORS]
    return tuple(
        means.new_empty(inputs[k].shape if inputs[k] is not None else (0,)) for k in _WITH_GRADIENT
    )
