"""Elastic bodies in free flight, whose motion is known in closed form."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from .registry import case
from .run import Measure, Run
from .scene import Floats, Scene

__all__ = ["bar", "ball", "box", "pull_apart", "spin"]


def box(lower: Sequence[float], size: Sequence[float], dx: float, per_cell: int) -> Floats:
    """Points of a cubic lattice at the centres of the cells that fill a box, [N, 3].

    Args:
        lower: Lower corner [m].
        size: Edge lengths [m], rounded to whole numbers of spacings.
        dx: Node spacing [m].
        per_cell: Points per cell: 1, 8, 27 or 64.
    """
    spacing = dx / round(per_cell ** (1.0 / 3.0))
    axes = [
        low + (np.arange(max(1, round(edge / spacing))) + 0.5) * spacing
        for low, edge in zip(lower, size, strict=True)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def ball(radius: float, dx: float, per_cell: int) -> Floats:
    """Points of the lattice of :func:`box` inside a ball about the origin, [N, 3]."""
    spacing = dx / round(per_cell ** (1.0 / 3.0))
    half = math.ceil(radius / spacing) * spacing
    points = box([-half] * 3, [2.0 * half] * 3, dx, per_cell)
    return points[np.linalg.norm(points, axis=1) <= radius]


def free(
    name: str,
    points: Floats,
    velocity: Floats,
    dx: float,
    per_cell: int,
    times: Floats,
    material: dict[str, Any],
    *,
    affine: Floats | None = None,
    body: Floats | None = None,
    volume: float | None = None,
    **facts: float,
) -> Scene:
    """A scene of one material without walls or weight."""
    n = points.shape[0]
    return Scene(
        name=name, dx=dx, x=points, v=np.array(np.broadcast_to(velocity, (n, 3))),
        volume=np.full(n, dx**3 / per_cell if volume is None else volume),
        material=np.zeros(n, np.int32),
        body=np.zeros(n, np.int32) if body is None else body.astype(np.int32),
        affine=np.zeros((n, 3, 3)) if affine is None else affine,
        times=times, materials=(material,), facts=facts,
    )  # fmt: skip


_BAR: dict[str, Any] = {
    "law": "elastic",
    "young_modulus": 1e5,
    "poisson_ratio": 0.0,
    "density": 1000.0,
}
_LENGTH, _SPEED, _PERIODS = 1.0, 1e-3, 3.0


def _judge_bar(scene: Scene, run: Run) -> Iterator[Measure]:
    shape = np.cos(math.pi * scene.x[:, 0] / _LENGTH)
    size = float((shape * shape).sum())
    seen = (run.v[:, :, 0] * shape).sum(axis=1) / size / scene.facts["speed"]
    omega = float(scene.facts["omega"])
    exact = np.cos(omega * scene.times)
    error = float(np.sqrt(np.mean((seen - exact) ** 2) / np.mean(exact**2)))
    source = "v = V cos(pi x / L) cos(pi c t / L), c = sqrt(E / rho)"
    yield Measure("velocity of the first mode, relative rms", error, 0.0, error, 0.1, "", source)
    energy = 2.0 * float(np.mean(seen[-(len(seen) // 3) :] ** 2))
    yield Measure(
        "energy of the mode in the last period", energy, 1.0, abs(energy - 1.0), 0.2, "", source
    )


@case(kind="elastic", dx=1 / 24, ladder=(1 / 8, 1 / 12, 1 / 16, 1 / 24, 1 / 32), judge=_judge_bar)
def bar(dx: float, per_cell: int) -> Scene:
    """Free bar vibrating along itself: speed of the wave, dispersion and damping."""
    thick = 0.25 * _LENGTH
    points = box([0.0, -0.5 * thick, -0.5 * thick], [_LENGTH, thick, thick], dx, per_cell)
    c = math.sqrt(float(_BAR["young_modulus"]) / float(_BAR["density"]))
    speed, k = _SPEED * c, math.pi / _LENGTH
    velocity = np.zeros_like(points)
    velocity[:, 0] = speed * np.cos(k * points[:, 0])
    affine = np.zeros((points.shape[0], 3, 3))
    affine[:, 0, 0] = -speed * k * np.sin(k * points[:, 0])
    omega = k * c
    times = np.linspace(0.0, _PERIODS * 2.0 * math.pi / omega, 61)[1:]
    return free(
        "bar", points, velocity, dx, per_cell, times, _BAR, affine=affine, speed=speed, omega=omega
    )


_RADIUS, _OMEGA, _TURNS = 0.05, 4.0, 1.0


def _judge_spin(scene: Scene, run: Run) -> Iterator[Measure]:
    mass = scene.mass[:, None]

    def angular(x: Floats, v: Floats) -> float:
        arm = x - (mass * x).sum(axis=0) / mass.sum()
        return float((mass * np.cross(arm, v)).sum(axis=0)[2])

    start = angular(scene.x, scene.v)
    turn = float(scene.facts["omega"]) * float(scene.times[-1])
    c, s = math.cos(turn), math.sin(turn)
    exact = scene.x @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]).T
    error = float(np.sqrt(np.mean(((run.x[-1] - exact) ** 2).sum(axis=1))))
    error /= float(scene.facts["radius"])
    source = "rigid rotation; GaussianBench A1"
    yield Measure("distance from a rigid turn over the radius", error, 0.0, error, 0.1, "", source)
    left = angular(run.x[-1], run.v[-1]) / start
    yield Measure("angular momentum left", left, 1.0, abs(left - 1.0), 0.02, "", source)


@case(
    kind="elastic", dx=0.02, ladder=(0.05 / 1.5, 0.025, 0.02, 0.05 / 3, 0.0125), judge=_judge_spin
)
def spin(dx: float, per_cell: int) -> Scene:
    """Elastic ball turning in empty space: one whole turn."""
    points = ball(_RADIUS, dx, per_cell)
    turn = np.array([[0.0, -_OMEGA, 0.0], [_OMEGA, 0.0, 0.0], [0.0, 0.0, 0.0]])
    material: dict[str, Any] = {
        "law": "elastic",
        "young_modulus": 1e5,
        "poisson_ratio": 0.3,
        "density": 1000.0,
    }
    times = np.linspace(0.0, _TURNS * 2.0 * math.pi / _OMEGA, 21)[1:]
    return free(
        "spin", points, points @ turn.T, dx, per_cell, times, material,
        affine=np.broadcast_to(turn, (points.shape[0], 3, 3)).copy(), radius=_RADIUS, omega=_OMEGA,
    )  # fmt: skip


def _judge_apart(scene: Scene, run: Run) -> Iterator[Measure]:
    second = scene.body == 1
    mass = scene.mass[second]
    kept = float((mass * run.v[-1][second, 0]).sum() / mass.sum()) / float(scene.facts["speed"])
    yield Measure(
        "speed kept by a block that leaves another", kept, 1.0, abs(kept - 1.0), 1e-3, "",
        "free flight",
    )  # fmt: skip


@case(kind="contact", dx=0.01, ladder=(0.02, 0.01, 0.005), judge=_judge_apart)
def pull_apart(dx: float, per_cell: int) -> Scene:
    """Two touching blocks that leave each other at a hundredth of the wave speed."""
    edge = 0.04
    left = box([-edge, 0.0, 0.0], [edge] * 3, dx, per_cell)
    right = box([0.0, 0.0, 0.0], [edge] * 3, dx, per_cell)
    material: dict[str, Any] = {
        "law": "elastic",
        "young_modulus": 1e5,
        "poisson_ratio": 0.2,
        "density": 1000.0,
    }
    body = np.repeat(np.array([0, 1]), [left.shape[0], right.shape[0]])
    speed = 0.01 * math.sqrt(1e5 * 0.8 / (1.2 * 0.6) / 1000.0)
    velocity = np.zeros((body.shape[0], 3))
    velocity[:, 0] = np.where(body == 1, speed, -speed)
    times = np.linspace(0.0, 0.3 * edge / speed, 5)[1:]
    return free(
        "pull_apart", np.concatenate([left, right]), velocity, dx, per_cell, times, material,
        body=body, speed=speed,
    )  # fmt: skip
