"""Splats for what has no photographs: bullets, poured liquids, rigid things."""

from __future__ import annotations

import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.data import SPRAY, SURFACE, Gaussians, Particles
from gsfluent.geometry import matrix_to_quaternion
from gsfluent.pipeline.colliders.patches import FINEST, Patches, rectangle
from gsfluent.pipeline.colliders.rigid import RigidSet
from gsfluent.pipeline.liquid.sheet import CLOSED, TENSION, ellipsoids
from gsfluent.pipeline.liquid.sheet import SPRAY as SPRAY_SIZE
from gsfluent.pipeline.liquid.tearing import in_air, tears
from gsfluent.scene.scene import Scene

_STEEL = (0.40, 0.41, 0.43)
_OPAQUE = 0.95
_ALONE = 0.75
"""Size of a drop without neighbours over that of a point of a liquid, up to which it is one."""
_SMALLEST, _LARGEST = 0.35, 1.6  # drops, over the size of their mean volume
_BLADE = (0.55, 0.57, 0.60)
_PLATE_HEIGHT = 0.16
"""Of the plate that stands for a blade, in widths."""
_PAINT = {
    "water": (0.50, 0.62, 0.66),
    "milk": (0.88, 0.865, 0.81),
    "honey": (0.75, 0.45, 0.08),
    "oil": (0.70, 0.60, 0.15),
}
_LIQUID = (0.50, 0.62, 0.66)
_OPACITY = {"water": 0.4}
"""Of one splat; many behind each other are opaque all the same, drops and edges are not."""


def bare_splats(particles: Particles, scene: Scene) -> Gaussians | None:
    """Splats for bodies that have matter but no photographs, or None without any.

    Bullets are steel grey; liquids have the colour of their name, or that of water, and are drawn
    by the sheet (:mod:`gsfluent.pipeline.liquid.sheet`).
    """
    groups = []
    for number, body in enumerate(scene.bodies):
        if body.solid is not None:
            continue
        rows = particles.body == number
        position, volume = particles.position[rows], particles.volume[rows]
        flows = body.material.law == "fluid"
        paint = _PAINT.get(body.material.name.split(".")[-1], _LIQUID if flows else _STEEL)
        if flows:
            edge = float(volume.double().mean()) ** (1.0 / 3.0)
            free = None
            if tears(body.material):
                solid = particles.position[_stands(particles, scene)]
                free = in_air(position, solid, edge, scene.floor)
            drawn = ellipsoids(position, volume, free)
            size = CLOSED * volume.pow(1.0 / 3.0)
            lone = (_ALONE - drawn.scales[:, 0] / size).clamp(0.0, _ALONE - SPRAY_SIZE)
            lone = lone / (_ALONE - SPRAY_SIZE)
            drops = _drops(size, max(TENSION / edge, 1.0) if edge > 0.0 else 1.0)
            none = drops == 0.0
            sizes = torch.lerp(torch.ones_like(size), drops.clamp(min=_SMALLEST), lone)
            made = _splats(drawn.means, drawn.scales * sizes[:, None], paint)
            share = _OPACITY.get(body.material.name.split(".")[-1], _OPAQUE)
            opacities = share * torch.where(none, 1.0 - lone, 1.0).to(made.opacities)
            mist = (lone > 0.0) & (volume < TENSION**3)
            labels = torch.where(mist, SPRAY, SURFACE).to(torch.int32)
            groups.append(made.replace(quats=drawn.quats, opacities=opacities, labels=labels))
        else:
            groups.append(_splats(position, CLOSED * volume.pow(1.0 / 3.0), paint))
    return Gaussians.cat(groups) if groups else None


def _stands(particles: Particles, scene: Scene) -> Tensor:
    """Points of bodies that have splats of their own, bool [N]."""
    stands = [body.solid is not None for body in scene.bodies]
    return torch.tensor(stands, device=particles.body.device)[particles.body.long()]


def _drops(like: Tensor, coarse: float = 1.0) -> Tensor:
    """Sizes of drops over that of their mean volume, each its own for good; 0 for no drop.

    What tears into drops of one size by its points does not in life: volumes are exponentially
    distributed, the simplest of the laws that a ligament's drops obey (Villermaux 2007). Nor are
    they as fine as the points: of those that tension draws together one is drawn for all.

    Args:
        like: One value a point, [N].
        coarse: Mean size of the drops over that of the points.
    """
    number = torch.arange(like.shape[0], device=like.device)
    share, drawn = (0.5 + 0.5 * ops.hashes(number, [0, 1])).unbind(dim=1)
    volume = -torch.log(share.clamp(min=1e-9))
    size = coarse * volume.pow(1.0 / 3.0).clamp(_SMALLEST, _LARGEST)
    return torch.where(drawn < coarse**-3, size, 0.0).to(like)


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
    found = rigid.surfaces(rows)
    return None if found is None else _flat(found, _STEEL)


def blade_splats(scene: Scene, time: float, device: torch.device | str = "cpu") -> Gaussians | None:
    """Splats of the blades: a plate behind each edge, or None without blades.

    An edge waits where its path begins, moves along it, is drawn back the way it came, and is gone.

    Args:
        scene: The scene.
        time: Time [s].
        device: Where they are made.
    """
    made = []
    for blade in scene.blades:
        path = torch.tensor(blade.path, dtype=torch.float64)
        legs = path[1:] - path[:-1]
        lengths = legs.norm(dim=1)
        whole = float(lengths.sum())
        along = max(blade.speed * (time - blade.start), 0.0)
        if along > 2.0 * whole:
            continue
        along = along if along <= whole else 2.0 * whole - along
        leg = 0
        while leg + 1 < len(lengths) and along > float(lengths[leg]):
            along -= float(lengths[leg])
            leg += 1
        way = legs[leg] / lengths[leg]
        edge = torch.tensor(blade.edge, dtype=torch.float64)
        normal = torch.linalg.cross(edge, way)
        normal = normal / normal.norm()
        half = 0.5 * blade.width, 0.5 * _PLATE_HEIGHT * blade.width
        turn = torch.stack([edge, torch.linalg.cross(normal, edge), normal], 1)
        middle = path[leg] + (along - half[1]) * way
        plate = rectangle(half, blade.width * FINEST).moved(turn, middle)
        made.append(_flat(Patches(*(part.to(device) for part in plate)), _BLADE))
    return Gaussians.cat(made) if made else None


def _flat(found: Patches, paint: tuple[float, float, float]) -> Gaussians:
    made = _splats(found.points.float(), found.sizes.float().contiguous(), paint)
    quats = matrix_to_quaternion(found.turn).float()
    return made.replace(quats=quats, normals=found.turn[..., 2].float().contiguous())


def _splats(position: Tensor, sizes: Tensor, paint: tuple[float, float, float]) -> Gaussians:
    colors = position.new_tensor(paint).expand_as(position).contiguous()
    return Gaussians.from_colors(position, sizes, colors, opacities=_OPAQUE, label=SURFACE)
