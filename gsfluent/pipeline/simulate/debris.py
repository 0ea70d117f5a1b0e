"""Debris: loose matter without a grid, dust as free points and chips as small rigid bodies.

A broken point carries no tension and, alone, no stress at all. As dust it moves as a free point: it
falls, and stays where it meets the floor. Broken points that are far from what is left of the
objects become dust, too, so that a few of them do not stretch the grid over metres of empty space.
A chip is on the grid only beside other matter; elsewhere it flies and tumbles as a rigid body, and
comes to rest on whatever collider it meets.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.ops import collider as columns
from gsfluent.pipeline.colliders.proximity import boxes
from gsfluent.pipeline.colliders.rigid import RigidSet
from gsfluent.pipeline.matter.points import Matter
from gsfluent.pipeline.matter.state import State, kinetic_energy
from gsfluent.pipeline.simulate.groups import LANDING, grid_mask

LEAVE = 2.0
"""A chip leaves the grid with no matter in the 3^3 cubes of so many cells around its points ..."""
RETURN = 1.0
"""... and comes back with some in those of this edge."""
_TURN = 0.1
"""Largest turn per integration step [rad], unless that takes more than ``_TURNS`` steps."""
_TURNS = 64
DISTANCE = 8.0
"""Distance from the middle of the unbroken matter, in extents of the largest body."""


def reach_of(matter: Matter) -> float:
    """Distance [m] beyond which a broken point is loose."""
    extents = []
    for a, b in matter.ranges:
        low, high = torch.aminmax(matter.rest[a:b], dim=0)
        extents.append(float((high - low).max()))
    return DISTANCE * max(extents)


def find_far(position: Tensor, peak: Tensor, candidate: Tensor, reach: float) -> Tensor:
    """Tell which candidates are broken and far from the unbroken matter, bool [N].

    Args:
        position: Positions [m], [N, 3].
        peak: Largest alpha so far, [N].
        candidate: Points on the grid, bool [N].
        reach: Distance that counts as far [m].
    """
    whole = candidate & (peak < 0)
    weight = torch.where(whole.any(), whole, candidate).to(position)[:, None]
    middle = (weight * position).sum(dim=0) / weight.sum().clamp(min=1.0)
    far = ((position - middle) ** 2).sum(dim=1) > reach * reach
    return candidate & far & (peak >= 0)


def let_go(state: State, gone: Tensor) -> State:
    """The state in which these points [N] are dust, without a strain; no momentum is lost."""
    p = state.particles
    return state._replace(
        particles=p.unstrained(gone),
        loose=state.loose | gone,
        unit=torch.where(gone, -1, state.unit),
    )


def near_matter(position: Tensor, what: Tensor, whom: Tensor, edge: float) -> Tensor:
    """Which of some points have other points around them, bool [N].

    Args:
        position: Positions [m], [N, 3].
        what: Points that are asked about, bool [N].
        whom: Points that count as matter, bool [N].
        edge: Something in the 3^3 cubes of this edge around a point is near [m].
    """
    near = torch.zeros_like(what)
    rows = (what | whom).nonzero()[:, 0]
    if not bool(what.any()) or not bool(whom.any()):
        return near
    cube = torch.floor(position[rows] / edge).to(torch.int64)
    cube = cube - cube.amin(dim=0) + 1
    wide = cube.amax(dim=0) + 2
    key = (cube[:, 0] * wide[1] + cube[:, 1]) * wide[2] + cube[:, 2]
    filled = torch.unique(key[whom[rows]])
    asked, home = torch.unique(key[what[rows]], return_inverse=True)
    step = torch.tensor([-1, 0, 1], device=key.device)
    star = ((step[:, None, None] * wide[1] + step[:, None]) * wide[2] + step).flatten()
    wanted = asked + star[:, None]
    at = torch.searchsorted(filled, wanted).clamp(max=filled.shape[0] - 1)
    near[rows[what[rows]]] = (filled[at] == wanted).any(dim=0)[home]
    return near


def _of_chips(near: Tensor, index: Tensor, count: int) -> Tensor:
    """Chips of which any point is marked, bool [count]."""
    return torch.bincount(index[near], minlength=count) > 0


def settle_chips(state: State, matter: Matter, rigid: RigidSet, chip: Tensor) -> State:
    """Take chips off the grid that have nothing near, and put those back that met matter again.

    What is near is matter on the grid that is no chip, and colliders that move. A chip leaves with
    its linear and angular momentum as a rigid body; the vibration that is lost is added to
    ``dissipated``.

    Args:
        state: The state; ``unit`` tells the chips apart.
        matter: The points.
        rigid: The colliders.
        chip: Points of chips, bool [N].
    """
    dx = matter.dx
    on_grid = grid_mask(state, matter)
    rows = (chip & (on_grid | state.loose) & (state.unit >= 0)).nonzero()[:, 0]
    if rows.numel() == 0:
        return state
    ids, index = torch.unique(state.unit[rows], return_inverse=True)
    count = ids.shape[0]
    solid = on_grid & ~chip
    here = torch.zeros_like(chip).index_fill(0, rows, True)
    off = torch.zeros(count, dtype=torch.bool, device=rows.device)
    off[index[state.loose[rows]]] = True
    close = near_matter(state.position, here, solid, RETURN * dx)[rows]
    beside = near_matter(state.position, here, solid, LEAVE * dx)[rows]
    low, high = boxes(state.position[rows], index, count)
    gaps = torch.tensor(rigid.gaps(rigid.moving(state.colliders), low, high))
    driven = (gaps <= LANDING * dx).to(off.device)
    back = off & _of_chips(close, index, count)
    leaves = ~off & ~_of_chips(beside, index, count) & ~driven
    loose = state.loose.clone()
    loose[rows[back[index]]] = False
    going = rows[leaves[index]]
    if going.numel():
        state = _stiffened(state, matter, going)
        loose[going] = True
    return state if torch.equal(loose, state.loose) else state._replace(loose=loose)


def _stiffened(state: State, matter: Matter, rows: Tensor) -> State:
    """The state in which chips move as rigid bodies, without a strain."""
    p = state.particles
    mass, velocity, affine = p.mass[rows], p.velocity[rows], p.affine[rows]
    before = kinetic_energy(mass, velocity, affine, matter.dx)
    density = matter.stored(p.select(rows), state.peak[rows])
    stored = (density.double() * p.volume[rows].double()).sum()
    index = torch.unique(state.unit[rows], return_inverse=True)[1]
    body = RigidChips(mass, state.position[rows], velocity, affine, index, matter.dx)
    spin = body.spin()
    velocity = body.velocities(body.arm, body.speed, spin).to(velocity)
    affine = _cross(spin)[index].to(affine)
    lost = before - kinetic_energy(mass, velocity, affine, matter.dx) + stored
    return state._replace(
        particles=p.unstrained(rows).replace(
            velocity=p.velocity.index_copy(0, rows, velocity),
            affine=p.affine.index_copy(0, rows, affine),
        ),
        dissipated=state.dissipated + lost,
    )


class RigidChips:
    """Many small rigid bodies at once, in float64.

    Args:
        mass: Masses [kg], [M].
        position: Positions [m], float64 [M, 3].
        velocity: Velocities [m/s], [M, 3].
        affine: APIC velocity gradients [1/s], [M, 3, 3].
        index: Chip of each point, int64 [M], from 0.
        dx: Grid spacing [m]; an APIC point turns like a blob with second moment dx^2 / 4.
    """

    def __init__(
        self, mass: Tensor, position: Tensor, velocity: Tensor, affine: Tensor, index: Tensor,
        dx: float,
    ) -> None:  # fmt: skip
        self.index, self._mass = index, mass.double()
        weight = self._mass[:, None]
        sizes = torch.bincount(index)
        wide = 1 << (int(sizes.max()) - 1).bit_length()
        number = torch.arange(wide, device=index.device)
        self._there = number < sizes[:, None]
        place = (torch.cumsum(sizes, 0) - sizes)[:, None] + number
        self._slots = torch.argsort(index, stable=True)[place.clamp(max=len(index) - 1)]
        self.mass = self._sum(self._mass)
        self.center = self._sum(weight * position) / self.mass[:, None]
        self.speed = self._sum(weight * velocity.double()) / self.mass[:, None]
        self.arm = position - self.center[index]
        c = affine.double()
        curl = torch.stack(
            [c[:, 2, 1] - c[:, 1, 2], c[:, 0, 2] - c[:, 2, 0], c[:, 1, 0] - c[:, 0, 1]], dim=1
        )
        turning = torch.linalg.cross(self.arm, velocity.double() - self.speed[index])
        self.momentum = self._sum(weight * (turning + 0.25 * dx * dx * curl))
        square = self.arm[:, :, None] * self.arm[:, None]
        square = self._sum(weight[..., None] * square)
        eye = torch.eye(3, dtype=torch.float64, device=index.device)
        trace = square.diagonal(dim1=1, dim2=2).sum(dim=1)
        trace = trace + 0.5 * dx * dx * self.mass
        self.inertia = trace[:, None, None] * eye - square
        self._ease = torch.linalg.inv(self.inertia)

    def _sum(self, values: Tensor) -> Tensor:
        """Sums over the points of each chip by halves: in a fixed order, in few calls."""
        there = self._there.view(*self._there.shape, *[1] * (values.dim() - 1))
        held = torch.where(there, values[self._slots], 0.0)
        while held.shape[1] > 1:
            first, second = held.chunk(2, dim=1)
            held = first + second
        return held[:, 0]

    def spin(self, rotation: Tensor | None = None) -> Tensor:
        """Angular velocity of each after a rotation [C, 3, 3] of it [rad/s], [C, 3]."""
        momentum = self.momentum[..., None]
        if rotation is None:
            return (self._ease @ momentum)[..., 0]
        return (rotation @ (self._ease @ (rotation.transpose(1, 2) @ momentum)))[..., 0]

    def velocities(self, arm: Tensor, speed: Tensor, spin: Tensor) -> Tensor:
        """Velocities of the points with these arms [m/s], [M, 3]."""
        return speed[self.index] + torch.linalg.cross(spin[self.index], arm)

    def rotation(self, span: float) -> Tensor:
        """The turn in a time without a torque, [C, 3, 3], by the midpoint rule."""
        spin = self.spin()
        angle = float(spin.norm(dim=1).max()) * span
        steps = min(max(1, math.ceil(angle / _TURN)), _TURNS)
        step = span / steps
        turn = torch.eye(3, dtype=spin.dtype, device=spin.device).expand(len(spin), 3, 3)
        for _ in range(steps):
            half = _turns(0.5 * step * self.spin(turn)) @ turn
            turn = _turns(step * self.spin(half)) @ turn
        return turn


def _turns(vector: Tensor) -> Tensor:
    """Rotations [C, 3, 3] by ``|v|`` radians about ``v`` (Rodrigues)."""
    angle = vector.norm(dim=1)[:, None, None]
    cross = _cross(vector)
    small = angle < 1e-4
    safe = torch.where(small, 1.0, angle)
    first = torch.where(small, 1.0 - angle**2 / 6.0, torch.sin(safe) / safe)
    second = torch.where(small, 0.5 - angle**2 / 24.0, (1.0 - torch.cos(safe)) / safe**2)
    eye = torch.eye(3, dtype=vector.dtype, device=vector.device)
    return eye + first * cross + second * (cross @ cross)


def _cross(vector: Tensor) -> Tensor:
    """``[v]_x`` of vectors [C, 3], [C, 3, 3]."""
    x, y, z = vector.unbind(dim=1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=1).reshape(-1, 3, 3)


class Tumbled(NamedTuple):
    """What :func:`tumble` found.

    Attributes:
        position: Positions of the points of chips [m], float64 [M, 3].
        velocity: Velocities [m/s], float64 [M, 3].
        affine: Velocity gradients [1/s], float64 [M, 3, 3].
        turn: Rotation since the start, float64 [M, 3, 3].
        impulse: Of the colliders on the chips [N s], float64 [3].
        work: Most energy that moving colliders can have given [J], float64 [].
    """

    position: Tensor
    velocity: Tensor
    affine: Tensor
    turn: Tensor
    impulse: Tensor
    work: Tensor


def tumble(
    chips: RigidChips, span: float, gravity: Tensor, colliders: Tensor, sdf: Tensor | None
) -> Tumbled:
    """Let chips fly for a time; where they meet a collider they lose what goes into it.

    The deepest point of a chip decides: the chip is put back to the surface, its velocity into the
    collider goes (restitution 0), the one along it by Coulomb's law, and it stops turning, as it
    lies. A chip at rest stays at rest so.

    Args:
        chips: The chips at the start.
        span: Time [s].
        gravity: Acceleration [m/s^2], float64 [3].
        colliders: Rows of the colliders at the end, float64 [M, 32].
        sdf: Values of their distance grids.
    """
    index, count = chips.index, chips.mass.shape[0]
    pull = gravity.to(chips.center)
    speed = chips.speed + span * pull
    center = chips.center + 0.5 * span * (chips.speed + speed)
    turn = chips.rotation(span)
    spin = chips.spin(turn)
    arm = (turn[index] @ chips.arm[..., None])[..., 0]
    impulse, work = torch.zeros_like(pull), pull.new_zeros(())
    for row in colliders:
        if int(row[columns.TYPE]) == columns.TYPES["nothing"]:
            continue
        distance, normal = ops.collider_distance(center[index] + arm, row[None].double(), sdf)
        depth = distance[:, 0]
        least = depth.new_full((count,), math.inf).scatter_reduce(0, index, depth, "amin")
        meets = least <= 0.0
        if not bool(meets.any()):
            continue
        # Of several points as deep the first one: writing in reverse order has no race.
        deepest = torch.full_like(index[:1].expand(count), index.shape[0]).scatter_reduce(
            0, index[depth == least[index]], (depth == least[index]).nonzero()[:, 0], "amin"
        )
        out = normal[deepest.clamp(max=index.shape[0] - 1), 0]
        driven = row[columns.VELOCITY : columns.VELOCITY + 3].double()
        into = speed - driven
        along = (into * out).sum(dim=1, keepdim=True)
        across = into - along * out
        slip = across.norm(dim=1, keepdim=True)
        grip = row[columns.FRICTION].double() * (-along).clamp(min=0.0)
        if int(row[columns.MODE]) == columns.MODES["sticky"]:
            across = torch.zeros_like(across)
        else:
            across = across * (1.0 - grip / slip.clamp(min=1e-30)).clamp(min=0.0)
        after = driven + across + along.clamp(min=0.0) * out
        after = torch.where(meets[:, None], after, speed)
        given = (chips.mass[:, None] * (after - speed)).sum(dim=0)
        impulse = impulse + given
        work = work + (given * driven).sum().clamp(min=0.0)
        speed = after
        center = center - torch.where(meets, least, 0.0)[:, None] * out
        spin = torch.where(meets[:, None], 0.0, spin)
    return Tumbled(
        center[index] + arm,
        chips.velocities(arm, speed, spin),
        _cross(spin)[index],
        turn[index],
        impulse,
        work,
    )


def drift(
    position: Tensor,
    velocity: Tensor,
    mass: Tensor,
    rows: Tensor,
    span: float,
    gravity: tuple[float, float, float],
    floor: float | None,
) -> Tensor:
    """Let loose debris fall, in place; they stay where they meet the floor.

    Args:
        position: Positions of all points [m], float64 [N, 3]; rows of debris are written.
        velocity: Velocities of all points [m/s], [N, 3]; likewise.
        mass: Masses [kg], [N].
        rows: Rows of the debris, int64 [S].
        span: Time [s].
        gravity: Acceleration [m/s^2].
        floor: Height of the floor [m], or None.

    Returns:
        The impulse of the floor on the debris [N s], float64 [3].
    """
    pull = torch.tensor(gravity, dtype=torch.float64, device=position.device)
    start = velocity[rows].double()
    speed = start + span * pull
    place = position[rows] + span * (0.5 * (start + speed))
    impulse = torch.zeros(3, dtype=torch.float64, device=position.device)
    if floor is not None:
        down = place[:, 2] <= floor
        stop = torch.where(down[:, None], speed, torch.zeros_like(speed))
        impulse = -(mass[rows, None].double() * stop).sum(dim=0)
        speed = speed - stop
        place[:, 2] = place[:, 2].clamp(min=floor)
    position[rows] = place
    velocity[rows] = speed.to(velocity)
    return impulse
