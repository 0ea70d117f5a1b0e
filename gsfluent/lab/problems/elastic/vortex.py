"""Manufactured motions: the generalised vortex, with the body force that makes it exact."""

from __future__ import annotations

import math
from collections.abc import Iterator

import torch
from torch import Tensor

from gsfluent.lab.world.driver import World
from gsfluent.lab.world.registry import Result, compare, problem
from gsfluent.lab.world.shapes import box, parameters
from gsfluent.lab.world.walls import PLANE_STRAIN


class Vortex:
    """Every ring of radius R turns by ``alpha(R, t) = A sin(pi t / T) (1 - 16 (R - 1)^2)^2``.

    Rings outside [0.75, 1.25] rest, and are held at rest: a free ring would be turned as a whole by
    the sum of the small errors of a large force. The body force for the neo-Hookean law of gsfluent
    is derived in solver.md, row 5 (checked there to 1e-10). Motion: Kamojjala et al. 2015.
    """

    young, poisson, density = 1000.0, 0.3, 1000.0

    def __init__(self, amplitude: float, period: float):
        self.amplitude, self.period = amplitude, period

    def _profile(self, radius: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        s = (radius - 1.0).clamp(-0.25, 0.25)
        hill = 1.0 - 16.0 * s * s
        return hill**2, -64.0 * s * hill, -64.0 + 3072.0 * s * s

    def angle(self, radius: Tensor, time: float) -> Tensor:
        """Angle each ring has turned by [rad]."""
        return self.amplitude * math.sin(math.pi * time / self.period) * self._profile(radius)[0]

    def place(self, start: Tensor, time: float) -> Tensor:
        """Where the points that start at ``start`` are at ``time`` [m]."""
        alpha = self.angle(start[:, :2].norm(dim=1), time)
        c, s = torch.cos(alpha), torch.sin(alpha)
        x, y = start[:, 0], start[:, 1]
        return torch.stack([c * x - s * y, s * x + c * y, start[:, 2]], dim=1)

    def velocity(self, start: Tensor) -> tuple[Tensor, Tensor]:
        """Velocity [m/s] and its gradient [1/s] at time 0."""
        radius = start[:, :2].norm(dim=1)
        hill, slope, _ = self._profile(radius)
        rate = self.amplitude * math.pi / self.period
        x, y = start[:, 0], start[:, 1]
        v = torch.stack([-y * hill, x * hill, torch.zeros_like(x)], dim=1) * rate
        gradient = torch.zeros(start.shape[0], 3, 3, dtype=start.dtype)
        gradient[:, 0, 1], gradient[:, 1, 0] = -hill, hill
        outward = torch.stack([x / radius, y / radius], dim=1)
        gradient[:, 0, :2] -= (y * slope)[:, None] * outward
        gradient[:, 1, :2] += (x * slope)[:, None] * outward
        return v, gradient * rate

    def acceleration(self, start: Tensor, time: float) -> Tensor:
        """Body force per mass [m/s^2] on the points that started at ``start``.

        It belongs to the material point and not to the place where the point happens to be: a
        force that follows from the place is itself unstable, since it varies faster over a
        displacement than the elastic force does.
        """
        exact = self.place(start, time)
        x, y = exact[:, 0], exact[:, 1]
        radius = torch.sqrt(x * x + y * y)
        hill, slope, bend = self._profile(radius)
        bend = torch.where((radius - 1.0).abs() < 0.25, bend, torch.zeros_like(bend))
        phase, turn = math.pi * time / self.period, math.pi / self.period
        now, rate = self.amplitude * math.sin(phase), self.amplitude * turn * math.cos(phase)
        a1, a2 = now * slope, now * bend
        spin, spun = rate * hill, -now * turn * turn * hill  # first and second time derivative
        stiff = self.young / (2.0 * (1.0 + self.poisson)) / self.density
        radial = -radius * spin**2 + stiff * (
            radius * a1**2 + (2.0 * radius * a1**2 + 2.0 * radius**2 * a1 * a2) / 3.0
        )
        around = radius * spun - stiff * (3.0 * a1 + radius * a2)
        push = torch.zeros_like(exact)
        push[:, 0] = (radial * x - around * y) / radius
        push[:, 1] = (radial * y + around * x) / radius
        return push

    def run(
        self, cells: int, until: float, per_cell: int = 2, dtype: torch.dtype = torch.float64
    ) -> tuple[float, float]:
        """Run one layer of points with ``cells`` cells per metre to ``until``.

        Returns:
            Root mean square and largest distance from the exact place [m], inside the vortex.
        """
        dx = 1.0 / cells
        spacing = dx / per_cell
        points = box([-1.5, -1.5, 0.0], [3.0, 3.0, spacing], spacing)
        radius = points[:, :2].norm(dim=1)
        points = points[(radius > 0.75 - 3.0 * dx) & (radius < 1.25 + 3.0 * dx)]
        radius = points[:, :2].norm(dim=1)
        held = (radius <= 0.75) | (radius >= 1.25)
        velocity, affine = self.velocity(points)
        volume = spacing**3

        def push(world: World, dt: float) -> None:
            push = self.acceleration(points, world.time).to(world.velocity)
            rest = held.to(push.device)[:, None]
            world.velocity = (world.velocity + dt * push).masked_fill(rest, 0.0)
            world.affine = world.affine.masked_fill(rest[:, None], 0.0)

        world = World(
            points, velocity, affine=affine, volume=volume, dx=dx,
            law=0, params=parameters(self.young, self.poisson, self.density), dtype=dtype,
            colliders=[PLANE_STRAIN], force=push, cfl=0.4,
        )  # fmt: skip
        world.run(until)
        far = (world.position.double().cpu() - self.place(points, until))[~held].norm(dim=1)
        return float(far.square().mean().sqrt()), float(far.max())


def results(amplitude: float, sizes: tuple[int, int], per_cell: int) -> Iterator[Result]:
    """Order and size of the error after the whole swing out and back."""
    errors = [Vortex(amplitude, 1.0).run(n, 1.0, per_cell)[0] / amplitude for n in sizes]
    order = math.log(errors[0] / errors[1]) / math.log(sizes[1] / sizes[0])
    shear = 6.16 * amplitude
    stretch = 0.5 * (shear + math.hypot(shear, 2.0)) / per_cell
    note = (
        f"shear up to {shear:.2f}, {per_cell} points per cell and axis: stretched spacing at most "
        f"{stretch:.2f} dx; above dx the body tears (numerical fracture)"
    )
    yield compare(
        f"order after a swing, {sizes[0]} to {sizes[1]} cells/m", order, 2.0,
        error=max(0.0, 2.0 - order), tolerance=0.3,
        source="generalised vortex (solver.md 3, row 5)", note=note,
    )  # fmt: skip
    yield compare(
        f"rms distance over the swing, {sizes[1]} cells/m", errors[1], tolerance=0.05,
        source="exact motion", note=f"{errors[0]:.4f} at {sizes[0]} cells/m",
    )  # fmt: skip


@problem(tier="fast")
def vortex() -> Iterator[Result]:
    """Generalised vortex, shear up to 1.2: order of convergence."""
    return results(0.2, (16, 32), 2)


@problem(tier="slow")
def vortex_large() -> Iterator[Result]:
    """Generalised vortex of the literature, shear up to 6: order of convergence."""
    return results(1.0, (12, 20), 8)
