"""The model of ``ops.shade`` in plain PyTorch: the renderer's functions of points, per pixel."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import normalize

from gsfluent.pipeline.light.occlusion import Occupancy, ambient_occlusion
from gsfluent.pipeline.light.shade import (
    ALPHA_FLOOR,
    arriving,
    shade_points,
    surface_points,
    to_display,
    to_linear,
)
from gsfluent.pipeline.light.shadow import ShadowMaps

OPAQUE = 0.999  # what is behind such a pixel is not worked out
FADED = 1e-6  # share of the floor below which it is left out


def shade_image(
    image: Tensor,
    alpha: Tensor,
    depth: Tensor,
    normal: Tensor,
    gloss: Tensor,
    viewmat: Tensor,
    K: Tensor,
    lamps: Tensor,
    environment: Tensor,
    background: Tensor,
    *,
    maps: ShadowMaps | None = None,
    grid: Occupancy | None = None,
    occlusion: float = 1.0,
    studio: Tensor | None = None,
) -> Tensor:
    """The finished picture [H, W, 3], display values in [0, 1], from what the rasterizer blended.

    Splats were fitted by blending display values, so blending stays in display values.

    Args:
        image: Colours times opacity, display values, [H, W, 3].
        alpha: Opacity, [H, W].
        depth: Camera z of the surface [m], [H, W].
        normal: Blended normals, [H, W, 3].
        gloss: k_s and n_s of Blinn-Phong, [H, W, 2] (not times opacity) or [2].
        viewmat: Scene to camera, [4, 4].
        K: Intrinsics [px], [3, 3].
        lamps: Packed lamps, [L, LAMP].
        environment: Irradiance over pi, [9, 3].
        background: Display colour behind everything when there is no studio, [3].
        maps: Shadow maps; None for no shadows.
        grid: Occupancy that hides the environment; None for none.
        occlusion: Strength of that, 0 to 1.
        studio: Packed floor and backdrop, [STUDIO], or None.
    """
    albedo = to_linear(image / alpha[..., None].clamp(min=ALPHA_FLOOR))
    points, rays = surface_points(depth, viewmat, K)
    normal = normalize(normal, dim=-1)
    ao = None
    if grid is not None:
        ao = 1.0 - occlusion * (1.0 - ambient_occlusion(points, normal, grid))
    lit = shade_points(points, normal, -rays, albedo, gloss, lamps, environment, ao=ao, maps=maps)
    front = to_display(torch.where((alpha > ALPHA_FLOOR)[..., None], lit, albedo))
    behind = background
    if studio is not None:
        eye = -(viewmat[:3, 3] @ viewmat[:3, :3])
        behind = to_display(
            shade_studio(
                eye, rays, studio, lamps, environment, maps=maps, grid=grid, occlusion=occlusion
            )
        )
    # what lies behind nearly opaque pixels need not be worked out
    cover = torch.where(alpha > OPAQUE, 1.0, alpha)[..., None]
    return (front * cover + behind * (1.0 - cover)).clamp(0.0, 1.0)


def shade_studio(
    eye: Tensor,
    rays: Tensor,
    studio: Tensor,
    lamps: Tensor,
    environment: Tensor,
    *,
    maps: ShadowMaps | None = None,
    grid: Occupancy | None = None,
    occlusion: float = 1.0,
) -> Tensor:
    """Linear radiance [..., 3] of floor and backdrop along unit rays [..., 3] from ``eye`` [3].

    Each ray meets ``z = height`` in closed form. The light on the floor is taken relative to that
    on the open floor at its centre, so that the paint keeps its grey under any light; far away the
    floor dissolves into the backdrop. From below there is no floor: it would only hide the object.
    """
    paint, horizon, zenith = studio[4:7], studio[7:10], studio[10:13]
    rise = (2.0 * rays[..., 2:3]).clamp(0.0, 1.0)
    wall = horizon + (zenith - horizon) * rise
    down = -rays[..., 2]
    above = eye[2] - studio[0]
    hits = (down > 1e-4) & (above > 0.0)
    points = eye + (above / down.clamp(min=1e-4))[..., None] * rays
    up = torch.zeros_like(points)
    up[..., 2] = 1.0
    ao = None
    if grid is not None:
        ao = 1.0 - occlusion * (1.0 - ambient_occlusion(points, up, grid))
    arrives = arriving(points, up, lamps, environment, ao, maps)
    center = torch.cat([studio[1:3], studio[:1]])
    bare = arriving(center, up.new_tensor((0.0, 0.0, 1.0)), lamps, environment, None, None)
    floor = paint * arrives / bare.mean().clamp(min=1e-3)
    away = (points[..., :2] - studio[1:3]).norm(dim=-1) / studio[3]
    keep = torch.exp(-away.square())
    keep = (keep * (hits & (keep > FADED)))[..., None]
    return keep * floor + (1.0 - keep) * wall
