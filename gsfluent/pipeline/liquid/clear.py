"""Liquids in a picture: a body that takes light, a little or all, and a surface that reflects.

Splats blend one colour and one normal in a pixel. Where one looks through water at a stone, there
are two surfaces, so a liquid is drawn apart from what is behind it:

* its **body** takes ``1 - exp(-a t)`` of the light behind it, ``t`` the way through it (Beer and
  Lambert): each splat has the opacity of its own thickness, so that blending multiplies them;
* its **surface** is that of the same splats when they are opaque. Their normals are smoothed over
  the spacing of the points, across the picture and not across edges (van der Laan, Green and Sainz
  2009 smooth depths so), and so are depths; it reflects by Schlick (1994) with the index of water.

No ray is bent.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d, normalize

from gsfluent.data import Camera, Gaussians
from gsfluent.geometry import product, quaternion_to_matrix

FACE_ON = 0.02
"""Share that is reflected straight on, by an index of 1.33."""
OPACITY = 0.97
"""Of a splat of the surface."""
SMOOTH = 2.0
"""Standard deviation of the smoothing, in spacings of the points: a cell of the grid."""
EDGE = (0.25, 0.75)
"""Opacity of the splats at which the edge of a liquid begins, and where it is all there."""
FINE = 2.0
"""Distance of the points from which on edges are sharpened, entirely at twice as much [px]."""
EDGE_STEP = (6.0, 12.0)
"""Step of depth around a pixel, in spacings, from which on it shows two surfaces, and surely."""
ROUND = 0.7
"""Shortest over longest axis from which on a splat is a ball, more and more."""
STEP = 3.0
"""What lies so many spacings deeper is another surface."""
MOST_PIXELS = 12
"""Standard deviation of the smoothing, at most [px]."""
BRIGHT = 0.75
"""Linear radiance of the light from above that is reflected; a studio has a bright ceiling."""
CEILING = (0.25, 0.85)
"""Height of a unit vector at which the ceiling begins, and where it is all there."""


class Clear(NamedTuple):
    """Splats of liquids in a scene, clear or not.

    Attributes:
        rows: Which splats they are, bool [N].
        volume: Volume of the matter of each of them [m^3], [M] (M of ``rows``).
        attenuation: Of the light in their liquid [1/m], inf for what is opaque, [M].
        gloss: k_s and n_s of Blinn-Phong, [2].
    """

    rows: Tensor
    volume: Tensor
    attenuation: Tensor
    gloss: Tensor

    def select(self, kept: Tensor) -> Clear:
        """Those among splats of which some, bool [N], are kept."""
        mine = kept[self.rows]
        return Clear(self.rows[kept], self.volume[mine], self.attenuation[mine], self.gloss)


class Surface(NamedTuple):
    """The surface of a liquid in a picture.

    Attributes:
        alpha: Opacity, [H, W].
        depth: Camera z [m], [H, W].
        normal: Unit normals toward the eye, [H, W, 3]; zero where there is none.
    """

    alpha: Tensor
    depth: Tensor
    normal: Tensor


def body_opacities(splats: Gaussians, clear: Clear, eye: Tensor) -> Tensor:
    """Opacities [M] of the splats of a liquid as its body, seen from ``eye`` [3].

    A splat of volume V and standard deviations s is ``V / (2 pi s1 s2 s3 |S^-1/2 d|)`` thick where
    a ray of direction d goes through its middle: then it has its volume.
    """
    turn = quaternion_to_matrix(splats.quats)
    way = normalize(splats.means - eye, dim=1)
    along = (turn.mT @ way[..., None])[..., 0] / splats.scales
    shadow = 2.0 * math.pi * product(splats.scales) * along.norm(dim=1)
    thick = (clear.volume.to(shadow) / shadow.clamp(min=1e-30)).clamp(min=1e-12)
    return 1.0 - torch.exp(-clear.attenuation.to(shadow) * thick)


def surface_normals(splats: Gaussians, axes: Tensor, eye: Tensor) -> Tensor:
    """Normals [M, 3] of the splats of a liquid: their shortest ``axes`` [M, 3], toward the eye [3].

    The shortest axis of a ball is any: what is round, a drop, faces the eye.
    """
    least, most = splats.scales.amin(dim=1), splats.scales.amax(dim=1)
    ball = ((least / most - ROUND) / (1.0 - ROUND)).clamp(0.0, 1.0)
    return torch.lerp(axes, normalize(eye - splats.means, dim=1), ball[:, None])


def smoothed(surface: Surface, spacing: float, camera: Camera) -> Surface:
    """The surface, normals and depths smooth over a few spacings [m] but not across its edges."""
    there = surface.alpha > 0.05
    if not bool(there.any()):
        return surface
    depth = torch.where(there, surface.depth, 0.0)
    middle = float(depth[there].median())
    sigma = min(SMOOTH * spacing * float(camera.K[0, 0]) / middle, MOST_PIXELS)
    reach = math.ceil(2.5 * sigma)
    rows, columns = (span(there.any(dim=dim)) for dim in (1, 0))
    # the longer a blended normal is, the surer: near and far side of an outline cancel each other
    values = torch.cat([surface.normal, depth[..., None]], dim=2)[rows, columns]
    weight = (surface.alpha * there)[rows, columns]
    for dim in (0, 1):
        # a window has no more than the picture
        values, weight = _blurred(values, weight, sigma, min(reach, weight.shape[dim] - 1), dim,
                                  STEP * spacing)  # fmt: skip
    made = torch.cat([torch.zeros_like(surface.normal), surface.depth[..., None]], dim=2)
    there = there[rows, columns][..., None]
    values = torch.cat([normalize(values[..., :3], dim=2), values[..., 3:]], dim=2)
    made[rows, columns] = torch.where(there, values, made[rows, columns])
    return Surface(surface.alpha, made[..., 3], made[..., :3])


def span(there: Tensor, more: int = 0) -> slice:
    """From the first to the last of what is there, and so many more at either end."""
    found = there.nonzero()
    return slice(max(int(found[0]) - more, 0), int(found[-1]) + 1 + more)


def covered(surface: Surface, spacing: float, camera: Camera) -> Tensor:
    """Opacity [H, W] of a surface with the edge of a liquid, which is sharp.

    A level of the splats' field is the surface (Zhu and Bridson 2005): what half covers a pixel is
    its edge. Where points are hardly farther apart than pixels, there is nothing to be gained and
    drops would flicker: there their opacity stays.
    """
    pixels = spacing * float(camera.K[0, 0]) / surface.depth.clamp(min=1e-6)
    share = ((pixels - FINE) / FINE).clamp(0.0, 1.0)
    low, high = EDGE
    inside = ((surface.alpha - low) / (high - low)).clamp(0.0, 1.0)
    sharp = inside * inside * (3.0 - 2.0 * inside)
    return torch.lerp(surface.alpha, sharp, share)


def _blurred(
    values: Tensor, weight: Tensor, sigma: float, reach: int, dim: int, step: float
) -> tuple[Tensor, Tensor]:
    """Values [H, W, 4] blurred along a dimension with those of a like depth, their last."""
    total, many = torch.zeros_like(values), torch.zeros_like(weight)
    length = weight.shape[dim]
    # a wide bell is told by some of its places
    stride = max(1, int(sigma / 2.5))
    for k in range(-(reach // stride) * stride, reach + 1, stride):
        count = length - abs(k)
        here, there = max(0, -k), max(0, k)
        own, other = values.narrow(dim, here, count), values.narrow(dim, there, count)
        apart = (own[..., 3] - other[..., 3]) / step
        near = math.exp(-0.5 * (k / max(sigma, 1e-6)) ** 2) * torch.exp(-apart * apart)
        near = near * weight.narrow(dim, there, count)
        total.narrow(dim, here, count).add_(near[..., None] * other)
        many.narrow(dim, here, count).add_(near)
    return total / many.clamp(min=1e-12)[..., None], many


def single(surface: Surface, spacing: float) -> Tensor:
    """How much each pixel shows one surface, [H, W]: less where a nearer one ends before another.

    The normal of such a pixel is that of neither, and would catch lamps that neither does.
    """
    there = surface.alpha > 0.05
    planes = torch.stack([surface.depth, -surface.depth])
    planes = torch.where(there, planes, -torch.inf)[None]
    high = max_pool2d(max_pool2d(planes, (1, 3), 1, (0, 1)), (3, 1), 1, (1, 0))[0]
    low, most = EDGE_STEP
    return 1.0 - (((high[0] + high[1]) / spacing - low) / (most - low)).clamp(0.0, 1.0)


def in_front(surface: Surface, alpha: Tensor, depth: Tensor, spacing: float) -> Tensor:
    """Opacity [H, W] of a surface less where opaque things of ``alpha`` and ``depth`` hide it."""
    behind = ((depth - surface.depth) / spacing + 0.5).clamp(0.0, 1.0)
    return surface.alpha * (1.0 - alpha * (1.0 - behind))


def mirrored(normal: Tensor, rays: Tensor) -> tuple[Tensor, Tensor]:
    """What a surface reflects: its share [...] by Schlick (1994), and from where, [..., 3].

    Args:
        normal: Unit normals toward the eye, [..., 3].
        rays: Unit vectors from the eye, [..., 3].
    """
    facing = -(normal * rays).sum(dim=-1).clamp(max=0.0)
    share = FACE_ON + (1.0 - FACE_ON) * (1.0 - facing).clamp(0.0, 1.0) ** 5
    return share, normalize(rays + 2.0 * facing[..., None] * normal, dim=-1)


def ceiling(toward: Tensor) -> Tensor:
    """Radiance [...] of the bright ceiling in directions [..., 3]."""
    low, high = CEILING
    share = ((toward[..., 2] - low) / (high - low)).clamp(0.0, 1.0)
    return BRIGHT * share * share * (3.0 - 2.0 * share)
