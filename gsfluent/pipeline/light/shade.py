"""Light at points of surfaces: :func:`shade_points`, and how its tables are packed.

``L = c E(n) ao + sum_m T_m a_m I_m (c D_m + S_m)`` on linear radiance (equations.md section 16),
with Blinn-Phong ``D = max(0, n.l)`` and ``S = k_s max(0, n.h)^{n_s}``, ``h = (l + v) / |l + v|``.
``E`` is the light from everywhere: irradiance over pi in real spherical harmonics of degree 2
(Ramamoorthi and Hanrahan 2001). A highlight has the lamp's colour, not the object's, as on anything
that is no metal. ``T`` are percentage-closer soft shadows (Fernando 2005):
:mod:`gsfluent.pipeline.light.shadow`.

Pictures are shaded by :func:`gsfluent.ops.shade`, one kernel for all of a pixel; a test holds it to
these functions, which bake light into splats and shade captured surroundings. No statement here
waits for the device.

``lamps`` [L, LAMP]:
    ===== =======================================================================================
    0     0 directional, 1 point
    1-3   unit direction toward the lamp, or its position [m]
    4-6   colour times intensity, linear; of a point lamp at the distance in column 7
    7     distance [m] at which a point lamp has that intensity
    8     exponent of the falloff, ``(column 7 / r)^exponent``; 0 for none
    9     softness: tangent of half the angle of a directional lamp, radius [m] of a point lamp
    10    first shadow map, -1 for none
    11    number of shadow maps: 1, or 6 for the faces of a cube around a point lamp
    ===== =======================================================================================

``cameras`` [M, MAP], one row per shadow map (square, principal point in its centre):
    ===== =======================================================================================
    0-11  first three rows of the matrix scene -> map camera (OpenCV axes)
    12    focal length [texels]
    13    nearest depth [m] at which anything can block
    14    bias [m]: what is nearer than this to a surface, toward the lamp, does not block it
    ===== =======================================================================================

``studio`` [STUDIO]:
    ===== =======================================================================================
    0     z of the floor [m]
    1-2   x, y of the centre of the lit floor [m]
    3     distance [m] over which the floor dissolves into the backdrop
    4-6   paint of the floor, linear
    7-9   backdrop at and below the horizon, linear
    10-12 backdrop above, linear
    ===== =======================================================================================
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import normalize

from gsfluent.pipeline.light.shadow import ShadowMaps, transmittance

LAMP = 12
MAP = 15
STUDIO = 13
DIRECTIONAL, POINT = 0.0, 1.0
ALPHA_FLOOR = 1e-4
DISPLAY_GAMMA = 2.2
_TINY = 1e-12


def to_linear(color: Tensor) -> Tensor:
    """Display colour [0, 1] to linear radiance (pure power 2.2)."""
    return color.clamp(min=0.0).pow(DISPLAY_GAMMA)


def to_display(radiance: Tensor) -> Tensor:
    """Linear radiance to display colour, inverse of :func:`to_linear`."""
    return radiance.clamp(min=0.0).pow(1.0 / DISPLAY_GAMMA)


def surface_points(depth: Tensor, viewmat: Tensor, K: Tensor) -> tuple[Tensor, Tensor]:
    """Scene points [H, W, 3] of camera depths [H, W], and the unit rays [H, W, 3] to them."""
    height, width = depth.shape
    x = torch.arange(width, dtype=depth.dtype, device=depth.device) + 0.5
    y = torch.arange(height, dtype=depth.dtype, device=depth.device) + 0.5
    u = ((x - K[0, 2]) / K[0, 0]).expand(height, width)
    v = ((y - K[1, 2]) / K[1, 1])[:, None].expand(height, width)
    turn = viewmat[:3, :3]
    rays = torch.stack([u, v, torch.ones_like(u)], -1) @ turn
    eye = -(viewmat[:3, 3] @ turn)
    return eye + depth[..., None] * rays, normalize(rays, dim=-1)


def pixel_rays(pixels: Tensor, width: int, viewmat: Tensor, K: Tensor) -> Tensor:
    """Unit rays [M, 3] from the eye through some pixels, int64 [M], of a picture row by row."""
    x, y = (pixels % width).to(K) + 0.5, (pixels // width).to(K) + 0.5
    ray = torch.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], torch.ones_like(x)], 1)
    return normalize(ray @ viewmat[:3, :3], dim=1)


def shade_points(
    points: Tensor,
    normal: Tensor,
    view: Tensor,
    albedo: Tensor,
    gloss: Tensor,
    lamps: Tensor,
    environment: Tensor,
    *,
    ao: Tensor | None = None,
    maps: ShadowMaps | None = None,
) -> Tensor:
    """Linear radiance [..., 3] that points of surfaces send to the eye.

    Args:
        points: Where [m], [..., 3].
        normal: Outward normals of any length, [..., 3]; zero where there is none (then only the
            mean of the environment lights the point).
        view: Unit vectors toward the eye, [..., 3].
        albedo: Linear colour, [..., 3].
        gloss: k_s and n_s of Blinn-Phong, [..., 2] or [2].
        lamps: Packed lamps, [L, LAMP], see the module.
        environment: Irradiance over pi, ambient light included, [9, 3].
        ao: Share of the environment that arrives, [...]; all of it when None.
        maps: Shadow maps; no shadows when None.
    """
    normal = normalize(normal, dim=-1)
    around = irradiance(environment, normal)
    radiance = albedo * (around if ao is None else around * ao[..., None])
    for lamp in lamps:
        toward, strength = lamp_light(points, lamp)
        facing = (normal * toward).sum(-1)
        if maps is not None:
            strength = strength * transmittance(points, normal, lamp, maps)
        half = normalize(toward + view, dim=-1)
        highlight = (normal * half).sum(-1).clamp(min=0.0).pow(gloss[..., 1]) * gloss[..., 0]
        # light from below the horizon gives no highlight either
        strength = strength * (facing > 0.0)
        diffuse = albedo * (strength * facing)[..., None]
        radiance = radiance + lamp[4:7] * (diffuse + (strength * highlight)[..., None])
    return radiance


def lamp_light(points: Tensor, lamp: Tensor) -> tuple[Tensor, Tensor]:
    """Unit vectors [..., 3] from points [..., 3] toward one lamp, and its falloff [...]."""
    away = lamp[1:4] - points
    distance = away.norm(dim=-1).clamp(min=_TINY)
    point = lamp[0] > 0.5
    toward = torch.where(point, away / distance[..., None], lamp[1:4])
    return toward, torch.where(point, (lamp[7] / distance).pow(lamp[8]), 1.0)


def irradiance(environment: Tensor, normal: Tensor) -> Tensor:
    """Environment light over pi at unit normals [..., 3], from coefficients [9, 3]; never negative.

    The basis is the real spherical harmonics in the order 1, y, z, x, xy, yz, 3z^2 - 1, xz,
    x^2 - y^2, without the Condon-Shortley sign.
    """
    return (harmonics(normal) @ environment).clamp(min=0.0)


def harmonics(direction: Tensor) -> Tensor:
    """Real spherical harmonics of degree 0 to 2 at unit vectors [..., 3]: [..., 9]."""
    x, y, z = direction.unbind(-1)
    return torch.stack(
        [
            torch.full_like(x, 0.28209479177387814),
            0.4886025119029199 * y,
            0.4886025119029199 * z,
            0.4886025119029199 * x,
            1.0925484305920792 * x * y,
            1.0925484305920792 * y * z,
            0.31539156525252005 * (3.0 * z * z - 1.0),
            1.0925484305920792 * x * z,
            0.5462742152960396 * (x * x - y * y),
        ],
        -1,
    )


def arriving(
    points: Tensor,
    up: Tensor,
    lamps: Tensor,
    environment: Tensor,
    ao: Tensor | None,
    maps: ShadowMaps | None,
) -> Tensor:
    """Light over pi [..., 3] that arrives at points [..., 3] of a matt surface, normals ``up``.

    The surface itself is not in the shadow maps: no bias.
    """
    arrives = irradiance(environment, up)
    if ao is not None:
        arrives = arrives * ao[..., None]
    for lamp in lamps:
        toward, strength = lamp_light(points, lamp)
        strength = strength * (toward * up).sum(-1).clamp(min=0.0)
        if maps is not None:
            strength = strength * transmittance(points, up, lamp, maps, biased=0.0)
        arrives = arrives + lamp[4:7] * strength[..., None]
    return arrives
