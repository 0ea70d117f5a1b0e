"""Differentiable Gaussian splatting: :func:`rasterize`."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gsfluent import _load  # noqa: F401  (loads the compiled operators)
from gsfluent._check import check_tensor
from gsfluent.ops._memory import (
    Arguments,
    is_shortage,
    refuse_if_too_large,
    shortage,
    shortage_error,
)
from gsfluent.ops._raster_grad import Rasterize, adjoint

_OP = "rasterize"
_MAX_CHANNELS = 32
_MAX_VALUES = 35  # colours and normals together
_TENSORS = 14
_MAX_SIZE = 65536
_SH_COEFFICIENTS = (1, 4, 9, 16)
# From here on a call is asked whether it fits in memory.
_MANY = 1_000_000


class Rendered(NamedTuple):
    """What :func:`rasterize` returns.

    Per-pixel tensors and radii have the cameras' axis in front ([C, H, W, ...], [C, N]) when
    ``viewmat`` has one.
    """

    image: Tensor
    """Blended colours, shape [H, W, channels]."""
    alpha: Tensor
    """Accumulated opacity in [0, 1], shape [H, W]."""
    depth: Tensor | None
    """Expected camera z [world units], divided by alpha; 0 where alpha is 0. Shape [H, W]; None
    when not wanted."""
    normal: Tensor | None
    """Blended (not normalised) normals, shape [H, W, K]; None unless normals were given."""
    contribution: Tensor | None
    """Sum of blend weights over all pixels of all cameras, shape [N]; None unless asked for. No
    gradient."""
    radii: Tensor
    """Half size of the splat's box [px], int32, shape [N]; 0 for splats that cannot be seen."""
    median_depth: Tensor | None = None
    """Camera z [world units] of the splat that takes the transmittance to 1/2 or below, 0 where
    none does. Shape [H, W]; None unless asked for. No gradient."""


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
    means2d_absgrad: Tensor | None = None,
    contribution: bool = False,
    depth: bool = True,
    median_depth: bool = False,
    near: float = 0.01,
    far: float = 1e6,
    deterministic: bool = False,
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
            [4, 4], or [C, 4, 4] for C cameras in one call.
        K: Intrinsics [px] without skew, shape [3, 3] or [C, 3, 3]; the centre of the first pixel is
            (0.5, 0.5).
        width: Image width [px].
        height: Image height [px].
        quats: Rotations wxyz, normalised inside, shape [N, 4]; together with ``scales``.
        scales: Standard deviations along the rotated axes [world units], shape [N, 3].
        covars: World covariances xx, yy, zz, xy, xz, yz instead of quats and scales, shape [N, 6].
        sh: Spherical harmonics of degree 0 to 3, shape [N, (degree + 1)^2, 3]; the colour is
            ``max(0, sum_k sh_k Y_k(direction) + 0.5)``.
        colors: Colours or other features instead of ``sh``, shape [N, channels] with at
            most 32 channels.
        background: Colour behind everything, shape [channels], or [C, channels] for one per camera;
            black when None.
        antialiased: Scale opacity by sqrt(det / det_blurred), at least 0.005, so that the low-pass
            does not thicken splats smaller than a pixel.
        normals: Vectors to blend along with the colours, shape [N, K] with K >= 3; columns beyond
            the third are further values per splat (occlusion, gloss). Channels and K together at
            most 35.
        groups: Sibling group per Gaussian, int32, shape [N]; -1 for none. Per pixel only the
            nearest member of a group contributes (the last 8 contributing groups are remembered).
        means2d_offset: Added to the projected centres [px], shape [N, 2] or [C, N, 2]. Zeros that
            require grad receive the screen-space gradient used for densification.
        means2d_absgrad: Not read, shape [N, 2] or [C, N, 2]. Zeros that require grad receive the
            sum over the pixels of the absolute values of the gradient of the projected centre.
        contribution: Also return each Gaussian's sum of blend weights.
        depth: Return the expected depth; False saves the time it takes.
        median_depth: Also return the median depth.
        near: Nearest camera z that is drawn [world units], positive.
        far: Farthest camera z that is drawn [world units].
        deterministic: Give the same bits of the gradients in every run on a GPU too, for some time
            and 16 bytes per splat and sum (docs/measured/deterministic.md). Also on while
            ``torch.use_deterministic_algorithms`` is.

    Returns:
        The images and per-Gaussian figures, see :class:`Rendered`.

    Raises:
        TypeError: An argument is not a tensor, or has a wrong dtype.
        ValueError: A shape, device, size or combination of arguments does not fit.
        NotImplementedError: ``viewmat`` or ``K`` requires grad.
        MemoryError: The scene needs more memory than the machine has; on a GPU
            torch.OutOfMemoryError. Both name the bytes.

    Gradient: with respect to means, opacities, quats, scales, covars, sh, colors, background,
        normals, means2d_offset and means2d_absgrad, from image, alpha, depth and normal.
    Determinism: bit-identical on the CPU for any number of threads; on CUDA everything but the
        gradients, whose sums are reordered by atomics unless ``deterministic``.
    Source: Kerbl et al. 2023 (3D Gaussian Splatting), Zwicker et al. 2001 (EWA), Yu et al. 2024
        (Mip-Splatting, the antialiased mode), Ye et al. 2024 (AbsGS, the absolute gradients);
        conventions in docs/theory/rasterizer.md.
    """
    arguments = Arguments(
        means,
        opacities,
        viewmat,
        K,
        quats,
        scales,
        covars,
        sh,
        colors,
        background,
        normals,
        groups,
        means2d_offset,
        means2d_absgrad,
        width,
        height,
        antialiased,
        contribution,
        depth,
        median_depth,
        near,
        far,
        deterministic or torch.are_deterministic_algorithms_enabled(),
    )
    if torch.compiler.is_compiling():
        outputs = torch.ops.gsfluent.rasterize(*_checked(arguments))
    else:
        outputs = _run(arguments)
    return _rendered(arguments, outputs)


def _rendered(a: Arguments, outputs: tuple[Tensor, ...]) -> Rendered:
    image, alpha, depths, median, normal, weight, radii = outputs[:7]
    return Rendered(
        image,
        alpha,
        depths if a.depth else None,
        normal if a.normals is not None else None,
        weight if a.contribution else None,
        radii,
        median if a.median_depth else None,
    )


class Slopes(NamedTuple):
    """Gradients of :func:`rasterize_recorded`'s arguments, each of its shape."""

    means: Tensor
    opacities: Tensor
    quats: Tensor
    scales: Tensor
    sh: Tensor
    probe: Tensor
    """Of the projected centres [px], [N, 2]; empty without a probe."""


class Recorded(NamedTuple):
    """What :func:`rasterize_recorded` returns."""

    rendered: Rendered
    arguments: Arguments
    outputs: tuple[Tensor, ...]

    @torch.no_grad()
    def adjoint(self, image: Tensor, alpha: Tensor | None = None) -> Slopes:
        """Gradients of a loss.

        Args:
            image: Its gradient with respect to the image, [H, W, 3].
            alpha: The same of the opacity, [H, W]; 0 when None.

        Returns:
            Those of the arguments.

        Raises:
            RuntimeError: A shape, dtype or device does not fit.
            MemoryError: As :func:`rasterize`.
        """
        found = adjoint(self.arguments, self.outputs, image, alpha)
        means, opacities, quats, scales, _, sh, _, _, _, offset, absolute = found
        probe = offset if self.arguments.means2d_offset is not None else absolute
        return Slopes(means, opacities, quats, scales, sh, probe)


@torch.no_grad()
def rasterize_recorded(
    means: Tensor,
    opacities: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    *,
    quats: Tensor,
    scales: Tensor,
    sh: Tensor,
    probe: Tensor | None = None,
    absgrad: bool = False,
    near: float = 0.01,
    far: float = 1e6,
    deterministic: bool = False,
) -> Recorded:
    """:func:`rasterize` of one camera, with its adjoint to be called by hand.

    A training draws one photograph after the other, and autograd's part of a step takes as long on
    a GPU as the kernels do.

    Args:
        means: See :func:`rasterize`, also of all that is not named here.
        opacities: See there.
        viewmat: World to camera, [4, 4].
        K: Intrinsics, [3, 3].
        width: Image width [px].
        height: Image height [px].
        quats: Rotations, [N, 4].
        scales: Standard deviations, [N, 3].
        sh: Spherical harmonics, [N, (degree + 1)^2, 3].
        probe: Zeros [N, 2]: the adjoint gives the gradient of the projected centres.
        absgrad: It gives the sum of its absolute values over the pixels instead.
        near: Nearest camera z that is drawn.
        far: Farthest camera z that is drawn.
        deterministic: The same bits of the gradients in every run on a GPU too.

    Returns:
        The picture without depth, and what its adjoint needs.

    Raises:
        TypeError: As :func:`rasterize`.
        ValueError: As :func:`rasterize`.
        MemoryError: As :func:`rasterize`.

    Gradient: by hand, :meth:`Recorded.adjoint`.
    Determinism: as :func:`rasterize`.
    """
    arguments = Arguments(
        means,
        opacities,
        viewmat,
        K,
        quats,
        scales,
        None,
        sh,
        None,
        None,
        None,
        None,
        None if absgrad else probe,
        probe if absgrad else None,
        width,
        height,
        False,
        False,
        False,
        False,
        near,
        far,
        deterministic or torch.are_deterministic_algorithms_enabled(),
    )
    outputs = _run(arguments)
    return Recorded(_rendered(arguments, outputs), arguments, outputs)


def _run(arguments: Arguments) -> tuple[Tensor, ...]:
    """Call the operator.

    A frame takes half a millisecond on a GPU, so arguments that the operator accepts as they are
    (it checks shapes, dtypes and devices itself) are not checked twice.
    """
    a, means, viewmat, K = arguments, arguments.means, arguments.viewmat, arguments.K
    try:
        ready = viewmat.dtype == means.dtype == K.dtype and type(a.width) is int
        ready = ready and viewmat.device == means.device == K.device and type(a.height) is int
        ready = ready and 0.0 < a.near < a.far and not (viewmat.requires_grad or K.requires_grad)
        if not ready:
            arguments = _checked(arguments)
        many = means.shape[0] > _MANY or a.width * a.height > _MANY
        if many and means.device.type == "cpu":
            refuse_if_too_large(arguments)
        if torch.is_grad_enabled() and any(
            isinstance(t, Tensor) and t.requires_grad for t in arguments[:_TENSORS]
        ):
            outputs: tuple[Tensor, ...] = Rasterize.apply(*arguments)
        else:
            outputs = torch.ops.gsfluent.rasterize.default(*arguments)
    except (RuntimeError, TypeError, AttributeError) as error:
        _checked(arguments)  # names the argument at fault
        if not is_shortage(error):
            raise
        text = f"{shortage(arguments)}, which could not be allocated"
        raise shortage_error(means.device)(text) from error
    return outputs


def _checked(a: Arguments) -> Arguments:
    """The operator's arguments, the cameras moved to the Gaussians; raises what is wrong."""
    means, viewmat, K, normals = a.means, a.viewmat, a.K, a.normals
    check_tensor(_OP, "means", means, shape=("N", 3))
    n = means.shape[0]
    check_tensor(_OP, "opacities", a.opacities, shape=(n,), like=means)
    batched = isinstance(viewmat, Tensor) and viewmat.dim() == 3
    leading: tuple[int, ...] = (viewmat.shape[0],) if batched else ()
    check_tensor(_OP, "viewmat", viewmat, shape=(*leading, 4, 4))
    check_tensor(_OP, "K", K, shape=(*leading, 3, 3))
    if leading == (0,):
        raise ValueError(f"{_OP}: viewmat must hold at least one camera, got [0, 4, 4]")
    _check_size("width", a.width)
    _check_size("height", a.height)
    _check_shape_arguments(means, a.quats, a.scales, a.covars)
    channels = _check_color_arguments(means, a.sh, a.colors)
    per_camera = isinstance(a.background, Tensor) and a.background.dim() == 2
    optional: tuple[tuple[str, Tensor | None, tuple[int | str, ...]], ...] = (
        ("background", a.background, (*leading, channels) if per_camera else (channels,)),
        ("normals", normals, (n, "K")),
        ("means2d_offset", a.means2d_offset, (*leading, n, 2)),
        ("means2d_absgrad", a.means2d_absgrad, (*leading, n, 2)),
    )
    for name, value, shape in optional:
        if value is not None:
            check_tensor(_OP, name, value, shape=shape, like=means)
    if normals is not None and not 3 <= normals.shape[1] <= _MAX_VALUES - channels:
        raise ValueError(
            f"{_OP}: normals must have 3 to {_MAX_VALUES - channels} columns beside {channels} "
            f"channels, got {list(normals.shape)}"
        )
    if a.groups is not None:
        check_tensor(_OP, "groups", a.groups, shape=(n,), dtype=torch.int32, like=means)
    if not 0.0 < a.near < a.far:
        raise ValueError(
            f"{_OP}: near and far must satisfy 0 < near < far, got {a.near} and {a.far}"
        )
    for name, camera in (("viewmat", viewmat), ("K", K)):
        if camera.requires_grad:
            raise NotImplementedError(
                f"{_OP}: no gradient with respect to {name}; pass {name}.detach()"
            )
    return a._replace(
        viewmat=viewmat.to(device=means.device, dtype=means.dtype),
        K=K.to(device=means.device, dtype=means.dtype),
        antialiased=bool(a.antialiased),
        contribution=bool(a.contribution),
        depth=bool(a.depth),
        median_depth=bool(a.median_depth),
        near=float(a.near),
        far=float(a.far),
        deterministic=bool(a.deterministic),
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
