"""Gaussians as a camera sees them: the one call of the rasterizer behind pictures and masks."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from gsfluent import ops
from gsfluent.data import Camera, Gaussians
from gsfluent.ops.raster import Rendered


def draw(
    gaussians: Gaussians, camera: Camera, *, colors: Tensor | None = None, **options: Any
) -> Rendered:
    """Rasterize Gaussians in a pinhole camera, from a ten-thousandth of a world unit on.

    Args:
        gaussians: What is drawn.
        camera: Where from; moved to the device of the Gaussians.
        colors: Drawn instead of the Gaussians' own colours, [N, C].
        options: More arguments of :func:`gsfluent.ops.rasterize`; ``depth`` is off unless asked.

    Returns:
        What :func:`gsfluent.ops.rasterize` returns, before black.
    """
    size = (camera.width, camera.height)
    return draw_at(gaussians, camera.viewmat, camera.K, size, colors=colors, **options)


def draw_at(
    gaussians: Gaussians,
    viewmat: Tensor,
    K: Tensor,
    size: tuple[int, int],
    *,
    colors: Tensor | None = None,
    **options: Any,
) -> Rendered:
    """As :func:`draw`, where there is no :class:`Camera`.

    Args:
        gaussians: What is drawn.
        viewmat: World to camera, [4, 4].
        K: Intrinsics [px], [3, 3].
        size: Width and height [px].
        colors: Drawn instead of the Gaussians' own colours, [N, C].
        options: As for :func:`draw`.
    """
    given: dict[str, Any] = {"near": 1e-4, "depth": False} | options
    return ops.rasterize(
        gaussians.means,
        gaussians.opacities,
        viewmat.to(gaussians.means),
        K.to(gaussians.means),
        *size,
        quats=gaussians.quats,
        scales=gaussians.scales,
        sh=gaussians.sh if colors is None else None,
        colors=colors,
        **given,
    )
