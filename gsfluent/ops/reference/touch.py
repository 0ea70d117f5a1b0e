"""Points of different bodies that push each other, in plain PyTorch: the definition, for tests.

Written from docs/theory/contact.md, "At a point", not from the kernels; run it in float64.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gsfluent.ops.reference.spring import DAMPING

STEP = 0.125  # largest (frequency times longest step)^2 of one point's spring

SLOPE = 315.0 / 256.0 * (1.0 - 0.25**2) ** 4  # of the share, a quarter of a cell outside


def kernel(distance: Tensor) -> Tensor:
    """W [1 / cells^3] at a distance in cells: ``315 / (64 pi) (1 - r^2)^3``, 0 from 1 on."""
    return 315.0 / (64.0 * math.pi) * (1.0 - distance**2).clamp(min=0.0) ** 3


def share(distance: Tensor) -> Tensor:
    """Share of a half space that W finds at a distance [cells] outside of it.

    Beyond 0.9 cells it goes on as a line.
    """
    s = distance.clamp(-0.9, 0.9)
    odd = s - 4.0 / 3.0 * s**3 + 6.0 / 5.0 * s**5 - 4.0 / 7.0 * s**7 + s**9 / 9.0
    return 0.5 - 315.0 / 256.0 * odd + (s - distance)


def touch_push(
    position: Tensor,
    velocity: Tensor,
    objects: Tensor,
    radius: Tensor,
    volume: Tensor,
    density: Tensor,
    wave: Tensor,
    dx: float,
    dt: float,
    longest: float,
) -> Tensor:
    """Impulse that every point gets in a step [N s], [N, 3].

    Args:
        position: [m], [N, 3].
        velocity: [m/s], [N, 3].
        objects: Number of the object of each point, [N].
        radius: Contact radius [m], [N].
        volume: [m^3], [N].
        density: [kg/m^3], [N].
        wave: Speed of P-waves [m/s], [N].
        dx: Node spacing [m].
        dt: Time step [s].
        longest: Longest time step [s].
    """
    cells = volume / dx**3
    x = (position / dx).requires_grad_()
    other = (objects[:, None] != objects[None, :]).to(position)
    away = x[:, None] - x[None, :]
    near = kernel((away.square().sum(-1) + 1e-300).sqrt()) * other
    found = near @ cells
    rate = (0.5 * wave**2 / (dx * volume ** (1.0 / 3.0))).clamp(max=STEP / longest**2)
    own = density * rate * dx**2 / SLOPE**2
    met = (near * (cells * own)[None, :]).sum(1) / torch.where(found > 0, found, 1.0)
    stiffness = torch.minimum(own, met).detach()
    # how fast the share grows, by the motion of both
    steep = -6.0 * 315.0 / (64.0 * math.pi) * (1.0 - away.square().sum(-1)).clamp(min=0.0) ** 2
    along = (away * (velocity[:, None] - velocity[None, :]) / dx).sum(-1)
    grows = ((steep * other * along) @ cells).detach()
    over = found.detach() - share(radius / dx)
    force = torch.where(over > 0, (over + DAMPING * dx / wave * grows).clamp(min=0.0), 0.0)
    energy = (cells * dx**3 * stiffness * force * found).sum()
    return -dt / dx * torch.autograd.grad(energy, x)[0]
