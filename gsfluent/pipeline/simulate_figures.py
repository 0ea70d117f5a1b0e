"""The figures of a moment of a simulation: energies, momenta, damage.

All sums run in float64. The APIC matrix C of a point carries kinetic energy and angular momentum of
its own, with the kernel's second moment dx^2 / 4 (Jiang et al. 2015).
"""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.pipeline.particles import Matter


@dataclasses.dataclass(frozen=True)
class Figures:
    """Energies [J] and momenta of all bodies together.

    Args:
        kinetic: Kinetic energy.
        elastic: Stored elastic energy.
        gravity: Potential energy against height 0 along gravity.
        momentum: Linear momentum [N s].
        angular_momentum: Angular momentum about the origin [N m s].
        damaged_fraction: Share of the mass that is broken.
        alpha_max: Largest alpha so far.
        non_finite: Points with a value that is not finite.
    """

    kinetic: float
    elastic: float
    gravity: float
    momentum: tuple[float, float, float]
    angular_momentum: tuple[float, float, float]
    damaged_fraction: float
    alpha_max: float
    non_finite: int

    @property
    def total(self) -> float:
        """Mechanical energy [J]."""
        return self.kinetic + self.elastic + self.gravity


def measure(
    matter: Matter, position: Tensor, velocity: Tensor, affine: Tensor, strain: Tensor,
    peak: Tensor, gravity: tuple[float, float, float],
) -> Figures:  # fmt: skip
    """Sum the figures of one state; see :class:`Figures`. Tensors are [N, ...] in SI units."""
    particles = matter.particles
    wide = torch.float64
    x, v, c = position.to(wide), velocity.to(wide), affine.to(wide)
    mass, volume = particles.mass.to(wide), particles.volume.to(wide)
    second = 0.25 * matter.dx**2
    kinetic = 0.5 * (mass * ((v**2).sum(dim=1) + second * (c**2).sum(dim=(1, 2)))).sum()
    density = ops.elastic_energy(
        strain, law=matter.law, params=matter.params, material=particles.material
    )
    elastic = (density.to(wide) * volume).sum()
    pull = torch.tensor(gravity, dtype=wide, device=x.device)
    potential = -(mass * (x @ pull)).sum()
    momentum = (mass[:, None] * v).sum(dim=0)
    skew = torch.stack([c[:, 2, 1] - c[:, 1, 2], c[:, 0, 2] - c[:, 2, 0], c[:, 1, 0] - c[:, 0, 1]])
    turning = (mass[:, None] * (torch.linalg.cross(x, v) + second * skew.T)).sum(dim=0)
    damaged = (mass * (peak >= 0)).sum() / mass.sum()
    finite = torch.isfinite(x).all(dim=1) & torch.isfinite(v).all(dim=1)
    finite &= torch.isfinite(strain).all(dim=1) & torch.isfinite(peak)
    values = torch.cat(
        [
            torch.stack([kinetic, elastic, potential]),
            momentum,
            turning,
            torch.stack([damaged, peak.max().to(wide), (~finite).sum().to(wide)]),
        ]
    ).tolist()
    return Figures(
        kinetic=values[0],
        elastic=values[1],
        gravity=values[2],
        momentum=(values[3], values[4], values[5]),
        angular_momentum=(values[6], values[7], values[8]),
        damaged_fraction=values[9],
        alpha_max=values[10],
        non_finite=int(values[11]),
    )
