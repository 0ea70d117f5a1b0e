"""How much background shows through the object: the fraction of holes in its silhouette.

When a body breaks, the Gaussians that rode on it part and the far side shines through. The
silhouette against which this is counted comes from the matter itself, the material points drawn as
solid balls that touch their neighbours, so a true gap between fragments is not a hole but a
see-through fragment is.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.data import Camera, Gaussians
from gsfluent.pipeline.draw import draw

# Balls of this many standard deviations per particle spacing overlap enough to close the silhouette
# of a packing.
_SIGMA_IN_SPACINGS = 0.45
_SOLID = 0.9
_HOLE = 0.5
_LONGEST_SIDE = 240


def hole_fraction(
    gaussians: Gaussians,
    positions: Tensor,
    volume: Tensor,
    camera: Camera,
    *,
    groups: Tensor | None = None,
) -> float:
    """Share of the silhouette's pixels whose opacity is below one half.

    Args:
        gaussians: What is rendered, scene frame.
        positions: Material points [m], shape [P, 3].
        volume: Their volumes [m^3], shape [P].
        camera: The view; evaluated at no more than 240 px on the longer side.
        groups: As in :class:`gsfluent.pipeline.Render`.

    Returns:
        A number in [0, 1]; 0 when the matter is out of view.
    """
    camera = camera.scaled(min(1.0, _LONGEST_SIDE / max(camera.width, camera.height)))
    viewmat, intrinsics = camera.viewmat.to(positions), camera.K.to(positions)
    spacing = volume.clamp(min=0.0).pow(1.0 / 3.0)
    quats = positions.new_tensor([1.0, 0.0, 0.0, 0.0]).expand(positions.shape[0], 4)
    matter = ops.rasterize(
        positions,
        torch.full_like(spacing, 0.99),
        viewmat,
        intrinsics,
        camera.width,
        camera.height,
        quats=quats.contiguous(),
        scales=(_SIGMA_IN_SPACINGS * spacing)[:, None].expand(-1, 3).contiguous(),
        colors=torch.zeros_like(positions[:, :1]),
        depth=False,
    ).alpha
    flat = torch.zeros_like(gaussians.means[:, :1])
    drawn = draw(gaussians, camera, colors=flat, groups=groups, near=0.01).alpha
    silhouette = erode(matter > _SOLID)
    area = int(silhouette.sum())
    return float((silhouette & (drawn < _HOLE)).sum()) / area if area else 0.0


def erode(mask: Tensor) -> Tensor:
    """Drop the outermost pixel of a mask [H, W]: a soft rim is not a hole."""
    outside = (~mask).to(torch.float32)[None, None]
    return torch.nn.functional.max_pool2d(outside, 3, stride=1, padding=1)[0, 0] < 0.5
