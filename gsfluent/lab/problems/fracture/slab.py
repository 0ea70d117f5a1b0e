"""What plastic and fracture problems share: thin slabs, planes, NACC rows, plastic work.

A slab is one cell thick between two frictionless planes, which makes a plane-strain problem of it
at the cost of one layer of points.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.lab.world.driver import World
from gsfluent.lab.world.shapes import moduli

__all__ = ["Dissipation", "between_planes", "nacc", "plane", "sheet", "wave_speed"]

STICKY, SLIP, SEPARATE = 0.0, 1.0, 2.0


def nacc(
    young: float,
    poisson: float,
    density: float,
    *,
    friction: float,
    cohesion: float,
    hardening: float,
    shear_damage: float = 0.0,
) -> Tensor:
    """One NACC row of ``params``, float64 [8] (see :func:`gsfluent.ops.return_mapping`)."""
    mu, kappa = moduli(young, poisson)
    row = [mu, kappa, friction, cohesion, hardening, shear_damage, density, 0.0]
    return torch.tensor(row, dtype=torch.float64)


def wave_speed(row: Tensor) -> float:
    """Speed of the pressure wave of a solid's row at rest [m/s]."""
    return math.sqrt((float(row[1]) + 4.0 / 3.0 * float(row[0])) / float(row[6]))


def plane(
    point: Sequence[float],
    normal: Sequence[float],
    *,
    mode: float = SLIP,
    friction: float = 0.0,
    velocity: Sequence[float] = (0.0, 0.0, 0.0),
) -> Tensor:
    """Collider row of a plane, float64 [16]: mode 0 sticky, 1 slip, 2 separate."""
    row = torch.zeros(16, dtype=torch.float64)
    row[1], row[2] = mode, friction
    row[3:6], row[6:9] = torch.tensor([*point]), torch.tensor([*normal])
    row[10:13] = torch.tensor([*velocity])
    return row


def sheet(lower: Sequence[float], size: Sequence[float], dx: float, per_cell: int = 2) -> Tensor:
    """One layer of points in the x-y plane, in the middle of the cell 0 <= z <= dx, [N, 3].

    Each point stands for ``(dx / per_cell)**2 * dx``.

    Args:
        lower: Lower x and y [m].
        size: Extents in x and y [m], whole numbers of ``dx / per_cell``.
        dx: Node spacing [m].
        per_cell: Points along each edge of a cell.
    """
    step = dx / per_cell
    axes = [
        low + (torch.arange(round(edge / step), dtype=torch.float64) + 0.5) * step
        for low, edge in zip(lower, size, strict=True)
    ]
    flat = torch.cartesian_prod(*axes)
    return torch.cat([flat, torch.full((flat.shape[0], 1), 0.5 * dx, dtype=flat.dtype)], dim=1)


def between_planes(dx: float, axes: Sequence[int] = (2,), width: float | None = None) -> Tensor:
    """Frictionless planes at 0 and ``width`` (default ``dx``) on each axis, [2 len(axes), 16]."""
    rows = []
    for axis in axes:
        for at, sign in ((0.0, 1.0), (dx if width is None else width, -1.0)):
            point, normal = [0.0] * 3, [0.0] * 3
            point[axis], normal[axis] = at, sign
            rows.append(plane(point, normal))
    return torch.stack(rows)


class Dissipation:
    """Plastic dissipation of every point: work of the stress less what is stored [J].

    Give it to ``World.run(each=...)``. The work of a step is ``V0 tau_n : dt grad v_{n+1}``, that
    of the grid forces of that step, so that the sum closes the discrete energy balance.
    """

    def __init__(self, world: World) -> None:
        self.work = torch.zeros_like(world.position[:, 0], dtype=torch.float64)
        self._world, self._stress = world, world.stress

    def __call__(self, world: World) -> None:
        """Add the work of the step just made."""
        c, t = world.affine, self._stress
        power = (
            t[:, 0] * c[:, 0, 0]
            + t[:, 1] * c[:, 1, 1]
            + t[:, 2] * c[:, 2, 2]
            + t[:, 3] * (c[:, 0, 1] + c[:, 1, 0])
            + t[:, 4] * (c[:, 0, 2] + c[:, 2, 0])
            + t[:, 5] * (c[:, 1, 2] + c[:, 2, 1])
        )
        self.work += (power * world.scene.volume).double() * world.dt
        self._stress = world.stress

    def of_points(self) -> Tensor:
        """Dissipated so far by each point [J], float64 [N]."""
        scene = self._world.scene
        stored = ops.elastic_energy(
            self._world.strain.double(),
            law=scene.law,
            params=scene.params.double(),
            material=scene.material,
        )
        return self.work - scene.volume.double() * stored
