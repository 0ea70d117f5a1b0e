"""Elastic waves with known speeds: order, damping and arrival."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import torch

from gsfluent.lab.world.driver import World
from gsfluent.lab.world.registry import Result, compare, problem
from gsfluent.lab.world.shapes import box, parameters

LOSS = 0.0125
"""Amplitude lost per step over (k dx)^4 at 8 points per cell, as measured by an independent plain
C++ code (solver.md, finding 3)."""
BAR_YOUNG, BAR_DENSITY = 5e5, 1000.0


class Wave(NamedTuple):
    """A standing wave after some periods: errors relative to the amplitude, and what it lost."""

    displacement: float
    velocity: float
    loss: float
    steps: int


def run_wave(cells: int, periods: float, cfl: float = 0.2) -> Wave:
    """Run u = A sin(kx) sin(ckt) in a periodic bar with nu = 0, one wavelength long.

    The bar is one cell wide with free faces: without Poisson's effect every point of a cross
    section moves alike, so that this is the problem of one dimension. The velocity of symplectic
    Euler belongs to the half step before.
    """
    dx, k, amplitude = 1.0 / cells, 2.0 * math.pi, 1e-6
    points = box([0.0, 0.0, 0.0], [1.0, dx, dx], 0.5 * dx)
    start = points[:, 0]
    shape = torch.sin(k * start)
    velocity, affine = torch.zeros_like(points), points.new_zeros(points.shape[0], 3, 3)
    velocity[:, 0] = amplitude * k * shape
    affine[:, 0, 0] = amplitude * k * k * torch.cos(k * start)
    steps = round(periods / (cfl * dx))
    dt = periods / steps
    world = World(
        points, velocity, affine=affine, volume=0.125 * dx**3, dx=dx, law=0,
        params=parameters(1.0, 0.0, 1.0), dt=dt, period=(1.0, None, None),
    )  # fmt: skip
    shape = shape.to(world.position.device)

    def displacement() -> torch.Tensor:
        moved = world.position[:, 0] - start.to(world.position.device)
        return torch.remainder(moved + 0.5, 1.0) - 0.5

    def size() -> float:
        u = float((displacement() * shape).mean()) / amplitude
        v = float((world.velocity[:, 0] * shape).mean()) / (amplitude * k)
        return 2.0 * math.hypot(u, v)

    world.run(steps=1)
    first = size()
    world.run(steps=steps - 1)
    u = amplitude * shape * math.sin(k * periods)
    v = amplitude * k * shape * math.cos(k * (periods - 0.5 * dt))
    return Wave(
        float((displacement() - u).norm() / (amplitude * shape.norm())),
        float((world.velocity[:, 0] - v).norm() / (amplitude * k * shape.norm())),
        math.log(first / size()) / (steps - 1),
        steps,
    )


@problem(tier="fast")
def standing_wave() -> Iterator[Result]:
    """Standing wave in a periodic bar: order of the method and its numerical damping."""
    sizes = (16, 32, 64)
    waves = [run_wave(n, 1.0) for n in sizes]
    errors = [math.hypot(w.displacement, w.velocity) for w in waves]
    order = math.log(errors[0] / errors[-1]) / math.log(sizes[-1] / sizes[0])
    listed = ", ".join(f"{e:.4f}" for e in errors)
    yield compare(
        "order of (u, v) after a period, n = 16 to 64", order, 2.0, error=max(0.0, 2.0 - order),
        tolerance=0.3, source="u = A sin(kx) sin(ckt)",
        note=f"relative L2 errors {listed}; CFL 0.2",
    )  # fmt: skip
    wave = run_wave(16, 5.0)
    yield compare(
        "amplitude lost per step / (k dx)^4, n = 16", wave.loss / (2.0 * math.pi / 16) ** 4, LOSS,
        tolerance=0.3, source="solver.md 0.3 (measured, plain C++)", note=f"{wave.steps} steps",
    )  # fmt: skip


def push_bar(width: float) -> tuple[float, list[float], list[float]]:
    """Push the end of the bar of GaussianBench A3 by a half sine and watch the other end.

    Returns:
        Distance of the two ends [m], times [s] and mean displacement of the far end [m].
    """
    spacing, amplitude = 0.005, 1e-3
    points = box([0.0, -0.01, -0.01], [1.0, 0.02, 0.02], spacing)
    driven = points[:, 0] < spacing
    far = points[:, 0] > 0.98 * (1.0 - spacing) + 0.5 * spacing

    def push(world: World, dt: float) -> None:
        # the velocity that takes the face from where it is to where it should be
        mask = driven.to(world.position.device)
        after = world.time + dt
        target = amplitude * math.sin(math.pi * after / width) if after < width else 0.0
        here = world.position[mask, 0] - 0.5 * spacing
        velocity, affine = world.velocity.clone(), world.affine.clone()
        velocity[mask] = 0.0
        velocity[mask, 0] = (target - here) / dt
        affine[mask] = 0.0
        world.velocity, world.affine = velocity, affine

    world = World(
        points, [0.0, 0.0, 0.0], volume=spacing**3, dx=2 * spacing,
        law=0, params=parameters(BAR_YOUNG, 0.3, BAR_DENSITY), force=push,
    )  # fmt: skip
    times, moved = [0.0], [0.0]

    def watch(world: World) -> None:
        shift = (world.position.cpu()[far] - points[far].to(world.position.dtype)).norm(dim=1)
        times.append(world.time)
        moved.append(float(shift.mean()))

    world.run(0.045 + width, each=watch)
    return float(points[far, 0].mean()) - 0.5 * spacing, times, moved


def crossing(times: list[float], values: list[float], level: float) -> float:
    """First time at which values reach a level, interpolated; infinite if never."""
    for i in range(1, len(values)):
        if values[i] >= level:
            share = (level - values[i - 1]) / (values[i] - values[i - 1])
            return times[i - 1] + share * (times[i] - times[i - 1])
    return math.inf


@problem(tier="fast")
def bar_wave() -> Iterator[Result]:
    """Pulse through a thin bar (GaussianBench A3): speed of the wave in a bar."""
    exact = math.sqrt(BAR_YOUNG / BAR_DENSITY)
    travel, times, moved = push_bar(0.002)
    yield compare(
        "speed of the first arrival, push of 2 ms", travel / crossing(times, moved, 1e-5), exact,
        tolerance=0.15, unit="m/s", source="sqrt(E / rho); GaussianBench A3 and its measure",
        note="1 % of the push; a forerunner at 25.9 m/s, the wave of the bulk, is physical",
    )  # fmt: skip
    width = 0.01
    travel, times, moved = push_bar(width)
    # a half sine has half its height after a sixth of its width
    arrival = crossing(times, moved, 0.5 * max(moved)) - width / 6.0
    yield compare(
        "speed at half height, push of 10 ms", travel / arrival, exact, tolerance=0.03, unit="m/s",
        source="sqrt(E / rho)",
    )  # fmt: skip
