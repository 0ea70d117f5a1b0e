"""Two pictures of splats set into each other by depth, pixel by pixel.

Splats are sorted by their centres. Where a blade is in a cake, a wide splat of icing lies on both
sides of it and would be painted over it as a whole, or not at all. Drawn apart, each has its own
depth in every pixel, and what is nearer covers what is behind (Porter and Duff 1984).
"""

from __future__ import annotations

import torch
from torch import Tensor

from gsfluent.ops.raster import Rendered

WIDTH = 1.0
"""Difference of depths [pixels] over which one goes over into the other."""
_NONE = 1e-4


def merged(one: Rendered, other: Rendered, focal: Tensor) -> Rendered:
    """Both in one picture.

    Args:
        one: A picture with depth, black where there is nothing.
        other: Another one in the same camera, with the same planes.
        focal: Focal length [px].
    """
    assert one.depth is not None and other.depth is not None  # a caller asks for them
    nearest = torch.minimum(
        torch.where(one.alpha > _NONE, one.depth, torch.inf),
        torch.where(other.alpha > _NONE, other.depth, torch.inf),
    )
    width = (WIDTH * nearest / focal).nan_to_num(posinf=1.0).clamp(min=1e-12)
    before = ((other.depth - one.depth) / width + 0.5).clamp(0.0, 1.0)
    # what is not there hides nothing, whatever its depth
    left = 1.0 - (1.0 - before) * other.alpha, 1.0 - before * one.alpha
    weight = left[0] * one.alpha, left[1] * other.alpha
    alpha = weight[0] + weight[1]
    depth = (weight[0] * one.depth + weight[1] * other.depth) / alpha.clamp(min=1e-12)

    def both(a: Tensor, b: Tensor) -> Tensor:
        return left[0][..., None] * a + left[1][..., None] * b

    normal = None
    if one.normal is not None and other.normal is not None:
        normal = both(one.normal, other.normal)
    image = both(one.image, other.image)
    return one._replace(image=image, alpha=alpha, depth=depth, normal=normal)
