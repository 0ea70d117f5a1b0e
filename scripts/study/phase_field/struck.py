"""Plates whose edge a bar strikes: Kalthoff and Winkler; Rittel and Maigre."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

from gsfluent.fracturebench.run import Run
from gsfluent.fracturebench.scene import Floats, Scene
from gsfluent.fracturebench.scenes import cracks
from gsfluent.fracturebench.scenes.slabs import slab_volume, walls
from gsfluent.fracturebench.shapes import elastic, free, plane
from gsfluent.lab.frozen.answer import rows
from gsfluent.lab.world.driver import World
from gsfluent.lab.world.resident import Resident
from gsfluent.ops.collider import POINT, VELOCITY, collider_row
from gsfluent.ops.damage import damage_of
from gsfluent.ops.reference.phase_field import BROKEN

STEEL = (190e9, 0.3, 8000.0)
STEEL_TOUGHNESS = 22130.0
PMMA = (5.76e9, 0.42, 1180.0)
PMMA_TOUGHNESS = 309.0
"""Of 1.47 MPa sqrt(m) in plane strain [J/m^2]."""
RAMP = 1e-6
"""Time over which the bar gets its speed [s]."""
STAGES = 10
"""Steps of the ramp."""


def struck(scene: Scene, bar: torch.Tensor, speed: float, device: str) -> Run:
    """Run a plate by law ``phase_field``; a bar moves along x.

    Args:
        scene: The plate.
        bar: Row of the bar as a collider.
        speed: That it has after the ramp [m/s].
        device: Where.
    """
    law, params, alpha = rows(scene, "phase_field")
    planes = [
        collider_row("plane", point=p["point"], normal=p["normal"], mode="slip")
        for p in scene.colliders
    ]
    world = World(
        torch.from_numpy(scene.x), torch.from_numpy(scene.v),
        volume=torch.from_numpy(scene.volume), dx=scene.dx, law=law, params=params,
        material=torch.from_numpy(scene.material), alpha=alpha,
        colliders=torch.stack([*planes, bar]), dtype=torch.float32, device=device,
    )  # fmt: skip
    assert isinstance(world.stepper, Resident)
    begin = float(bar[POINT])
    for i in range(STAGES):  # the middle of each stage: the way is that of a ramp
        share = (i + 0.5) / STAGES
        held = torch.stack([*planes, bar])
        held[-1, POINT] = begin + 0.5 * speed * RAMP * (i / STAGES) ** 2
        held[-1, VELOCITY] = share * speed
        world.stepper.solver.set_colliders(held)
        world.run(seconds=(i + 1) * RAMP / STAGES - world.time)
    held[-1, POINT], held[-1, VELOCITY] = begin + 0.5 * speed * RAMP, speed
    world.stepper.solver.set_colliders(held)
    seen, x = [], []
    for end in scene.times:
        world.run(seconds=float(end) - world.time)
        seen.append(damage_of(world.peak.double()).cpu().numpy())
        x.append(world.position.double().cpu().numpy())
    return Run(
        scene.name, "gsfluent", scene.times, np.stack(x),
        np.zeros((len(scene.times), *scene.x.shape)), 0.0, world.steps,
        damage=np.stack(seen) * (scene.material > 0),
    )  # fmt: skip


def path(arm: Floats, wide: float) -> Floats:
    """Middle line of a crack from a notch: mean places over bands of reach, [B, 2].

    Args:
        arm: Broken points from the tip of the notch [m], [P, 2].
        wide: Width of a band [m].
    """
    reach = np.hypot(arm[:, 0], arm[:, 1])
    band = (reach / wide).astype(int)
    return np.array([arm[band == b].mean(axis=0) for b in np.unique(band)]).reshape(-1, 2)


def kalthoff(
    cells: int, split: str, model: str, length: float, device: str
) -> tuple[dict[str, Any], Scene, Run]:
    """Kalthoff and Winkler's plate as phase-field papers run it (Borden et al. 2012).

    Half of the symmetric test: 100 x 100 mm, a slit of 50 mm at 25 mm from the plane of symmetry,
    16.5 m/s on the edge below it, risen within a microsecond; the other sides are free.

    Args:
        cells: Along a side.
        split: What drives the crack.
        model: ``at1`` or ``at2``.
        length: Of the phase field [m].
        device: Where.
    """
    side, tip, height = 0.1, 0.05, 0.025
    dx = side / cells
    row = cracks.griffith(
        *STEEL, toughness=STEEL_TOUGHNESS, length=length, dx=dx, split=split, model=model
    )
    points = cracks.plate(np.zeros(2), np.array([side, 2.0 * side]), dx, 8)
    points = points[points[:, 1] > 0.0]
    # no node has matter of both faces
    slit = (points[:, 0] < tip) & (np.abs(points[:, 1] - height) < 1.51 * dx)
    points = points[~slit]
    breakable = (points[:, 0] > 0.05 * side) & (points[:, 1] > 3.0 * dx)
    scene = free(
        "kalthoff", points, [0.0] * 3, dx, 8, np.linspace(0.0, 90e-6, 31)[1:],
        (elastic(*STEEL), row), material=breakable,
        volume=np.full(points.shape[0], slab_volume(dx, 8)), colliders=(*walls(dx), plane(1)),
    )  # fmt: skip
    half = [0.01, 0.5 * (height - dx), 4.0 * dx]
    bar = collider_row(
        "box", point=(0.25 * dx - half[0], half[1], 0.0), extent=half, mode="separate"
    )
    run = struck(scene, bar, 16.5, device)
    found = {"split": split, "model": model, "length_mm": 1e3 * length}
    return found | _direction(scene, run, np.array([tip, height])), scene, run


def compact(dx: float, length: float, split: str, device: str) -> tuple[dict[str, Any], Scene, Run]:
    """A compact compression specimen struck on one arm, after Rittel and Maigre 1996.

    PMMA, 70 x 60 mm; a slot of 22 mm by 20 mm from the left edge, a notch of 12 mm on from its
    middle; a bar drives the lower arm at 20 m/s. The sizes are remembered, not read.

    Args:
        dx: Node spacing [m].
        length: Of the phase field [m].
        split: ``rankine``, or ``spectral``, by which the struck arm is crushed.
        device: Where.
    """
    wide, high, deep, gap, tip = 0.07, 0.06, 0.022, 0.02, 0.034
    row = cracks.griffith(*PMMA, toughness=PMMA_TOUGHNESS, length=length, dx=dx, split=split)
    points = cracks.plate(np.zeros(2), np.array([wide, high]), dx, 8)
    x, y = points[:, 0], np.abs(points[:, 1])
    points = points[~((x < deep) & (y < 0.5 * gap)) & ~((x < tip) & (y < 1.51 * dx))]
    breakable = points[:, 0] > deep  # not the arms: what the bar sends breaks them, if l is wide
    scene = free(
        "compact", points, [0.0] * 3, dx, 8, np.linspace(0.0, 160e-6, 41)[1:],
        (elastic(*PMMA), row), material=breakable,
        volume=np.full(points.shape[0], slab_volume(dx, 8)), colliders=walls(dx),
    )  # fmt: skip
    arm = 0.5 * (high - gap)
    half = [0.01, 0.5 * arm, 4.0 * dx]
    bar = collider_row(
        "box", point=(0.25 * dx - half[0], -0.5 * (high - arm), 0.0), extent=half, mode="separate"
    )
    run = struck(scene, bar, 20.0, device)
    sides = {s: _direction(scene, run, np.array([tip, 0.0]), s) for s in (1.0, -1.0)}
    side = max(sides, key=lambda s: sides[s]["length"])
    found = {"split": split, "length_mm": 1e3 * length, "towards_load": side < 0.0}
    return found | sides[side], scene, run


def apart(line: Floats, other: Floats) -> float:
    """Largest distance of the points of a path from another path, where both run.

    Args:
        line: Places from the notch, [B, 2].
        other: The same of the other, [C, 2].
    """
    reach = np.hypot(*other.T)
    both = line[np.hypot(*line.T) <= reach.max()]
    gaps = np.linalg.norm(both[:, None] - other[None], axis=2).min(axis=1)
    return float(gaps.max(initial=0.0))


def _direction(scene: Scene, run: Run, tip: Floats, side: float = 1.0) -> dict[str, Any]:
    """Direction from the tip to the end, along the path in the middle, and the length."""
    assert run.damage is not None
    broken = run.damage >= BROKEN
    arms = [scene.x[b, :2] - tip for b in broken]
    arms = [a * [1.0, side] for a in arms]
    up = [
        a[(a[:, 1] > 0.0) & (a[:, 0] > -0.01) & (np.hypot(a[:, 0], a[:, 1]) > 0.002)] for a in arms
    ]
    if not len(up[-1]):
        return {
            "angle": math.nan,
            "first": math.nan,
            "median": math.nan,
            "length": 0.0,
            "when": math.nan,
        }
    line = path(up[-1], 0.002)
    reach = np.hypot(line[:, 0], line[:, 1])
    angles = np.degrees(np.arctan2(line[:, 1], line[:, 0]))
    begun = next(i for i, a in enumerate(up) if len(a))
    return {
        "angle": float(angles[-1]), "first": float(angles[min(4, len(angles) - 1)]),
        "median": float(np.median(angles)), "length": 1e3 * float(reach[-1]),
        "when": 1e6 * float(run.times[begun]), "path": (1e3 * line).tolist(),
    }  # fmt: skip
