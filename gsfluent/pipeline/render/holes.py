"""How much shows through the object that should not: holes in its silhouette, and in its front.

When a body breaks, the Gaussians that it carries part and what is behind shines through. What ought
to be opaque comes from the matter itself: its material points as discs that just overlap at rest. A
true gap between fragments is therefore no hole, a see-through fragment is, and so is an opening too
narrow for the points to know of. Measured on true pictures of fractures
(docs/measured/crack_accuracy.md) this finds next to nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gsfluent.data import Camera
from gsfluent.spatial.zbuffer import nearest_points

REACH = 0.55
"""Radius of a point's disc in point spacings."""
SPECK = 0.6
"""Openings between the discs that fill less than half of a square of this many spacings are closed:
stretched matter has some."""
LEVEL = 2.0
"""Only where what is around differs in depth by less than this many spacings: two outlines that
meet in the picture have a true gap between them."""
RIM = 0.3
"""The silhouette is drawn in by this many spacings, and one pixel: a soft rim is not a hole."""
BEHIND = 1.5
"""What is seen this many spacings behind the matter's front is seen through it."""
LONGEST_SIDE = 320
"""Pictures that are measured are no larger [px]."""


@dataclass(frozen=True)
class MatterView:
    """The matter in one camera.

    Attributes:
        point: Material point that is seen, int64 [H, W], -1 for none.
        depth: Camera z of its centre [m], 0 where none, [H, W].
        silhouette: Pixels that ought to be opaque, bool [H, W].
        back: Depth beyond which something is behind the matter's front, whatever of its
            neighbourhood is in front, [H, W].
    """

    point: Tensor
    depth: Tensor
    silhouette: Tensor
    back: Tensor

    @classmethod
    def of(cls, positions: Tensor, volume: Tensor, camera: Camera) -> MatterView:
        """Draw material points [P, 3] of volumes [P] [m^3]."""
        spacing = volume.clamp(min=0.0).pow(1.0 / 3.0)
        point = nearest_points(positions, REACH * spacing, camera)
        seen = point >= 0
        viewmat = camera.viewmat.to(positions)
        z = positions @ viewmat[2, :3] + viewmat[2, 3]
        depth = torch.where(seen, z[point.clamp(min=0)], 0.0)
        if not bool(seen.any()):
            return cls(point, depth, seen, depth)
        own = spacing[point[seen]]
        pixels = float((camera.K[0, 0].to(own) * own / depth[seen]).median())
        speck = round(0.5 * SPECK * pixels)
        far = dilated(depth, speck)
        near = -dilated(torch.where(seen, -depth, -torch.inf), speck)
        level = far - near < LEVEL * float(own.median())
        seen = seen | (_mostly(seen, speck) & level)
        rim = round(RIM * pixels) + 1
        back = dilated(depth, round(pixels)) + BEHIND * float(own.median())
        return cls(point, depth, erode(seen, rim), back)


@dataclass(frozen=True)
class Holes:
    """Shares of the silhouette, 0 to 1.

    Attributes:
        fraction: Mean transmittance: how much of the background shows through.
        through: Share of the pixels in which one looks through the front at something far behind:
            the light comes, on average, from behind ``MatterView.back``.
    """

    fraction: float
    through: float

    @classmethod
    def of(cls, alpha: Tensor, depth: Tensor, matter: MatterView) -> Holes:
        """Measure a picture.

        Args:
            alpha: Opacity of the splats, [H, W], at the size of ``matter`` or larger.
            depth: Their expected depth [m], of the same size.
            matter: What ought to be opaque.
        """
        area = int(matter.silhouette.sum())
        if area == 0:
            return cls(0.0, 0.0)
        size = matter.silhouette.shape
        if alpha.shape != size:
            planes = alpha[None, None], depth[None, None]
            alpha = torch.nn.functional.interpolate(planes[0], size, mode="area")[0, 0]
            depth = torch.nn.functional.interpolate(planes[1], size, mode="nearest")[0, 0]
        left = (1.0 - alpha)[matter.silhouette].clamp(0.0, 1.0)
        behind = matter.silhouette & (depth > matter.back)
        return cls(float(left.sum()) / area, float(behind.sum()) / area)


def small(camera: Camera, longest: int = LONGEST_SIDE) -> Camera:
    """The camera at the size in which figures are measured."""
    return camera.scaled(min(1.0, longest / max(camera.width, camera.height)))


def erode(mask: Tensor, pixels: int = 1) -> Tensor:
    """Drop the outermost ``pixels`` of a mask [H, W]; the edge of the picture is no edge of it."""
    return dilated((~mask).to(torch.float32), pixels) < 0.5


def _mostly(mask: Tensor, pixels: int) -> Tensor:
    """Pixels that are in the mask or in whose neighbourhood most are."""
    share = torch.nn.functional.avg_pool2d(
        mask.to(torch.float32)[None, None], 2 * pixels + 1, 1, pixels, count_include_pad=False
    )[0, 0]
    return mask | (share > 0.5)


def dilated(image: Tensor, pixels: int) -> Tensor:
    """Largest value in the square of ``2 pixels + 1`` around each pixel of [..., H, W]."""
    planes = image.reshape(1, -1, *image.shape[-2:])
    size = 2 * pixels + 1
    # rows, then columns: a square window in one go takes a hundred times as long
    rows = torch.nn.functional.max_pool2d(planes, (1, size), 1, (0, pixels))
    return torch.nn.functional.max_pool2d(rows, (size, 1), 1, (pixels, 0)).view_as(image)
