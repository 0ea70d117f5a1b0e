"""The long tests of the phase-field law: each job runs one scene and says figures about it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from struck import compact, kalthoff
from thrown import THROWS, floor, melon

from gsfluent import ops
from gsfluent.fracturebench.registry import judge
from gsfluent.fracturebench.run import Run
from gsfluent.fracturebench.scene import Scene
from gsfluent.fracturebench.scenes import cracks
from gsfluent.fracturebench.scenes.plane import rayleigh_speed
from gsfluent.fracturebench.scenes.rows import BROKEN
from gsfluent.fracturebench.scenes.slabs import slab_volume, walls
from gsfluent.fracturebench.shapes import elastic, free
from gsfluent.lab.frozen.answer import rows, run_case
from gsfluent.lab.world.driver import World
from gsfluent.ops.collider import collider_row
from gsfluent.ops.damage import DamageField, damage_of
from gsfluent.ops.plasticity import weakened

GLASS = (1e9, 0.2, 1000.0)
STRIP_TOUGHNESS = 10.0
BEAM = (20.8e9, 0.3, 2400.0)
BEAM_TOUGHNESS = 500.0
Done = tuple[dict[str, Any], Scene | None, Run | None]


@dataclasses.dataclass(frozen=True)
class Job:
    """One run of one test.

    Attributes:
        test: Which test.
        name: Of the run, also of its files.
        setting: What is chosen, for the table.
        seconds: CPU seconds that it takes, about.
        work: Runs it.
    """

    test: str
    name: str
    setting: str
    seconds: float
    work: Callable[[], Done]


class Energies:
    """Kinetic, elastic and surface energy of a world at each sample [J]; a ``watch``."""

    def __init__(self) -> None:
        self.rows: list[tuple[float, float, float]] = []

    def __call__(self, world: World, index: int) -> None:
        """Read the world."""
        scene, peak, place = world.scene, world.peak.double(), world.position
        law, params = weakened(scene.law, scene.params.double(), scene.material, peak)
        volume = scene.volume.double()
        stored = ops.elastic_energy(world.strain.double(), law=law, params=params)
        field = DamageField(scene.law, scene.params.double(), scene.material)
        surface = field.energy(
            world.alpha.double(), peak, place, volume, dx=scene.dx,
            blocks=ops.build_blocks(place, scene.dx),
        )  # fmt: skip
        self.rows.append((world.kinetic(), float((stored * volume).sum()), float(surface)))


def _run(scene: Scene, device: str, watch: Energies | None = None) -> Run:
    run = run_case(scene, law="phase_field", watch=watch, device=device)
    if run.failed:
        raise FloatingPointError(run.failed)
    return run


def _damage(run: Run) -> np.ndarray:
    assert run.damage is not None
    return run.damage


# --- the strip: what a running crack costs, and when it runs ---


def strip(cells: float, release: float, place: float, device: str) -> Done:
    """A strip 24 l high that is held stretched, the crack ``place`` cells off the grid."""
    dx = 1.0 / 24.0 / cells  # the strip is 1 m high
    length, speed = cells * dx, rayleigh_speed(*GLASS)
    scene = cracks.stretched_strip(
        "strip", GLASS, STRIP_TOUGHNESS, (2.5, 1.0), 0.6, release, dx, 8, length, 4.0 / speed,
        samples=40, shift=place, seed=round(100 * place),
    )  # fmt: skip
    energies = Energies()
    run = _run(scene, device, energies)
    reach = cracks.reach_of(scene, _damage(run), 0.6)
    found: dict[str, Any] = {"release": release, "reach": float(reach[-1]), "cells": cells}
    # between a quarter and nine tenths of the free way, where the crack runs evenly
    steady = np.flatnonzero((reach > 0.4) & (reach < 1.5))
    if steady.size >= 4:
        a, b = steady[0], steady[-1]
        way = float(reach[b] - reach[a]) * dx * STRIP_TOUGHNESS
        rows = np.array(energies.rows)
        found["surface"] = float(rows[b, 2] - rows[a, 2]) / way
        found["speed"] = float((reach[b] - reach[a]) / (run.times[b] - run.times[a])) / speed
    return found, scene, run


# --- plates of FractureBench ---


def branching(cells: float, length: float, device: str) -> Done:
    """The forking crack of Borden et al. at their own length."""
    scene = cracks.branching_plate(length / cells, 8, length)
    energies = Energies()
    run = _run(scene, device, energies)
    most, speed, off = judge(scene, run)
    rows = np.array(energies.rows)
    done = rows[0].sum() - rows.sum(axis=1)  # 0 if energy is kept: the layers are part of it
    reach = cracks.reach_of(scene, _damage(run), 0.05)
    counts = cracks.branches(scene.x, _damage(run)[-1] >= BROKEN, scene.dx, 0.05)
    forked = np.flatnonzero(counts >= 2)
    fork = 2.0 * scene.dx * float(forked[0]) if forked.size else math.nan
    when = float(np.interp(fork, reach, run.times)) if forked.size else math.nan
    found = {
        "cracks": most.value, "speed": speed.value, "off": off.value, "fork": fork,
        "when": when, "lost": float(done[-1] / rows[-1, :].sum()), "surface": float(rows[-1, 2]),
        "kinetic": float(rows[-1, 0]), "gone": float(done[-1]),
    }  # fmt: skip
    return found, scene, run


def notch(cells: float, prefer: str, length: float, device: str) -> Done:
    """The notched square of Miehe et al."""
    scene = cracks.notched_square(length / cells, 8, length, 30.0, prefer)
    run = _run(scene, device)
    force, moved, off = judge(scene, run)
    found = {"force": force.value, "moved": moved.value, "off": off.value}
    forces, way = cracks.pulled(scene, run)
    found["curve"] = [way.tolist(), forces.tolist()]
    return found, scene, run


def pmma(release: float, dx: float, device: str) -> Done:
    """The strip of Bleyer et al. at a release of energy over the toughness."""
    scene = cracks.stretched_strip(
        "pmma_strip", cracks.PMMA, cracks.PMMA_TOUGHNESS, (0.032, 0.016), 0.004, release, dx, 8,
        2.0 * dx, 60e-6,
    )  # fmt: skip
    run = _run(scene, device)
    share, speed = judge(scene, run)
    return {"release": release, "share": share.value, "speed": speed.value}, scene, run


# --- three-point bending ---


def bending(cells: float, prefer: str, length: float, device: str) -> Done:
    """The notched beam of Miehe et al.: 8 x 2 mm on two supports, pressed down in the middle."""
    dx = length / cells
    wide, high, deep = 8e-3, 2e-3, 4e-4
    row = cracks.griffith(
        *BEAM, toughness=BEAM_TOUGHNESS, length=length, dx=dx, split="none", model="at2",
        prefer=prefer,
    )  # fmt: skip
    points = cracks.plate(np.array([0.0, 0.0]), np.array([wide, high]), dx, 8)
    across = np.abs(points[:, 0] - 0.5 * wide)
    points = points[(across > 1.51 * dx) | (points[:, 1] > deep - 0.5 * high)]
    # Twenty periods of its first bending: in five the force still rises by a tenth while it cracks.
    seconds = 20.0 * 0.07 / math.sqrt(BEAM[0] / BEAM[2])
    speed = 6.5e-5 / seconds
    times = np.linspace(0.0, seconds, 61)[1:]
    breakable = np.abs(points[:, 0] - 0.5 * wide) < 1.2e-3
    breakable &= points[:, 1] < 0.5 * high - 6.0 * dx
    scene = free(
        "bending", points, [0.0] * 3, dx, 8, times, (elastic(*BEAM), row), material=breakable,
        volume=np.full(points.shape[0], slab_volume(dx, 8)), colliders=walls(dx),
    )  # fmt: skip
    law, params, alpha = rows(scene, "phase_field")
    half = [2.5 * dx, 2.5 * dx, 4.0 * dx]
    low, top = -0.5 * high + 0.25 * dx - half[1], 0.5 * high - 0.25 * dx + half[1]
    bars = [
        collider_row("box", point=(x, low, 0.0), extent=half, mode="separate")
        for x in (2e-4, wide - 2e-4)
    ]
    bars.append(
        collider_row(
            "box", point=(0.5 * wide, top, 0.0), extent=half, mode="separate",
            velocity=(0.0, -speed, 0.0),
        )
    )  # fmt: skip
    planes = [
        collider_row("plane", point=p["point"], normal=p["normal"], mode="slip")
        for p in scene.colliders
    ]
    world = World(
        torch.from_numpy(scene.x), (0.0, 0.0, 0.0), volume=torch.from_numpy(scene.volume), dx=dx,
        law=law, params=params, material=torch.from_numpy(scene.material), alpha=alpha,
        colliders=torch.stack([*planes, *bars]), dtype=torch.float32, device=device,
    )  # fmt: skip
    given, seen, x = [0.0], [], []
    for end in times:
        world.run(seconds=float(end) - world.time)
        given.append(float(world.impulse[-1, 1]))
        seen.append(damage_of(world.peak.double()).cpu().numpy())
        x.append(world.position.double().cpu().numpy())
    force = -np.diff(given) / np.diff([0.0, *times]) / dx
    way = speed * (times - 0.5 * times[0])
    at = int(np.argmax(force))
    run = Run(
        scene.name, "gsfluent", times, np.stack(x), np.zeros((len(times), *scene.x.shape)), 0.0,
        world.steps, damage=np.stack(seen) * (scene.material > 0),
    )  # fmt: skip
    broken = scene.x[_damage(run)[-1] >= BROKEN, 0]
    off = float(np.abs(broken - 0.5 * wide).max(initial=0.0)) / dx if broken.size else math.nan
    found = {"force": float(force[at]) / 1e6, "moved": float(way[at]) * 1e6, "off": off}
    return found | {"curve": [way.tolist(), force.tolist()]}, scene, run


def jobs(quick: bool, device: str) -> list[Job]:
    """All jobs on a device; ``quick``: one small one of each test."""
    made: list[Job] = []
    wide = 4.0 if quick else 1.0

    def add(test: str, name: str, setting: str, seconds: float, work: Callable[[], Done]) -> None:
        made.append(Job(test, f"{test}_{name}", setting, seconds, work))

    for cells in (2,) if quick else (2, 3, 4):
        for release in (1.5,) if quick else (0.9, 1.1, 1.5):
            for place in (0.25,) if quick else (0.0, 0.25, 0.5, 0.75):
                add(
                    "strip", f"{cells}_{release:g}_{place:g}", f"{cells} dx", 1.5 * cells**3,
                    lambda c=cells, r=release, p=place: strip(c, r, p, device),
                )  # fmt: skip
    for cells in (2, 3)[: 1 if quick else 2]:
        add(
            "branching", f"{cells}", f"{cells} dx", 13.0 * cells**3,
            lambda c=cells: branching(c, wide * 5e-4, device),
        )  # fmt: skip
        for prefer in ("toughness", "strength"):
            add(
                "notch", f"{cells}_{prefer}", f"{cells} dx, {prefer}", 18.0 * cells**3,
                lambda c=cells, p=prefer: notch(c, p, wide * 1.5e-5, device),
            )  # fmt: skip
    # a beam is borne by its toughness (docs/measured/phase_field.md)
    # grids of which the beam's height and its notch are whole cells
    for fine in (2.4,) if quick else (2.4, 3.0, 3.75):
        add(
            "bending", f"{fine:g}_toughness", f"{fine:g} dx, toughness", 160.0 * fine**3,
            lambda c=fine: bending(c, "toughness", wide * 6e-5, device),
        )  # fmt: skip
    for release in (2.6,) if quick else (1.2, 1.6, 2.0, 2.6, 3.2):
        for dx, cost in ((4e-4, 2.0),) if quick else ((1e-4, 130.0), (5e-5, 1100.0)):
            add(
                "pmma", f"{2e3 * dx:g}_{release:g}", f"{2e3 * dx:g} mm", cost,
                lambda r=release, d=dx: pmma(r, d, device),
            )  # fmt: skip
    # side in cells, l in thousandths of the side
    plates = [(64, 31.25), (128, 31.25), (128, 15.625), (256, 15.625), (256, 7.8125)]
    for count, length in plates[:1] if quick else [*plates, (512, 7.8125)]:
        for split, model in (("spectral", "at1"), ("spectral", "at2"), ("volumetric", "at1")):
            add(
                "kalthoff", f"{count}_{length:g}_{split}_{model}",
                f"{count} cells, {0.1 * length:.2g} mm, {split}, {model}", (count / 32.0) ** 3,
                lambda c=count, w=length, s=split, m=model: kalthoff(c, s, m, 1e-4 * w, device),
            )  # fmt: skip
    sizes = [(2.5e-4, 5e-4), (1.25e-4, 5e-4), (1.25e-4, 2.5e-4)]
    for split in ("rankine",) if quick else ("rankine", "spectral"):
        for dx, length in [(1e-3, 2e-3)] if quick else sizes:
            add(
                "compact", f"{split}_{1e3 * dx:g}_{1e3 * length:g}",
                f"{1e3 * dx:g}, {1e3 * length:g} mm, {split}", 0.25 * dx**-1.0,
                lambda d=dx, w=length, s=split: compact(d, w, s, device),
            )  # fmt: skip
    for name in THROWS:
        add("floor", name, name, 300.0, lambda n=name: floor(n, 4 if quick else 6, device))
    for height in (0.6,) if quick else (0.5, 0.6, 0.75):
        for count in (20,) if quick else (20, 30, 40):
            for seed in range(1 if quick else 8 if height == 0.6 else 3):
                add(
                    "melon", f"rankine_{height:g}_{count}_{seed}", f"{height:g} m",
                    (count / 10.0) ** 4,
                    lambda c=count, s=seed, h=height: melon(c, s, h, device),
                )  # fmt: skip
    return made
