"""Scenes in which brittle MPM goes wrong, and how far apart two runs of them are.

A ball that breaks on a floor (failures.md row 8), the same seeded half-way between nodes, and
debris: points that fly alone. ``scripts/study/brittle/run.py`` and
:mod:`gsfluent.lab.peers.known` run them with the variants of
:mod:`gsfluent.lab.textbook.solver`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import torch

from gsfluent.fracturebench.scene import Floats, Scene
from gsfluent.fracturebench.shapes import free
from gsfluent.lab.textbook.grid import stencil
from gsfluent.lab.textbook.solver import Textbook, Variant
from gsfluent.lab.textbook.variant import Birth
from gsfluent.lab.world.invariants import Limits, State, Violation, check, observe
from gsfluent.lab.world.shapes import ball, box

DX = 1.0 / 32.0
"""Node spacing of these scenes [m]; a power of two, so that x / dx rounds nothing."""
SPEED = 6.0
"""Of the falling ball [m/s]."""
FLESH: dict[str, Any] = {
    "law": "nacc", "young_modulus": 166.0, "poisson_ratio": 0.38, "density": 1.0,
    "friction": 1.85, "cohesion": 0.6, "hardening": 3.0, "alpha": -0.04,
}  # fmt: skip
"""GaussianFluent's melon flesh, of E / 12 (equations.md 7.6)."""
_FLOOR = 3.0 * DX


def plain(
    points: Floats, velocity: Floats, material: Mapping[str, Any], per_cell: int = 8, **more: Any
) -> Scene:
    """A scene of one material that is run by steps: its times are not used."""
    return free("brittle", points, velocity, DX, per_cell, np.array([1.0]), material, **more)


def drop(
    radius: float = 0.1,
    *,
    per_cell: int = 8,
    speed: float = SPEED,
    shift: float = 0.37,
    material: Mapping[str, Any] = FLESH,
) -> Scene:
    """A ball thrown at a floor.

    Args:
        radius: [m].
        per_cell: Points per cell.
        speed: [m/s].
        shift: Of the lattice against the grid [dx]. With ``per_cell`` 1, 0 puts every point at
            ``(n + 1/2) dx``.
        material: Its row.
    """
    up = math.ceil(radius / DX) * DX + _FLOOR  # whole cells: the lattice keeps its place
    centre = [16.0 * DX + shift * DX, 16.0 * DX + 0.6 * shift * DX, up + 0.3 * shift * DX]
    points = ball(centre, radius, DX / round(per_cell ** (1.0 / 3.0))).numpy()
    return plain(
        points, np.array([0.0, 0.0, -speed]), material, per_cell,
        gravity=(0.0, 0.0, -9.81),
        colliders=({"point": [0.0, 0.0, _FLOOR], "normal": [0.0, 0.0, 1.0], "kind": "separate",
                    "friction": 0.3},),
    )  # fmt: skip


def debris(edge: int = 12, *, away: float = 32.0, seed: int = 0) -> Scene:
    """Broken points in free flight, none of which shares a node with another."""
    random = np.random.default_rng(seed)
    points = box([away * DX] * 3, [4.0 * edge * DX] * 3, 4.0 * DX).numpy()
    points = points + DX * random.random(points.shape)
    broken = {**FLESH, "alpha": 0.1}
    return plain(points, np.array([1.7, -0.9, 0.6]), broken)


def hit_rate(scene: Scene, dtype: torch.dtype, *, local: bool = False) -> float:
    """Expected points per step that lie exactly half-way between nodes on some axis.

    A number of size X has neighbours ``2^floor(log2 X) eps`` away, and one of them is n + 1/2.
    """
    eps = torch.finfo(dtype).eps
    if local:  # offsets in [0, 1), half of them in [1/2, 1)
        return float(3 * scene.count * 0.5 * eps)
    return float((np.exp2(np.floor(np.log2(np.abs(scene.x / DX)))) * eps).sum())


def exposure(solver: Textbook) -> float:
    """Expected points per step that an unguarded division kills, in the present state.

    A point is exposed along an axis if one of its far nodes is reached by no other point: half-way
    between nodes its weight there is exactly zero. Times the chance to lie there in this precision.
    """
    position = solver.position
    s = stencil(torch.zeros_like(position, dtype=torch.int64), position / DX, DX, "quadratic")
    reached = torch.bincount(s.node.reshape(-1), minlength=s.size)
    lonely = reached[s.node] == 1
    chance = torch.exp2(torch.floor(torch.log2((position / DX).abs())))
    chance = chance * torch.finfo(solver.dtype).eps
    total = 0.0
    for axis in range(3):
        far = (lonely & (s.corner[:, axis] == 2)).any(1)
        total += float((far * chance[:, axis]).sum())
    return total


def step(scene: Scene, courant: float = 0.3) -> float:
    """Fixed time step [s] from the wave speed at rest and the speed at the start."""
    fastest = scene.wave_speed + float(np.linalg.norm(scene.v, axis=1).max())
    return courant * scene.dx / fastest


class Outcome(NamedTuple):
    """What became of a run."""

    position: Floats  # [m], [N, 3], the last that were numbers
    alpha: Floats  # [N]
    steps: int  # taken
    birth: Birth | None  # where the first number that is none came from, or None
    broken: float  # share of points without strength
    kinetic: float  # kinetic energy over that at the start
    smallest: float  # smallest volume ratio met
    # the first law that it broke (invariants; momentum is not judged, the floor takes it), if asked
    # for
    violation: Violation | None
    exposure: float  # expected deaths by an unguarded division so far (exposure), if asked for
    track: Floats | None  # positions after every every steps, float32 [T, N, 3], if asked for


def _state(s: Textbook, start: State | None) -> State:
    m = s.nacc
    params = torch.zeros(s.scene.count, 8, dtype=torch.float64, device=s.device)
    params[:, 0], params[:, 1] = m.mu.double(), m.kappa.double()
    params[:, 6] = s.mass.double() / s.volume.double()
    return observe(
        step=s.steps, time=s.time, dx=s.scene.dx, position=s.position, velocity=s.velocity,
        affine=s.affine, mass=s.mass, volume=s.volume,
        law=torch.zeros(s.scene.count, dtype=torch.int32, device=s.device), params=params,
        strain=s.strain, gravity=s.scene.gravity, start=start,
        pulled_back=int((s.volume_ratio <= 0).sum()),
    )  # fmt: skip


def run(
    scene: Scene,
    variant: Variant,
    *,
    steps: int,
    dt: float,
    dtype: torch.dtype = torch.float32,
    device: str = "cpu",
    every: int = 0,
    exposed: int = 0,
    judged: int = 0,
) -> Outcome:
    """Run a scene by the textbook solver for a number of steps, or until a number is none.

    Positions are kept (``every``), :func:`exposure` looked at (``exposed``), energy and volume
    judged (``judged``) every so manieth step; 0 is never.
    """
    solver = Textbook(scene, variant, device=device, dtype=dtype, dt=dt)
    start = solver.kinetic()
    last, track, smallest, expected = solver.position, [], 1.0, 0.0
    limits, violation = Limits(momentum=math.inf), None
    first = _state(solver, None) if judged else None

    def watch(s: Textbook) -> None:
        nonlocal last, smallest, expected, violation
        if s.steps % 5 == 0:
            smallest = min(smallest, float(s.volume_ratio.min()))
        if every and s.steps % every == 0:
            track.append(s.position.cpu().numpy())
        if exposed and s.steps % exposed == 0:
            expected += exposed * exposure(s)
        if first is not None and violation is None and s.steps % judged == 0:
            violation = check(first, _state(s, first), limits)
        last = s.position

    try:
        solver.run(steps=steps, each=watch)
    except FloatingPointError:
        pass
    broken = float((solver.brittle & (solver.alpha >= 0.0)).double().mean())
    return Outcome(
        last.cpu().numpy(), solver.alpha.double().cpu().numpy(), solver.steps, solver.birth, broken,
        solver.kinetic() / start, smallest, violation, expected, np.stack(track) if track else None,
    )  # fmt: skip


def apart(one: Outcome, other: Outcome) -> tuple[float, float]:
    """Root mean square distance of the points of two runs [dx], and largest difference of alpha."""
    away = np.sqrt(((one.position - other.position) ** 2).sum(axis=1).mean()) / DX
    return float(away), float(np.abs(one.alpha - other.alpha).max())
