"""Free flight: a body that touches nothing moves as a rigid body, exactly, without a grid.

Before its first contact a body has no strain, so gravity and spin are all there is; a piece that
has come to rest inside may go back to it. The centre of mass follows the parabola ``x0 + v0 t + g
t^2 / 2`` in closed form; the orientation follows Euler's equations for a free rigid body with its
angular momentum held fixed.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gsfluent import geometry
from gsfluent.data import Particles

_ANGLE_STEP = 0.02
"""Largest turn per integration step of a tumbling body [rad]; the midpoint rule's error falls
with its square.
"""


class Flight:
    """The free flight of one body or piece.

    Attributes:
        speed_limit: Upper bound of the angular part of any point's speed [m/s].

    Args:
        particles: Its points.
        position: Their positions [m], float64 [M, 3].
        gravity: Acceleration [m/s^2], float64 [3].
        time: Time of the given state [s].
        dx: Grid spacing [m]; an APIC point turns like a blob with second moment dx^2 / 4.
        held: Time [s] until which the body waits where it is, its velocity kept for later.
        rigid: Whether the points move as a rigid body already; if not, the flight has their
            linear and angular momentum, and their motion against each other is lost.
    """

    def __init__(
        self,
        particles: Particles,
        position: Tensor,
        gravity: Tensor,
        time: float,
        dx: float,
        *,
        held: float = 0.0,
        rigid: bool = True,
    ) -> None:
        position, velocity = (v.to("cpu", torch.float64) for v in (position, particles.velocity))
        mass = particles.mass.to("cpu", torch.float64)[:, None]
        self.particles = particles
        self.gravity = gravity
        self.held = held
        self.start = max(time, held)
        total = mass.sum()
        self.mass = float(total)
        self.center = (mass * position).sum(dim=0) / total
        self.velocity = (mass * velocity).sum(dim=0) / total
        self.arm = position - self.center
        squared = (self.arm**2).sum(dim=1, keepdim=True)
        eye = torch.eye(3, dtype=torch.float64)
        self.inertia = (mass * squared).sum() * eye - (mass * self.arm).T @ self.arm
        self.inertia += 0.5 * dx * dx * total * eye
        if rigid:
            gradient = particles.affine[0].to("cpu", torch.float64)
            spin = torch.stack([gradient[2, 1], gradient[0, 2], gradient[1, 0]])
            self.momentum = self.inertia @ spin
        else:
            c = particles.affine.to("cpu", torch.float64)
            curl = (c[:, 2, 1] - c[:, 1, 2], c[:, 0, 2] - c[:, 2, 0], c[:, 1, 0] - c[:, 0, 1])
            turning = torch.linalg.cross(self.arm, velocity - self.velocity)
            self.momentum = (mass * (turning + 0.25 * dx * dx * torch.stack(curl, dim=1))).sum(0)
            spin = torch.linalg.solve(self.inertia, self.momentum)
        self.kinetic = 0.5 * self.mass * float(self.velocity @ self.velocity)
        self.kinetic += 0.5 * float(self.momentum @ spin)
        self.spins = bool(spin.abs().max() > 0)
        self._span = _ANGLE_STEP / max(float(spin.norm()), 1e-30)
        self._whole, self._turned = 0, eye
        self.radius = float(squared.max().sqrt())
        # Energy is kept, so a tumbling body never turns faster than all of it about one axis.
        least = float(torch.linalg.eigvalsh(self.inertia)[0])
        turning = max(float(self.momentum @ spin), 0.0)
        self.speed_limit = math.sqrt(turning / least) * self.radius
        self.low, self.high = self.arm.amin(dim=0), self.arm.amax(dim=0)

    def _omega(self, rotation: Tensor) -> Tensor:
        return rotation @ torch.linalg.solve(self.inertia, rotation.T @ self.momentum)

    def rotation_at(self, time: float) -> Tensor:
        """Return the turn since the start, [3, 3], by the midpoint rule on the rotation group.

        Whole steps are counted from the start, so the result does not depend on which times were
        asked for before.
        """
        if not self.spins:
            return self._turned
        time = max(time, self.start)
        whole = max(0, math.floor((time - self.start) / self._span))
        if whole < self._whole:
            self._whole, self._turned = 0, torch.eye(3, dtype=torch.float64)
        for _ in range(whole - self._whole):
            self._turned = self._advance(self._turned, self._span)
        self._whole = whole
        return self._advance(self._turned, (time - self.start) - whole * self._span)

    def _advance(self, rotation: Tensor, step: float) -> Tensor:
        half = _exponential(0.5 * step * self._omega(rotation)) @ rotation
        return _exponential(step * self._omega(half)) @ rotation

    def center_at(self, time: float) -> tuple[Tensor, Tensor]:
        """Return the centre of mass and its velocity at ``time``, float64 [3] each."""
        t = max(time - self.start, 0.0)
        return (
            self.center + t * self.velocity + 0.5 * t * t * self.gravity,
            self.velocity + t * self.gravity,
        )

    def speed_at(self, time: float) -> float:
        """Upper bound of the speed of any of its points [m/s]; 0 while it is held."""
        return float(self.center_at(time)[1].norm()) + self.speed_limit

    def bounds_at(self, time: float) -> tuple[Tensor, Tensor]:
        """Return a box that holds the body at ``time``; with spin, that of its bounding ball."""
        center, _ = self.center_at(time)
        if self.spins:
            return center - self.radius, center + self.radius
        return center + self.low, center + self.high

    def state_at(self, time: float) -> tuple[Particles, Tensor]:
        """Return the points at ``time``, and their positions in float64 [M, 3]."""
        center, velocity = self.center_at(time)
        like = self.particles
        device = like.position.device
        if not self.spins:
            place = (center + self.arm).to(device)
            still = like.replace(
                position=place.to(like.dtype),
                velocity=velocity.to(like.velocity).expand_as(like.velocity).contiguous(),
                affine=torch.zeros_like(like.affine),
            )
            return still, place
        rotation = self.rotation_at(time)
        omega = self._omega(rotation)
        arm = self.arm @ rotation.T
        gradient = _cross_matrix(omega)
        turn = rotation.to(like.affine)
        deformation = like.deformation
        if deformation is not None:
            deformation = (turn @ deformation).contiguous()
        strain = turn @ geometry.unpack_symmetric(like.strain) @ turn.T
        viscous = like.viscous
        if viscous is not None:
            spring = turn @ geometry.unpack_symmetric(viscous[:, :6]) @ turn.T
            viscous = torch.cat([geometry.pack_symmetric(spring), viscous[:, 6:]], dim=1)
        place = (center + arm).to(device)
        moved = like.replace(
            position=place.to(like.dtype),
            velocity=(velocity + arm @ gradient.T).to(like.velocity),
            affine=gradient.to(like.affine).expand_as(like.affine).contiguous(),
            strain=geometry.pack_symmetric(strain),
            deformation=deformation,
            viscous=viscous,
        )
        return moved, place


class Queue(Flight):
    """Liquid that waits in its nozzle: it moves on with one velocity, out of gravity's reach.

    Args:
        particles: Its points.
        position: Their positions [m], float64 [M, 3].
        time: Time of the given state [s].
        dx: Grid spacing [m].
        held: Time [s] until which nothing flows.
    """

    def __init__(
        self, particles: Particles, position: Tensor, time: float, dx: float, *, held: float
    ) -> None:
        still = particles.replace(affine=torch.zeros_like(particles.affine))
        gravity = torch.zeros(3, dtype=torch.float64)
        super().__init__(still, position, gravity, time, dx, held=held)
        # It comes to the grid by leaving the nozzle, not by what is near.
        self.held = math.inf


def _cross_matrix(vector: Tensor) -> Tensor:
    """Return [v]_x with ``[v]_x a = v x a``, [3, 3]."""
    x, y, z = vector.unbind()
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)


def _exponential(vector: Tensor) -> Tensor:
    """Rotation [3, 3] by ``|v|`` radians about ``v`` (Rodrigues)."""
    angle = float(vector.norm())
    cross = _cross_matrix(vector)
    first = 1.0 - angle**2 / 6.0 if angle < 1e-4 else math.sin(angle) / angle
    second = 0.5 - angle**2 / 24.0 if angle < 1e-4 else (1.0 - math.cos(angle)) / angle**2
    return torch.eye(3, dtype=vector.dtype) + first * cross + second * (cross @ cross)
