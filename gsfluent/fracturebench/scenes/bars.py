"""Bars in uniaxial strain: a plate that spalls, and a stretching bar that breaks into pieces."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from ..registry import case
from ..run import Measure, Run
from ..scene import Floats, Scene, wave_speed
from ..scenes.rows import BROKEN, brittle, damage_of, levels
from ..scenes.slabs import walls
from ..shapes import box, free

_FLYER, _OVER = 0.4, 1.25


def _judge_spall(scene: Scene, run: Run) -> Iterator[Measure]:
    damage, facts = damage_of(scene, run), scene.facts
    length, strength = float(facts["length"]), float(facts["spall_strength"])
    broken = damage >= BROKEN
    at = np.flatnonzero(broken.any(axis=1))
    plane = length - float(scene.x[broken[at[0]], 0].mean()) if at.size else math.nan
    plane, wanted = plane / scene.dx, _FLYER / scene.dx
    source = "linear waves: equal plates; Antoun et al. 2003, Spall Fracture"
    yield Measure("depth of the spall plane", plane, wanted, abs(plane - wanted), 1.0, "dx", source)
    face = scene.x[:, 0] > length - scene.dx
    trace = run.v[:, face, 0].mean(axis=1)
    top = int(np.argmax(trace)) if np.isfinite(trace).all() else 0
    drop = float(trace[top] - trace[top:].min())
    found = 0.5 * float(facts["impedance"]) * drop
    yield Measure(
        "spall strength from the pull-back velocity", found, strength,
        abs(found / strength - 1.0), 0.1, "Pa", source,
    )  # fmt: skip


@case(kind="fracture", dx=0.02, ladder=(0.04, 0.4 / 15, 0.02, 0.4 / 30), judge=_judge_spall)
def spall(dx: float, per_cell: int) -> Scene:
    """Plate impact: spall plane one flyer thickness behind the free face, pull-back velocity.

    A plate of 0.4 m hits one of 1 m of the same material; impact stress is 1.25 of the strength
    in uniaxial strain, and smoothed over 0.08 m.
    """
    row = brittle(
        1e9, 0.3, 1000.0, friction=2.0, cohesion=0.1, strength=math.sinh(0.01), softening=0.01,
        energy=0.0686, dx=dx, reference=0.02,
    )  # fmt: skip
    length, c = _FLYER + 1.0, wave_speed(row)
    impedance, strength = float(row["density"]) * c, float(row["tensile_strength"])
    points = box([0.0, 0.0, 0.0], [length, dx, dx], dx, per_cell)
    speed = 2.0 * _OVER * strength / impedance
    velocity = np.zeros_like(points)
    velocity[:, 0] = 0.5 * speed * (1.0 - np.tanh((points[:, 0] - _FLYER) / 0.08))
    times = np.linspace(0.0, (1.0 + 3.0 * _FLYER) / c, 111)[1:]
    return free(
        "spall", points, velocity, dx, per_cell, times, row, colliders=walls(dx, (1, 2)),
        asks=("damage",),
        facts={"length": length, "spall_strength": strength, "impedance": impedance},
    )  # fmt: skip


def expected_size(rate: float, energy: float, strength: float, density: float, c: float) -> float:
    """Length in which stored and local kinetic energy pay for one crack [m].

    ``rho rate^2 s^3 / 24 + sigma^2 s / (2 rho c^2) = G`` (Glenn and Chudnovsky 1986; without the
    stored energy it is Grady's ``(24 G / (rho rate^2))^(1/3)``), solved by bisection.
    """
    stored = strength**2 / (2.0 * density * c * c)
    low, high = 0.0, energy / stored
    for _ in range(60):
        middle = 0.5 * (low + high)
        paid = density * rate**2 * middle**3 / 24.0 + stored * middle
        low, high = (middle, high) if paid < energy else (low, middle)
    return 0.5 * (low + high)


def _pieces(scene: Scene, damage: Floats) -> int:
    """Pieces of a bar along x: cracks are runs of slices of a cell with a broken point."""
    cell = np.floor(scene.x[:, 0] / scene.dx).astype(int)
    broken = np.unique(cell[damage >= BROKEN])
    return 1 + (1 + int((np.diff(broken) > 1).sum()) if broken.size else 0)


def _judge_stretched(scene: Scene, run: Run) -> Iterator[Measure]:
    size = 1.0 / _pieces(scene, damage_of(scene, run)[-1])
    expected = float(scene.facts["expected"])
    yield Measure(
        "mean piece, error as log of the ratio", size, expected, abs(math.log(size / expected)),
        math.log(2.0), "m", "Glenn and Chudnovsky 1986; a trend, within a factor of two",
    )  # fmt: skip


@case(
    kind="fracture", dx=1 / 240, ladder=(1 / 120, 1 / 180, 1 / 240, 1 / 320),
    judge=_judge_stretched,
)  # fmt: skip
def stretched_bar(dx: float, per_cell: int) -> Scene:
    """Bar that stretches evenly at 0.02 c per metre breaks into pieces of a known mean length."""
    row = brittle(
        1e9, 0.2, 1000.0, friction=2.0, cohesion=0.1, strength=0.01, softening=0.004,
        energy=0.083, dx=dx, reference=1.0 / 240.0,
    )  # fmt: skip
    points = box([0.0, 0.0, 0.0], [1.0, dx, dx], dx, per_cell)
    # strength scatters by a tenth from one 240th of the bar to the next, on every grid
    scatter = np.random.default_rng(0).uniform(-0.1, 0.1, 240)
    rows, index = levels(row, 1.0 + scatter[np.floor(points[:, 0] * 240.0).astype(int)], 21)
    c, strength = wave_speed(row), float(row["tensile_strength"])
    rate = 0.02 * c
    velocity, affine = np.zeros_like(points), np.zeros((points.shape[0], 3, 3))
    velocity[:, 0], affine[:, 0, 0] = rate * (points[:, 0] - 0.5), rate
    # to the elastic limit, and on until waves have crossed the longest pieces
    end = 1.2 * strength / (1000.0 * c * c) / rate + 1.2 / c * 0.5
    size = expected_size(rate, float(row["fracture_energy"]), strength, 1000.0, c)
    return free(
        "stretched_bar", points, velocity, dx, per_cell, np.linspace(0.0, end, 9)[1:], rows,
        affine=affine, material=index, colliders=walls(dx, (1, 2)), asks=("damage",),
        facts={"expected": size},
    )  # fmt: skip
