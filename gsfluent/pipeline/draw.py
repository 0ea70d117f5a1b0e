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
    given: dict[str, Any] = {"near": 1e-4, "depth": False} | options
    return ops.rasterize(
        gaussians.means,
        gaussians.opacities,
        camera.viewmat.to(gaussians.means),
        camera.K.to(gaussians.means),
        camera.width,
        camera.height,
        quats=gaussians.quats,
        scales=gaussians.scales,
        sh=gaussians.sh if colors is None else None,
        colors=colors,
        **given,
    )
