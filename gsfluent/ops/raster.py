"""Differentiable Gaussian splatting: :func:`rasterize`."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from gsfluent import _load  # noqa: F401  (loads the compiled operators)
from gsfluent._check import check_tensor

_OP = "rasterize"
_MAX_CHANNELS = 32
_MAX_SIZE = 65536
_SH_COEFFICIENTS = (1, 4, 9, 16)


class Rendered(NamedTuple):
    """What :func:`rasterize` returns."""

    image: Tensor
    """Blended colours, shape [H, W, C]."""
    alpha: Tensor
    """Accumulated opacity in [0, 1], shape [H, W]."""
    depth: Tensor
    """Expected camera z [world units], divided by alpha; 0 where alpha is 0. Shape [H, W]."""
    normal: Tensor | None
    """Blended (not normalised) normals, shape [H, W, 3]; None unless normals were given."""
    contribution: Tensor | None
    """Sum of blend weights over all pixels, shape [N]; None unless asked for. No gradient."""
    radii: Tensor
    """Half size of the splat's box [px], int32, shape [N]; 0 for splats that cannot be seen."""


def rasterize(
    means: Tensor,
    opacities: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    *,
    quats: Tensor | None = None,
    scales: Tensor | None = None,
    covars: Tensor | None = None,
    sh: Tensor | None = None,
    colors: Tensor | None = None,
    background: Tensor | None = None,
    antialiased: bool = False,
    normals: Tensor | None = None,
    groups: Tensor | None = None,
    means2d_offset: Tensor | None = None,
    contribution: bool = False,
    near: float = 0.01,
    far: float = 1e6,
) -> Rendered:
    """Render 3D Gaussians by depth-sorted EWA splatting.

    Every Gaussian is projected to a 2D Gaussian (0.3 px^2 added to its variances) and blended front
    to back: ``alpha_i = min(0.99, o_i exp(-power_i))``, ``image = sum_i T_i alpha_i c_i + T bg``
    with ``T_i = prod_{j<i} (1 - alpha_j)``. Contributions below 1/255 are skipped and a pixel stops
    before its transmittance falls to 1e-4. A Gaussian that holds NaN or Inf, has a zero quaternion
    or lies outside [near, far] or off the image is left out and gets zero gradients.

    Args:
        means: Centres [world units], shape [N, 3], float32 or float64.
        opacities: Peak opacities in [0, 1], shape [N].
        viewmat: Rigid world-to-camera transform, OpenCV axes (x right, y down, z forward), shape
            [4, 4].
        K: Intrinsics [px] without skew, shape [3, 3]; the centre of the first pixel is (0.5, 0.5).
        width: Image width [px].
        height: Image height [px].
        quats: Rotations wxyz, normalised inside, shape [N, 4]; together with ``scales``.
        scales: Standard deviations along the rotated axes [world units], shape [N, 3].
        covars: World covariances xx, yy, zz, xy, xz, yz instead of quats and scales, shape [N, 6].
        sh: Spherical harmonics of degree 0 to 3, shape [N, (degree + 1)^2, 3]; the colour is
            ``max(0, sum_k sh_k Y_k(direction) + 0.5)``.
        colors: Colours or other features instead of ``sh``, shape [N, C] with C <= 32.
        background: Colour behind everything, shape [C]; black when None.
        antialiased: Scale opacity by sqrt(det / det_blurred), at least 0.005, so that the low-pass
            does not thicken splats smaller than a pixel.
        normals: Vectors to blend along with the colours, shape [N, 3].
        groups: Sibling group per Gaussian, int32, shape [N]; -1 for none. Per pixel only the
            nearest member of a group contributes (the last 8 contributing groups are remembered).
        means2d_offset: Added to the projected centres [px], shape [N, 2]. Zeros that require grad
            receive the screen-space gradient used for densification.
        contribution: Also return each Gaussian's sum of blend weights.
        near: Nearest camera z that is drawn [world units], positive.
        far: Farthest camera z that is drawn [world units].

    Returns:
        The images and per-Gaussian figures, see :class:`Rendered`.

    Raises:
        TypeError: An argument is not a tensor, or has a wrong dtype.
        ValueError: A shape, device, size or combination of arguments does not fit.
        NotImplementedError: ``viewmat`` or ``K`` requires grad.

    Gradient: with respect to means, opacities, quats, scales, covars, sh, colors, background,
        normals and means2d_offset, from image, alpha, depth and normal.
    Determinism: bit-identical on the CPU for any number of threads; on CUDA the gradients' sums are
        reordered by atomics.
    Source: Kerbl et al. 2023 (3D Gaussian Splatting), Zwicker et al. 2001 (EWA), Yu et al. 2024
        (Mip-Splatting, the antialiased mode); conventions in docs/rasterizer.md.
    """
    check_tensor(_OP, "means", means, shape=("N", 3))
    n = means.shape[0]
    check_tensor(_OP, "opacities", opacities, shape=(n,), like=means)
    check_tensor(_OP, "viewmat", viewmat, shape=(4, 4))
    check_tensor(_OP, "K", K, shape=(3, 3))
    _check_size("width", width)
    _check_size("height", height)
    _check_shape_arguments(means, quats, scales, covars)
    channels = _check_color_arguments(means, sh, colors)
    optional: tuple[tuple[str, Tensor | None, tuple[int, ...]], ...] = (
        ("background", background, (channels,)),
        ("normals", normals, (n, 3)),
        ("means2d_offset", means2d_offset, (n, 2)),
    )
    for name, value, shape in optional:
        if value is not None:
            check_tensor(_OP, name, value, shape=shape, like=means)
    if groups is not None:
        check_tensor(_OP, "groups", groups, shape=(n,), dtype=torch.int32, like=means)
    if not 0.0 < near < far:
        raise ValueError(f"{_OP}: near and far must satisfy 0 < near < far, got {near} and {far}")
    for name, camera in (("viewmat", viewmat), ("K", K)):
        if camera.requires_grad:
            raise NotImplementedError(
                f"{_OP}: no gradient with respect to {name}; pass {name}.detach()"
            )
    outputs = torch.ops.gsfluent.rasterize(
        means,
        opacities,
        viewmat.to(device=means.device, dtype=means.dtype),
        K.to(device=means.device, dtype=means.dtype),
        quats,
        scales,
        covars,
        sh,
        colors,
        background,
        normals,
        groups,
        means2d_offset,
        width,
        height,
        bool(antialiased),
        bool(contribution),
        float(near),
        float(far),
    )
    image, alpha, depth, normal, weight, radii = outputs[:6]
    return Rendered(
        image,
        alpha,
        depth,
        normal if normals is not None else None,
        weight if contribution else None,
        radii,
    )


def _check_size(name: str, value: int) -> None:
    if isinstance(value, bool) or not isinstance(value, (int, torch.SymInt)):
        raise TypeError(f"{_OP}: {name} must be an int, got {type(value).__name__}")
    if not 1 <= value <= _MAX_SIZE:
        raise ValueError(f"{_OP}: {name} must lie in 1..{_MAX_SIZE}, got {value}")


def _check_shape_arguments(
    means: Tensor, quats: Tensor | None, scales: Tensor | None, covars: Tensor | None
) -> None:
    n = means.shape[0]
    if covars is not None:
        if quats is not None or scales is not None:
            raise ValueError(f"{_OP}: covars replaces quats and scales, got both; pass one form")
        check_tensor(_OP, "covars", covars, shape=(n, 6), like=means)
        return
    if quats is None or scales is None:
        missing = "quats" if quats is None else "scales"
        raise ValueError(f"{_OP}: {missing} must be given, got None; or pass covars [N, 6]")
    check_tensor(_OP, "quats", quats, shape=(n, 4), like=means)
    check_tensor(_OP, "scales", scales, shape=(n, 3), like=means)


def _check_color_arguments(means: Tensor, sh: Tensor | None, colors: Tensor | None) -> int:
    n = means.shape[0]
    if (sh is None) == (colors is None):
        got = "neither" if sh is None else "both"
        raise ValueError(f"{_OP}: exactly one of sh and colors must be given, got {got}")
    if sh is not None:
        check_tensor(_OP, "sh", sh, shape=(n, None, 3), like=means)
        if sh.shape[1] not in _SH_COEFFICIENTS:
            raise ValueError(
                f"{_OP}: sh must hold 1, 4, 9 or 16 coefficients (degree 0 to 3), "
                f"got {list(sh.shape)}"
            )
        return 3
    given = check_tensor(_OP, "colors", colors, shape=(n, None), like=means)
    if not 1 <= given.shape[1] <= _MAX_CHANNELS:
        raise ValueError(
            f"{_OP}: colors must have 1 to {_MAX_CHANNELS} channels, got {list(given.shape)}; "
            "render more channels in several calls"
        )
    return given.shape[1]


@torch.library.register_fake("gsfluent::rasterize")
def _(
    means: Tensor,
    opacities: Tensor,
    viewmat: Tensor,
    K: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
    covars: Tensor | None,
    sh: Tensor | None,
    colors: Tensor | None,
    background: Tensor | None,
    normals: Tensor | None,
    groups: Tensor | None,
    means2d_offset: Tensor | None,
    width: int,
    height: int,
    antialiased: bool,
    contribution: bool,
    near: float,
    far: float,
) -> tuple[Tensor, ...]:
    n = means.shape[0]
    channels = colors.shape[1] if colors is not None else 3
    features = channels + (3 if normals is not None else 0) + 1
    tiles = ((width + 15) // 16) * ((height + 15) // 16)
    instances = torch.library.get_ctx().new_dynamic_size()
    real = means.new_empty
    return (
        real((height, width, channels)),
        real((height, width)),
        real((height, width)),
        real((height, width, 3 if normals is not None else 0)),
        real((n if contribution else 0,)),
        means.new_empty((n,), dtype=torch.int32),
        real((n, (9 + features + 3) // 4 * 4)),
        means.new_empty((n,), dtype=torch.int32),
        means.new_empty((tiles + 1,), dtype=torch.int32),
        means.new_empty((instances,), dtype=torch.int32),
    )


@torch.library.register_fake("gsfluent::rasterize_backward")
def _(*args: Any) -> tuple[Tensor, ...]:
    means, opacities = args[12:14]
    quats, scales, covars, sh, colors, background, normals, _, offset = args[16:25]
    return tuple(
        means.new_empty(t.shape if t is not None else (0,))
        for t in (
            means,
            opacities,
            quats,
            scales,
            covars,
            sh,
            colors,
            background,
            normals,
            offset,
        )
    )


def _setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    image, alpha, depth, normal, weight, radii, splats, order, tile_start, instances = output
    ctx.save_for_backward(
        image, alpha, depth, normal, splats, order, tile_start, instances, *inputs[:13]
    )
    ctx.scalars = (*inputs[13:16], *inputs[17:19])  # without `contribution`
    ctx.mark_non_differentiable(weight, radii, splats, order, tile_start, instances)
    ctx.set_materialize_grads(False)


def _backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
    saved = ctx.saved_tensors
    present = [t is not None for t in saved[8:]]
    if all(g is None for g in grads[:4]):
        return (None,) * 19
    out = torch.ops.gsfluent.rasterize_backward(*grads[:4], *saved, *ctx.scalars)
    means, opacities, quats, scales, covars, sh, colors, background, normals, offset = out
    by_input = (means, opacities, None, None, quats, scales, covars, sh, colors, background)
    tensors = (*by_input, normals, None, offset)
    needed = ctx.needs_input_grad
    kept = tuple(
        g if have and need else None
        for g, have, need in zip(tensors, present, needed, strict=False)
    )
    return kept + (None,) * 6


torch.library.register_autograd("gsfluent::rasterize", _backward, setup_context=_setup_context)
