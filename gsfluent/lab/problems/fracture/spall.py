"""Plate impact: where a reflected wave tears a plate, and what its free face shows of it."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gsfluent.lab.world.driver import World
from gsfluent.lab.world.registry import Result, compare, problem
from gsfluent.lab.world.shapes import box, nacc, wave_speed
from gsfluent.lab.world.walls import between_planes


def spall_strength(row: Tensor, alpha: float) -> float:
    """Axial stress at which uniaxial straining in tension leaves the elastic range [Pa].

    With ``p = -kappa e`` and ``q = 2 mu e`` the yield condition is quadratic in the strain e.
    """
    mu, kappa, slope, beta, xi = (float(v) for v in row[:5])
    p0 = kappa * (1e-5 + math.sinh(-xi * alpha))
    a = 4.0 * mu * mu * (1.0 + 2.0 * beta) + (slope * kappa) ** 2
    b = slope * slope * kappa * p0 * (1.0 - beta)
    c = -slope * slope * beta * p0 * p0
    strain = (-b + math.sqrt(b * b - 4.0 * a * c)) / (2.0 * a)
    return (kappa + 4.0 / 3.0 * mu) * strain


@problem(tier="fast")
def plate_impact_spall(over: float = 1.25) -> list[Result]:
    """Plate impact: spall plane one flyer thickness behind the free face, and pull-back velocity.

    A plate of ``flyer`` cells hits one of ``target`` cells of the same NACC material at
    ``2 over spall_strength / (rho c)``. The release waves from the two free faces meet one flyer
    thickness inside the target; the free face slows by ``2 sigma_sp / (rho c)`` and is then pushed
    by the wave from the new surface. The impact is smoothed over 4 cells: a sharper one rings.
    """
    flyer = 20
    dx, alpha0 = 0.4 / flyer, -0.01
    row = nacc(1e9, 0.3, 1000.0, friction=2.0, cohesion=0.1, hardening=1.0)
    c, strength = wave_speed(row), spall_strength(row, alpha0)
    impedance = float(row[6]) * c
    speed = 2.0 * over * strength / impedance
    length = (flyer + 50) * dx
    points = box([0.0, 0.0, 0.0], [length, dx, dx], 0.5 * dx)
    x = points[:, 0]
    velocity = torch.zeros_like(points)
    velocity[:, 0] = 0.5 * speed * (1.0 - torch.tanh((x - flyer * dx) / (4.0 * dx)))
    volume = (0.5 * dx) ** 3
    world = World(
        points, velocity, volume=volume, dx=dx, law=1, params=row,
        alpha=torch.full_like(x, alpha0), colliders=between_planes(dx, (1, 2)), dtype=torch.float32,
    )  # fmt: skip
    face = x > length - dx
    trace: list[float] = []
    first: list[float] = []

    def watch(w: World) -> None:
        trace.append(float(w.velocity[face, 0].mean()))
        broken = (w.alpha >= 0.0).cpu()
        if not first and bool(broken.any()):
            first.append((length - float(x[broken].mean())) / dx)

    world.run(seconds=(50 + 3 * flyer) * dx / c, each=watch)
    top = max(range(len(trace)), key=trace.__getitem__)
    drop = trace[top] - min(trace[top:])
    source = "linear waves: equal plates; Antoun et al. 2003, Spall Fracture"
    plane = first[0] if first else math.nan
    return [
        compare(
            "depth of the spall plane", plane, flyer, error=abs(plane - flyer), tolerance=1.0,
            unit="dx", source=source,
        ),
        compare(
            "spall strength from the pull-back velocity", 0.5 * impedance * drop, strength,
            tolerance=0.1, unit="Pa", source=source,
        ),
    ]  # fmt: skip
