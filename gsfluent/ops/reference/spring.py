"""Rigid colliders that push points, in plain PyTorch: the definition, for tests.

Written from docs/theory/colliders.md, "At a point", not from the kernels; run it in float64.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gsfluent.ops.reference.collider import signed_distance

STEP = 0.25  # largest (frequency times longest step)^2
DEPTH = 1.0  # cells from which on the force does not grow
BRAKE, STOP = 0.5, 0.75  # cells between which a point comes to lose all of its approach at least
DAMPING = 0.1  # of a spring, in dx / wave speed
NODE = 1.25  # cells inside from which on nodes are held


def springs(row: Tensor) -> bool:
    """Whether a row is a collider that pushes points: separate, and nothing but a shape."""
    plain = bool((row[[14, 15, 30]] == 0).all())
    return int(row[0]) not in (-1, 6) and int(row[1]) == 2 and plain


def point_push(
    row: Tensor,
    sdf: Tensor | None,
    position: Tensor,
    radius: Tensor,
    mass: Tensor,
    wave: Tensor,
    length: Tensor,
    dx: float,
    dt: float,
    velocity: Tensor,
    longest: float,
) -> Tensor:
    """Impulse that a collider gives to points in a step [N s], [N, 3].

    Args:
        row: Of the collider, [32].
        sdf: Distance grids.
        position: [m], [N, 3].
        radius: Contact radius [m], [N].
        mass: What their volumes weigh at the density of their matter [kg], [N].
        wave: Speed of P-waves [m/s], [N].
        length: Cube root of the volume [m], [N].
        dx: Node spacing [m].
        dt: Time step [s].
        velocity: Of the points less that of the collider there [m/s], [N, 3].
        longest: Longest time step [s].
    """
    distance, normal = signed_distance(row, sdf, position)
    deep = radius - distance
    away = (velocity * normal).sum(-1)
    depth = torch.where(deep > 0, deep - DAMPING * dx / wave * away, 0.0).clamp(0.0, DEPTH * dx)
    rate = (wave**2 / (dx * length)).clamp(max=STEP / longest**2)
    stopped = -away * ((deep / dx - BRAKE) / (STOP - BRAKE)).clamp(0.0, 1.0)
    gained = (dt * (1.0 + row[31]) * rate * depth).maximum(stopped)
    return (mass * gained)[:, None] * normal


def node_friction(
    velocity: Tensor, own: Tensor, push: Tensor, limit: Tensor, mass: Tensor
) -> Tensor:
    """Velocities [..., 3] after Coulomb's friction of the impulse ``push`` [..., 3].

    Args:
        velocity: Of nodes [m/s].
        own: Of the collider there [m/s].
        push: Impulse of the springs at the nodes [N s].
        limit: Most that friction may give [N s], [...].
        mass: Of the nodes [kg], [...].
    """
    length = push.norm(dim=-1, keepdim=True)
    n = push / torch.where(length > 0, length, 1.0)
    u = velocity - own
    slip = u - (u * n).sum(-1, keepdim=True) * n
    speed = slip.norm(dim=-1)
    touches = (length[..., 0] > 0) & (speed > 0)
    safe = torch.where(touches, speed, 1.0)
    taken = torch.minimum(limit / torch.where(mass > 0, mass, 1.0), speed) / safe
    return velocity - torch.where(touches, taken, 0.0)[..., None] * slip
