"""Liquid that holds to the solids it wets.

The grid's contact pushes but does not pull: a film would leave a ball where the wall turns away
from it. In air it does not: the pressure around it holds a film on a wall that curves away (the
Coanda effect), against ``rho v^2 t / R``, some tens of pascals. So what moves away from a wall
slowly and is within the grid's reach of it goes on along it; the solid takes the momentum.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.pipeline.matter.points import Matter
from gsfluent.pipeline.matter.state import State
from gsfluent.spatial.neighbours import nearest_rows

REACH = 1.5
"""Distance from the outermost points of a solid within which liquid wets it [cells]."""
TEARS = 0.6
"""Speed away from the wall from which on liquid tears off [m/s]: a splash, not a film."""
_AROUND = 32
_ONE_SIDED = 0.2
"""How far off the middle of its neighbours a point of the skin is, in spacings."""


class Skin(NamedTuple):
    """The outermost points of the solids.

    Attributes:
        rows: Material points, int64 [S].
        normals: Outward unit normals at rest, float64 [S, 3].
    """

    rows: Tensor
    normals: Tensor

    @staticmethod
    def of(matter: Matter, bodies: list[int]) -> Skin | None:
        """The skin of some bodies; None when they have none."""
        rows, normals = [], []
        for number in bodies:
            a, b = matter.ranges[number]
            places, edge = matter.rest[a:b].double(), matter.spacing[number]
            count = min(_AROUND, b - a)
            _, index = nearest_rows(places, places, count, 2.0 * edge)
            off = places - places[index].mean(dim=1)
            mine = (off.norm(dim=1) > _ONE_SIDED * edge).nonzero()[:, 0]
            if mine.numel() == 0:
                continue
            # A lattice has steps: the normal is that of a patch.
            patch = min(_AROUND, mine.shape[0])
            _, index = nearest_rows(places[mine], places[mine], patch, 2.0 * edge)
            normal = torch.nn.functional.normalize(off[mine], dim=1)[index].sum(dim=1)
            rows.append(mine + a)
            normals.append(torch.nn.functional.normalize(normal, dim=1))
        return Skin(torch.cat(rows), torch.cat(normals)) if rows else None


def held(state: State, skin: Skin, liquid: Tensor, on_grid: Tensor, dx: float) -> State:
    """The state after films have been turned along the walls they wet.

    Args:
        state: A state.
        skin: Of the solids.
        liquid: Rows of the liquids' points on the grid, int64 [L].
        on_grid: Points on the grid, bool [N].
        dx: Grid spacing [m].

    Returns:
        The state with other velocities; its momentum is the same to rounding, its energy no more.
    """
    p = state.particles
    there = on_grid[skin.rows]
    rows, rest = skin.rows[there], skin.normals[there]
    if rows.numel() == 0 or liquid.numel() == 0:
        return state
    wall, reach = state.position[rows], REACH * dx
    low, high = wall.amin(dim=0) - reach, wall.amax(dim=0) + reach
    place = state.position[liquid]
    near = ((place > low) & (place < high)).all(dim=1)
    liquid, place = liquid[near], place[near]
    if liquid.numel() == 0:
        return state
    distance, index = nearest_rows(wall, place, 1, dx)
    close = distance[:, 0] < reach
    liquid, index = liquid[close], index[close, 0]
    touched, place_in = torch.unique(index, return_inverse=True)
    normal = rest[touched]
    if p.deformation is not None:
        turn = ops.polar_clamped(p.deformation[rows[touched]], 0.6, 1.5)[0]
        normal = (turn.double() @ normal[..., None])[..., 0]
    normal, rows = normal[place_in], rows[touched]
    away = p.velocity[liquid].double() - p.velocity[rows[place_in]].double()
    speed = (away * normal).sum(dim=1)
    speed = torch.where((speed > 0.0) & (speed < TEARS), speed, 0.0)
    mass = p.mass.double()
    # Sums in whole numbers have no order.
    unit = float(mass.max()) * 2.0**-40
    given = torch.zeros((rows.shape[0], 3), dtype=torch.long, device=rows.device)
    mine = torch.where(speed > 0.0, mass[liquid], 0.0)
    load = given[:, 0].index_add(0, place_in, (mine / unit).round().long()).double() * unit
    # As many inelastic impacts on one point of the wall: by Cauchy's inequality energy falls.
    share = mass[rows] / (mass[rows] + load)
    push = (mine * share[place_in] * speed)[:, None] * normal
    push = (push / unit).round().long()
    given.index_add_(0, place_in, push)
    velocity = p.velocity.clone()
    taken = push.double() * unit / mass[liquid][:, None]
    velocity[liquid] = (velocity[liquid].double() - taken).to(velocity)
    pulled = given.double() * unit / mass[rows][:, None]
    velocity[rows] = (velocity[rows].double() + pulled).to(velocity)
    return state._replace(particles=p.replace(velocity=velocity))
