"""Axis-aligned manufactured motion in three dimensions (Wallstedt and Guilkey 2008)."""

from __future__ import annotations

import math
from collections.abc import Iterator

import torch
from torch import Tensor

from gsfluent.lab.world.driver import World
from gsfluent.lab.world.registry import Result, compare, problem
from gsfluent.lab.world.shapes import box, moduli, parameters

YOUNG, POISSON, DENSITY = 1.0, 0.3, 1.0
PHASES = (0.0, 2.0 * math.pi / 3.0, 4.0 * math.pi / 3.0)


class Axes:
    """Every point swings along each axis, ``u_i = A sin(2 pi X_i) sin(w t + phi_i)``, periodic."""

    def __init__(self, amplitude: float):
        self.amplitude, self.rate = amplitude, math.pi

    def _swing(self, time: float, turn: float = 0.0) -> Tensor:
        return torch.tensor(
            [math.sin(self.rate * time + phase + turn) for phase in PHASES], dtype=torch.float64
        )

    def place(self, start: Tensor, time: float) -> Tensor:
        """Where the points are [m]."""
        wave = torch.sin(2.0 * math.pi * start)
        return start + self.amplitude * wave * self._swing(time)

    def stretch(self, start: Tensor, time: float) -> Tensor:
        """Stretches along the axes, [N, 3]."""
        slope = 2.0 * math.pi * torch.cos(2.0 * math.pi * start)
        return 1.0 + self.amplitude * slope * self._swing(time)

    def velocity(self, start: Tensor, time: float) -> tuple[Tensor, Tensor]:
        """Velocity [m/s] and its spatial gradient's diagonal [1/s]."""
        size = self.amplitude * self.rate * self._swing(time, 0.5 * math.pi)
        slope = 2.0 * math.pi * torch.cos(2.0 * math.pi * start) * size
        return torch.sin(2.0 * math.pi * start) * size, slope / self.stretch(start, time)

    def push(self, start: Tensor, time: float) -> Tensor:
        """Body force per mass: acceleration less the divergence of the first Piola stress.

        ``P_ii = tau_i / F_i``, ``tau_i = mu J^(-2/3) (F_i^2 - tr/3) + kappa/2 (J^2 - 1)``; along
        axis i only F_i varies.
        """
        mu, kappa = moduli(YOUNG, POISSON)
        f = self.stretch(start, time)
        j = f.prod(dim=1, keepdim=True)
        soft = mu * j ** (-2.0 / 3.0)
        deviator = f**2 - (f**2).sum(dim=1, keepdim=True) / 3.0
        tau = soft * deviator + 0.5 * kappa * (j**2 - 1.0)
        change = soft * (4.0 * f / 3.0 - 2.0 / (3.0 * f) * deviator) + kappa * j**2 / f
        piola = change / f - tau / f**2
        u = self.place(start, time) - start
        bend = -(4.0 * math.pi**2) * u  # dF_i / dX_i
        return -(self.rate**2) * u - piola * bend / DENSITY

    def run(self, cells: int, until: float) -> float:
        """Root mean square distance from the exact place at ``until`` [m]."""
        dx = 1.0 / cells
        start = box([0.0, 0.0, 0.0], [1.0, 1.0, 1.0], 0.5 * dx)
        f = self.stretch(start, 0.0)
        strain = torch.cat([f**2 - 1.0, torch.zeros_like(f)], dim=1)
        steps = math.ceil(until / (0.3 * dx))  # the wave is 1.16 m/s fast
        dt = until / steps
        # velocities of symplectic Euler belong to the half step before
        velocity, slope = self.velocity(start, -0.5 * dt)
        volume = (0.5 * dx) ** 3

        def force(world: World, dt: float) -> None:
            world.velocity = world.velocity + dt * self.push(start, world.time).to(world.velocity)

        world = World(
            self.place(start, 0.0), velocity, affine=torch.diag_embed(slope), strain=strain,
            volume=volume, dx=dx, law=0, dt=dt, force=force,
            params=parameters(YOUNG, POISSON, DENSITY), period=(1.0, 1.0, 1.0),
        )  # fmt: skip
        world.run(steps=steps)
        far = world.position.double().cpu() - self.place(start, until)
        far = torch.remainder(far + 0.5, 1.0) - 0.5
        return float(far.square().sum(dim=1).mean().sqrt())


def results(amplitude: float, sizes: tuple[int, int], until: float) -> Iterator[Result]:
    """Order and size of the error."""
    scene = Axes(amplitude)
    errors = [scene.run(n, until) / amplitude for n in sizes]
    order = math.log(errors[0] / errors[1]) / math.log(sizes[1] / sizes[0])
    yield compare(
        f"order, {sizes[0]} to {sizes[1]} cells, amplitude {amplitude:g}", order, 2.0,
        error=max(0.0, 2.0 - order), tolerance=0.3,
        source="Wallstedt and Guilkey 2008; solver.md 3, row 4",
        note=f"rms error over amplitude {errors[0]:.4f}, {errors[1]:.4f}; points move up to "
        f"{amplitude * sizes[1]:.2f} cells; t = {until:g}",
    )  # fmt: skip


@problem(tier="fast")
def axis_aligned() -> Iterator[Result]:
    """Axis-aligned manufactured motion within a cell: order in three dimensions."""
    return results(0.01, (8, 12), 0.5)


@problem(tier="slow")
def axis_aligned_large() -> Iterator[Result]:
    """Axis-aligned manufactured motion through cells, stretches 0.7 to 1.3."""
    return results(0.05, (8, 16), 0.5)
