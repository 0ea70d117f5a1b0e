"""Cantilevers: frequency of small swings, bent and twisted, damping, large static deflection."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator

import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.lab.problems.elastic.statics import FACE
from gsfluent.lab.world.driver import World
from gsfluent.lab.world.registry import Result, compare, problem
from gsfluent.lab.world.shapes import box, parameters
from gsfluent.lab.world.walls import PLANE_STRAIN, wall

ROOT = 1.8751040687119611
"""First root of cos(x) cosh(x) = -1."""


def first_mode(s: Tensor) -> Tensor:
    """Shape of the first mode of a clamped-free beam at s in [0, 1], 1 at the end."""
    ratio = (math.cosh(ROOT) - math.cos(ROOT)) / (math.sinh(ROOT) + math.sin(ROOT))

    def shape(z: Tensor) -> Tensor:
        return torch.cosh(z) - torch.cos(z) - ratio * (torch.sinh(z) - torch.sin(z))

    return shape(ROOT * s) / shape(torch.tensor(ROOT, dtype=s.dtype))


def zeros(times: list[float], values: list[float]) -> list[float]:
    """Times at which a history passes zero, without its start."""
    found = []
    for i in range(1, len(times)):
        a, b = values[i - 1], values[i]
        if a * b < 0.0 or (b == 0.0 and a != 0.0):
            found.append(times[i - 1] + (times[i] - times[i - 1]) * a / (a - b))
    return found


def swing(cells: int, periods: float) -> tuple[float, float, float, int]:
    """Swing the beam of GaussianBench A2 (0.4 x 0.05 x 0.05 m, E 5e5, nu 0.3) from rest in shape.

    It is held behind x = 0 by the grid; the face it is clamped at lies :data:`FACE` behind.

    Returns:
        Frequency [Hz], its reference [Hz], damping ratio, steps.
    """
    height, young, density, tip = 0.05, 5e5, 1000.0, 0.05
    dx = height / cells
    spacing, length = 0.5 * dx, 0.4
    points = box([-1.5 * dx, 0.0, 0.0], [length + 1.5 * dx, height, height], spacing)
    free = length + FACE * dx
    exact = ROOT**2 / (2.0 * math.pi * free**2) * math.sqrt(young * height**2 / (12.0 * density))
    velocity = torch.zeros_like(points)
    velocity[:, 1] = tip * first_mode(((points[:, 0] + FACE * dx) / free).clamp(0.0, 1.0))
    world = World(
        points, velocity, volume=spacing**3, dx=dx, law=0,
        params=parameters(young, 0.3, density), colliders=[wall(0, mode="sticky")],
    )  # fmt: skip
    end = (points[:, 0] > 0.95 * length).to(world.position.device)
    rest = float(points[:, 1][points[:, 0] > 0.95 * length].mean())
    times, heights = [0.0], [0.0]

    def watch(world: World) -> None:
        times.append(world.time)
        heights.append(float(world.position[end, 1].mean()) - rest)

    world.run(periods / exact, each=watch)
    crossings = [0.0, *zeros(times, heights)]  # the first zero is the start itself
    halves = len(crossings) - 1
    frequency = 0.5 * halves / crossings[-1] if halves else 0.0
    peaks = [
        max(abs(h) for t, h in zip(times, heights, strict=True) if a <= t <= b)
        for a, b in itertools.pairwise(crossings)
    ]
    ratio = 0.0
    if len(peaks) > 1:
        ratio = math.log(peaks[0] / peaks[-1]) / (math.pi * (len(peaks) - 1))
    return frequency, exact, ratio, world.steps


TORSION = 0.140577
"""Torsion constant of a square over the fourth power of its edge (Saint-Venant)."""


def twist(cells: int, *, own: bool = False) -> tuple[float, float, int]:
    """Half a swing of the same beam about its axis, from rest in the shape of its first mode.

    Args:
        cells: Across it.
        own: With masses by :func:`gsfluent.ops.inertial_shares`; else all points weigh the same.

    Returns:
        Frequency [Hz], that of Saint-Venant's torsion [Hz], steps.
    """
    height, young, density, length = 0.05, 5e5, 1000.0, 0.4
    dx = height / cells
    spacing, middle = 0.5 * dx, 0.5 * height
    points = box([-1.5 * dx, 0.0, 0.0], [length + 1.5 * dx, height, height], spacing)
    free = length + FACE * dx
    exact = math.sqrt(6.0 * TORSION * young / (2.6 * density)) / (4.0 * free)
    arm = points[:, 1:] - middle
    turning = torch.sin(0.5 * math.pi * ((points[:, 0] + FACE * dx) / free).clamp(min=0.0))
    velocity = torch.zeros_like(points)
    velocity[:, 1:] = 1e-3 * turning[:, None] * torch.stack([-arm[:, 1], arm[:, 0]], dim=1)
    volume = torch.full_like(points[:, 0], spacing**3)
    shares = ops.inertial_shares(points, volume=volume, dx=dx) if own else 1.0
    world = World(
        points, velocity, volume=volume, mass=density * volume * shares, dx=dx, law=0,
        params=parameters(young, 0.3, density), colliders=[wall(0, mode="sticky")],
    )  # fmt: skip
    end = (points[:, 0] > 0.9 * length).to(world.position.device)
    start = world.position[end, 1:] - middle
    times, angles = [0.0], [0.0]

    def watch(now: World) -> None:
        moved = now.position[end, 1:] - middle - start
        times.append(now.time)
        angles.append(float((start[:, 0] * moved[:, 1] - start[:, 1] * moved[:, 0]).sum()))

    world.run(0.9 / exact, each=watch)
    return 0.5 / zeros(times, angles)[0], exact, world.steps


@problem(tier="slow")
def torsion() -> Iterator[Result]:
    """Half a swing of a square rod 4 cells across about its axis: frequency."""
    cells = 4
    frequency, exact, steps = twist(cells, own=True)
    few = []
    for fewer in (2, 3):
        found, true, _ = twist(fewer, own=True)
        few.append(f"{fewer} cells {found / true - 1.0:+.1%}")
    yield compare(
        f"frequency, {cells} cells across, own inertia", frequency, exact, tolerance=0.03,
        unit="Hz", source="Saint-Venant", note=f"{steps} steps; {', '.join(few)}",
    )  # fmt: skip
    # mass spread by dx^2 / 4 along both axes across turns along (docs/theory/mpm.md)
    frequency = twist(cells)[0]
    yield compare(
        f"frequency, {cells} cells across, with the inertia of the grid", frequency,
        exact / math.sqrt(1.0 + 3.0 / cells**2), tolerance=0.01, unit="Hz",
        source="mass spread by dx^2 / 4",
        note=f"points of the same mass; {frequency / exact - 1.0:+.1%} of Saint-Venant's",
    )  # fmt: skip


@problem(tier="slow")
def cantilever() -> Iterator[Result]:
    """Small swings of a cantilever 4 cells thick (GaussianBench A2): frequency and damping."""
    frequency, exact, ratio, steps = swing(4, 2.6)
    yield compare(
        "frequency, 4 cells thick", frequency, exact, tolerance=0.01, unit="Hz",
        source="Euler-Bernoulli; GaussianBench A2 allows 10 %", note=f"{steps} steps",
    )  # fmt: skip
    yield compare("damping ratio", ratio, tolerance=0.01, source="no damping (solver.md 12)")


@problem(tier="fast")
def cantilever_coarse() -> Result:
    """Half a swing of the cantilever, 3 cells thick: frequency."""
    frequency, exact, _, steps = swing(3, 0.6)
    return compare(
        "frequency, 3 cells thick, by half a period", frequency, exact, tolerance=0.05, unit="Hz",
        source="Euler-Bernoulli", note=f"{steps} steps",
    )  # fmt: skip


def elastica(load: float, slenderness: float = math.inf) -> tuple[float, float]:
    """Deflection of the end of a cantilever under a dead load across it, by shooting.

    A thin beam is Euler's elastica (Bisshopp and Drucker 1945 give the same by elliptic
    integrals); one of finite slenderness also shears and stretches (Reissner 1972; nu = 0, shear
    factor 5/6).

    Returns:
        Deflection across and shortening along, over the length.
    """
    count = 1000
    stretch, shear = load / (12.0 * slenderness**2), load / (5.0 * slenderness**2)

    def rates(theta: float, moment: float) -> tuple[float, float, float, float]:
        c, s = math.cos(theta), math.sin(theta)
        along, across = 1.0 + stretch * s, shear * c
        x, y = along * c - across * s, along * s + across * c
        return moment, -load * x, x, y

    def shoot(moment: float) -> tuple[float, float, float]:
        theta, x, y, step = 0.0, 0.0, 0.0, 1.0 / count
        for _ in range(count):  # midpoint rule
            turn, drop, _, _ = rates(theta, moment)
            turn, drop, dx, dy = rates(theta + 0.5 * step * turn, moment + 0.5 * step * drop)
            theta, moment = theta + step * turn, moment + step * drop
            x, y = x + step * dx, y + step * dy
        return moment, x, y

    low, high = 0.0, 2.0 * load
    for _ in range(50):
        guess = 0.5 * (low + high)
        low, high = (guess, high) if shoot(guess)[0] < 0.0 else (low, guess)
    _, x, y = shoot(0.5 * (low + high))
    return y, 1.0 - x


def bend(load: float) -> tuple[float, float, int]:
    """Bend a slab (nu = 0, plane) by a dead load on its end and let it come to rest.

    Returns:
        Deflection across and shortening along over the length, and the steps taken.
    """
    dx, young, density = 1.0 / 4, 1.0, 1.0
    spacing, length = dx / 6, 12.0
    points = box([-1.5 * dx, 0.0, 0.0], [length + 1.5 * dx, 1.0, spacing], spacing)
    free = length + FACE * dx
    volume = spacing**3
    force = load * young / (12.0 * free**2) * spacing  # of a slab one layer of points deep
    end = points[:, 0] > length - dx
    # mean of the loaded points: the load acts that far before the end
    arm = float(points[end, 0].mean()) + FACE * dx
    force *= (free / arm) ** 2
    count = int(end.sum())
    period = 2.0 * math.pi * free**2 / ROOT**2 * math.sqrt(12.0 * density / young)
    rate = 2.0 * math.pi / period * 2.0

    def pull(world: World, dt: float) -> None:
        rows = end.to(world.position.device)
        keep = 1.0 / (1.0 + rate * dt)
        velocity = world.velocity * keep
        share = min(1.0, world.time / (0.5 * period))
        velocity[rows, 1] += dt * share * force / (count * density * volume)
        world.velocity, world.affine = velocity, world.affine * keep

    world = World(
        points, [0.0, 0.0, 0.0], volume=volume, dx=dx, law=0,
        params=parameters(young, 0.0, density), force=pull, cfl=0.8,
        colliders=[wall(0, mode="sticky"), PLANE_STRAIN],
    ).run(1.5 * period)  # fmt: skip
    moved = (world.position.double().cpu() - points)[end].mean(0)
    return float(moved[1]) / arm, -float(moved[0]) / arm, world.steps


@problem(tier="slow")
def cantilever_large() -> Iterator[Result]:
    """Large deflection of a slender cantilever under a dead load.

    Points that cross cells under stress creep: the deflection keeps growing slowly while the strain
    does not. With 2, 4, 6 points per cell and axis it ends 12, 5, 3 % too large.
    """
    for load in (1.0, 2.0, 5.0):
        across, along = elastica(load, 12.0)
        got, shortened, steps = bend(load)
        yield compare(
            f"deflection over length, P L^2 / E I = {load:g}", got, across, tolerance=0.03,
            source="elastica with shear (Reissner 1972)",
            note=f"thin elastica {elastica(load)[0]:.4f}; 4 cells thick, L / h 12, 6 points per "
            f"cell and axis, {steps} steps; shortening {shortened:.3f} against {along:.3f}",
        )  # fmt: skip
