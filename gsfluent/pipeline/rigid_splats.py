"""Splats for what has no photographs: bullets, poured liquids, rigid things."""

from __future__ import annotations

import torch
from torch import Tensor

from gsfluent.data import SURFACE, Gaussians, Particles
from gsfluent.pipeline.rigid import RigidSet
from gsfluent.scene import Scene

# Splats of this many standard deviations per spacing close a packing of particles.
_SIGMA_IN_SPACINGS = 0.6
_STEEL = (0.25, 0.25, 0.25)
_PAINT = {
    "water": (0.45, 0.60, 0.68),
    "milk": (0.93, 0.91, 0.85),
    "honey": (0.75, 0.45, 0.08),
    "oil": (0.70, 0.60, 0.15),
}
_LIQUID = (0.45, 0.60, 0.68)


def bare_splats(particles: Particles, scene: Scene) -> Gaussians | None:
    """Splats for bodies that have matter but no photographs, or None without any.

    Bullets are steel grey; liquids have the colour of their name, or that of water.
    """
    groups = []
    for number, body in enumerate(scene.bodies):
        if body.solid is not None:
            continue
        rows = particles.body == number
        position, volume = particles.position[rows], particles.volume[rows]
        plain = _LIQUID if body.material.law == "fluid" else _STEEL
        paint = _PAINT.get(body.material.name.split(".")[-1], plain)
        groups.append(_splats(position, _SIGMA_IN_SPACINGS * volume.pow(1.0 / 3.0), paint))
    return Gaussians.cat(groups) if groups else None


def bare_points(particles: Particles, scene: Scene) -> Tensor:
    """Material point of each splat of :func:`bare_splats`, int64."""
    rows = [
        (particles.body == number).nonzero()[:, 0]
        for number, body in enumerate(scene.bodies)
        if body.solid is None
    ]
    return torch.cat(rows) if rows else particles.body.new_empty(0, dtype=torch.int64)


def rigid_splats(rigid: RigidSet, rows: Tensor) -> Gaussians | None:
    """Steel-grey splats on the surfaces of the rigid things but endless planes, or None.

    Args:
        rigid: The colliders.
        rows: Their rows now, [M, 32].
    """
    points, normals, spacing = rigid.surfaces(rows)
    if points.shape[0] == 0:
        return None
    sizes = torch.full_like(points[:, 0], _SIGMA_IN_SPACINGS * spacing)
    made = _splats(points.float(), sizes.float(), _STEEL)
    return made.replace(normals=normals.float())


def _splats(position: Tensor, sizes: Tensor, paint: tuple[float, float, float]) -> Gaussians:
    colors = position.new_tensor(paint).expand_as(position).contiguous()
    return Gaussians.from_colors(position, sizes, colors, opacities=0.95, label=SURFACE)
