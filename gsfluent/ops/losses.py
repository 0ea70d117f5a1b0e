"""Structural similarity and the photometric loss of training, value and gradient in one pass."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from gsfluent._check import check_tensor
from gsfluent.ops._register import fakes, no_gradient

WINDOW = 11
"""Side of the Gaussian window [px]; its sigma is 1.5."""
_MAX_CHANNELS = 32
_MAX_SIDE = 32768
_PADDINGS = ("valid", "same")


class Photometric(NamedTuple):
    """What :func:`photometric_loss` returns; only ``loss`` has a gradient.

    Attributes:
        loss: ``(1 - w) l1 + w (1 - ssim) + mask_weight excess``, scalar.
        l1: Mean of ``|miss|``, scalar.
        ssim: Mean structural similarity, scalar.
        mse: Mean of ``miss^2``, scalar.
        excess: Mean of ``|valid alpha - mask|``, scalar; 0 without alpha.
    """

    loss: Tensor
    l1: Tensor
    ssim: Tensor
    mse: Tensor
    excess: Tensor


def ssim(
    image: Tensor, target: Tensor, *, padding: str = "valid", reduction: str = "mean"
) -> Tensor:
    """Structural similarity of two images with values in [0, 1].

    Per pixel and channel ``(2 mu_x mu_y + C1) (2 sigma_xy + C2) / ((mu_x^2 + mu_y^2 + C1)
    (sigma_x^2 + sigma_y^2 + C2))`` with moments under a Gaussian window of 11 x 11 pixels and sigma
    1.5, ``C1 = 0.01^2``, ``C2 = 0.03^2``.

    Args:
        image: Shape [H, W, C] with 1 to 32 channels, float32 or float64.
        target: Same shape and dtype.
        padding: "valid" takes the pixels whose window lies inside the image (Wang et al.); "same"
            takes all, with zeros around both images (Kerbl et al.'s training loss).
        reduction: "mean" or "none".

    Returns:
        A scalar, 1 for equal images; or the map, [H - 10, W - 10, C] ("valid") or [H, W, C].
        A NaN reaches every pixel whose window holds it, and the mean.

    Raises:
        TypeError: An image is not a float32 or float64 tensor.
        ValueError: The shapes differ, a side is shorter than the window (padding "valid") or longer
            than 32768, there are no or more than 32 channels, or an unknown word.

    Gradient: with respect to image and target, once. The mean with a gradient for the image alone
        computes it in the forward pass and holds one image; otherwise the backward pass recomputes
        the moments and holds nothing but the two images.
    Determinism: bit-identical on the CPU for any number of threads, and on CUDA from run to run.
    Source: Wang et al. 2004, equation 13; docs/theory/losses.md.
    """
    inside = _check_images("ssim", image, target, padding)
    if reduction not in ("mean", "none"):
        raise ValueError(f"ssim: reduction must be 'mean' or 'none', got {reduction!r}")
    if reduction == "mean" and not target.requires_grad:
        return _loss(image, target, (0.0, 0.0, 1.0, 0.0), inside=inside, pixels=False)[0]
    value: Tensor = torch.ops.gsfluent.ssim(image, target, inside)
    return value.mean() if reduction == "mean" else value


def photometric_loss(
    image: Tensor,
    target: Tensor,
    *,
    ssim_weight: float = 0.2,
    padding: str = "valid",
    valid: Tensor | None = None,
    alpha: Tensor | None = None,
    mask: Tensor | None = None,
    backdrop: Tensor | None = None,
    mask_weight: float = 0.0,
) -> Photometric:
    """Loss between a rendering and a photograph: L1, SSIM, and the opacity against a mask.

    With ``x = valid image`` and ``excess = valid alpha - mask``::

        miss = x - target - excess backdrop
        loss = (1 - ssim_weight) mean|miss| + ssim_weight (1 - ssim(x, target))
               + mask_weight mean|excess|

    ``image`` is rendered before black and ``target`` is the photograph times its mask; a random
    ``backdrop`` then sets both before that colour in the L1 part.

    Args:
        image: Rendering, shape [H, W, C] with 1 to 32 channels, float32 or float64.
        target: Photograph times ``valid`` (and mask), same shape.
        ssim_weight: Share of the similarity in [0, 1].
        padding: Pixels of the similarity, as in :func:`ssim`.
        valid: Share of each pixel that the photograph covers, in [0, 1], shape [H, W]; 1 when None.
        alpha: Opacity of the rendering, shape [H, W]; together with ``mask``.
        mask: Coverage of the object, shape [H, W].
        backdrop: Colour behind the object, shape [C]; black when None.
        mask_weight: Weight of the opacity's error, at least 0.

    Returns:
        The loss and what it is made of, see :class:`Photometric`.

    Raises:
        TypeError: An argument is not a float32 or float64 tensor, or differs in dtype.
        ValueError: A shape, device, size, weight or combination of arguments does not fit.
        NotImplementedError: Anything but ``image`` and ``alpha`` requires grad.

    Gradient: with respect to image and alpha, once, computed in the forward pass when one of them
        requires it; what is held is one gradient image (and one of alpha's). On CUDA the forward
        pass needs three times the image for a moment. The slope of |0| is 0.
    Determinism: bit-identical on the CPU for any number of threads, and on CUDA from run to run.
    Source: Kerbl et al. 2023, equation 7; docs/theory/losses.md.
    """
    loss, figures, _, _ = _photometric(
        image, target, ssim_weight=ssim_weight, padding=padding, valid=valid, alpha=alpha,
        mask=mask, backdrop=backdrop, mask_weight=mask_weight,
    )  # fmt: skip
    return _named(loss, figures)


@torch.no_grad()
def photometric_slopes(
    image: Tensor, target: Tensor, **options: Any
) -> tuple[Photometric, Tensor, Tensor | None]:
    """:func:`photometric_loss` and its gradients at once, without autograd.

    Args:
        image: See :func:`photometric_loss`.
        target: See there.
        options: All others of :func:`photometric_loss`.

    Returns:
        The loss, its gradient with respect to the image [H, W, C], and to alpha [H, W] if given.

    Raises:
        TypeError: As :func:`photometric_loss`.
        ValueError: As :func:`photometric_loss`.

    Gradient: none.
    Determinism: as :func:`photometric_loss`.
    """
    loss, figures, of_image, of_alpha = _photometric(image, target, slopes=True, **options)
    return _named(loss, figures), of_image, None if options.get("alpha") is None else of_alpha


def _named(loss: Tensor, figures: Tensor) -> Photometric:
    similarity, l1, mse, excess = figures.unbind()
    return Photometric(loss, l1, similarity, mse, excess)


def _photometric(
    image: Tensor, target: Tensor, *, ssim_weight: float = 0.2, padding: str = "valid",
    valid: Tensor | None = None, alpha: Tensor | None = None, mask: Tensor | None = None,
    backdrop: Tensor | None = None, mask_weight: float = 0.0, slopes: bool = False,
) -> tuple[Tensor, ...]:  # fmt: skip
    """Loss, figures and gradients, as the operator gives them."""
    op = "photometric_loss"
    inside = _check_images(op, image, target, padding)
    if not 0.0 <= ssim_weight <= 1.0:
        raise ValueError(f"{op}: ssim_weight must lie in 0..1, got {ssim_weight}")
    if not 0.0 <= mask_weight < float("inf"):
        raise ValueError(f"{op}: mask_weight must be finite and at least 0, got {mask_weight}")
    plane, channels = tuple(image.shape[:2]), (image.shape[2],)
    optional = (("valid", valid, plane), ("mask", mask, plane), ("backdrop", backdrop, channels))
    for name, value, shape in (*optional, ("alpha", alpha, plane)):
        if value is not None:
            check_tensor(op, name, value, shape=shape, like=image)
    if (alpha is None) != (mask is None):
        raise ValueError(f"{op}: alpha and mask must be given together")
    if backdrop is not None and alpha is None:
        raise ValueError(f"{op}: backdrop needs alpha and mask")
    for name, value, _ in (*optional, ("target", target, ())):
        if value is not None and value.requires_grad:
            raise NotImplementedError(
                f"{op}: no gradient with respect to {name}; pass {name}.detach()"
            )
    weights = (ssim_weight, 1.0 - ssim_weight, -ssim_weight, mask_weight)
    planes = (valid, alpha, mask, backdrop)
    return _loss(image, target, weights, inside=inside, pixels=True, planes=planes, slopes=slopes)


def _check_images(op: str, image: Tensor, target: Tensor, padding: str) -> bool:
    """Whether the map lies inside the image."""
    if padding not in _PADDINGS:
        raise ValueError(f"{op}: padding must be 'valid' or 'same', got {padding!r}")
    check_tensor(op, "image", image, shape=("H", "W", "C"))
    check_tensor(op, "target", target, shape=("H", "W", "C"))
    if image.shape != target.shape:
        raise ValueError(
            f"{op}: image and target must have the same shape [H, W, C], "
            f"got {list(image.shape)} and {list(target.shape)}"
        )
    check_tensor(op, "target", target, like=image)
    shortest = WINDOW if padding == "valid" else 1
    if not shortest <= min(image.shape[:2]) <= max(image.shape[:2]) <= _MAX_SIDE:
        hint = f", the window of padding 'valid', or pass padding='same' up to {_MAX_SIDE}"
        raise ValueError(
            f"{op}: sides must have {shortest} to {_MAX_SIDE} pixels"
            f"{hint if padding == 'valid' else ''}, got {list(image.shape)}"
        )
    if not 1 <= image.shape[2] <= _MAX_CHANNELS:
        raise ValueError(
            f"{op}: images must have 1 to {_MAX_CHANNELS} channels, got {list(image.shape)}"
        )
    return padding == "valid"


def _loss(
    image: Tensor,
    target: Tensor,
    weights: tuple[float, float, float, float],
    *,
    inside: bool,
    pixels: bool,
    planes: tuple[Tensor | None, ...] = (None, None, None, None),
    slopes: bool = False,
) -> tuple[Tensor, ...]:
    alpha = planes[1]
    wanted = image.requires_grad or (alpha is not None and alpha.requires_grad)
    wanted = slopes or (wanted and torch.is_grad_enabled())
    found: tuple[Tensor, ...] = torch.ops.gsfluent.photometric_loss(
        image, target, *planes, *weights, inside, pixels, wanted
    )
    return found


def _map_shape(image: Tensor, inside: bool) -> tuple[int, ...]:
    height, width, channels = image.shape
    cut = WINDOW - 1 if inside else 0
    return height - cut, width - cut, channels


def _loss_shapes(
    image: Tensor, target: Tensor, valid: Tensor | None, alpha: Tensor | None, *rest: Any
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    height, width, channels = image.shape
    rows = height if rest[-1] else 0  # gradient
    return (
        image.new_empty(()),
        image.new_empty((4,)),
        image.new_empty((rows, width, channels)),
        image.new_empty((rows if alpha is not None else 0, width)),
    )


def _ssim_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    image, target, inside = inputs
    ctx.save_for_backward(image, target)
    ctx.inside = inside


def _ssim_gradient(ctx: Any, grad: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
    image, target = ctx.saved_tensors
    backward = torch.ops.gsfluent.ssim_backward
    of_image, of_target = ctx.needs_input_grad[:2]
    return (
        backward(grad, image, target, ctx.inside) if of_image else None,
        # the map is symmetric
        backward(grad, target, image, ctx.inside) if of_target else None,
        None,
    )


def _loss_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    _, figures, grad_image, grad_alpha = output
    ctx.save_for_backward(grad_image, grad_alpha)
    ctx.computed = inputs[-1]
    ctx.mark_non_differentiable(figures, grad_image, grad_alpha)
    ctx.set_materialize_grads(False)


def _loss_gradient(ctx: Any, grad: Tensor | None, *_: Any) -> tuple[Tensor | None, ...]:
    none = (None,) * 13
    if grad is None:
        return none
    if torch.is_grad_enabled() and grad.requires_grad:
        # the saved gradient does not know that it depends on the image
        raise NotImplementedError("photometric_loss: differentiable once, not twice")
    if not ctx.computed:
        raise RuntimeError("photometric_loss: called without `gradient`, so there is none")
    of_image, _, _, of_alpha = ctx.needs_input_grad[:4]
    grad_image, grad_alpha = ctx.saved_tensors
    first = (grad * grad_image if of_image else None, None, None)
    return (*first, grad * grad_alpha if of_alpha else None, *none[4:])


torch.library.register_autograd("gsfluent::ssim", _ssim_gradient, setup_context=_ssim_context)
torch.library.register_autograd(
    "gsfluent::photometric_loss", _loss_gradient, setup_context=_loss_context
)
fakes(
    ssim=lambda image, target, inside: image.new_empty(_map_shape(image, inside)),
    ssim_backward=lambda grad, image, target, inside: image.new_empty(image.shape),
    photometric_loss=_loss_shapes,
)
no_gradient("ssim: differentiable once, not twice", "ssim_backward")
