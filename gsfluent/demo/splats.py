"""A demo object as the splats that a careful reconstruction of it would leave: its skin alone."""

from __future__ import annotations

import math

import torch

from gsfluent.data.gaussians import Gaussians
from gsfluent.demo.capture import make_object, ring_cameras, shade
from gsfluent.errors import InputError

_VIEWS = 26  # from above and from below, so that no side is missed
_SPREAD = 0.7  # standard deviation of a splat, in spacings


def make_splats(name: str = "watermelon", *, spacing: float = 0.005, seed: int = 0) -> Gaussians:
    """Splats on the skin of a demo object, made without photographs: a quick input for a first try.

    The frame is the scene's: metres, +z up, the object resting on z = 0.

    Args:
        name: As for :func:`gsfluent.demo.make_object`.
        spacing: Distance between neighbouring splats [m], 0.0005 or more.
        seed: Draws the object.

    Returns:
        Spheres with the colours of the skin in daylight, float32.

    Raises:
        InputError: No such object, or a spacing out of range.
    """
    if not 0.0005 <= spacing < math.inf:
        raise InputError(f"spacing {spacing} m", "give 0.0005 or more")
    obj = make_object(name, seed)
    hits = []
    for view in ring_cameras(obj, _VIEWS, on_table=False):
        eye = -(view[:3, :3].T @ view[:3, 3])
        # rays twice as fine as the splats where the camera's axis meets the middle
        reach = 1.3 * max(obj.axes)
        line = torch.arange(-reach, reach, 0.5 * spacing, dtype=torch.float64)
        y, x = torch.meshgrid(line, line, indexing="ij")
        far = torch.full_like(x, float((eye - obj.center).norm()))
        directions = torch.stack([x, y, far], -1).reshape(-1, 3) @ view[:3, :3]
        hits.append(obj.intersect(eye, directions)[1])
    points = torch.cat(hits)
    _, box = torch.unique((points / spacing).round().long(), dim=0, return_inverse=True)
    first = torch.full((int(box.max()) + 1,), len(points)).scatter_reduce_(
        0, box, torch.arange(len(points)), "amin"
    )
    means = points[first].to(torch.float32)
    colors = obj.surface_color(means) * shade(obj.normal(means))[:, None]
    return Gaussians.from_colors(
        means, torch.full((len(means),), _SPREAD * spacing), colors.clamp(0.0, 1.0), opacities=0.95
    )
