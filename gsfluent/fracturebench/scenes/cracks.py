"""Cracks whose load, speed and branches have published references: plates in plane strain.

Their rows are Griffith's: an energy per area (``fracture_energy``) and a width (``length``), as
phase fields have them. A law that softens by a strain gets rows that take the same energy.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..registry import case
from ..run import Measure, Run
from ..scene import Floats, Scene, SceneError, wave_speed
from ..scenes.plane import rayleigh_speed
from ..scenes.rows import BROKEN, brittle, damage_of, moduli
from ..scenes.slabs import edge_points, sheet, slab_volume, walls
from ..shapes import elastic, free, plane

_ENERGY = 0.0887
"""Of :func:`brittle` at friction 2 and cohesion 0.1."""


def griffith(
    young: float,
    poisson: float,
    density: float,
    *,
    toughness: float,
    length: float,
    dx: float,
    split: str = "volumetric",
    model: str = "at1",
    prefer: str = "toughness",
    energy: float = _ENERGY,
) -> dict[str, Any]:
    """Row of a material whose cracks take ``toughness`` per area and are ``length`` wide.

    Args:
        young: Young's modulus [Pa].
        poisson: Poisson's ratio.
        density: [kg/m^3].
        toughness: Gc [J/m^2].
        length: l of a phase field [m].
        dx: Node spacing of the scene [m].
        split: What drives a crack: ``volumetric``, ``none`` or ``spectral``.
        model: ``at1`` or ``at2``.
        prefer: What a grid keeps: the energy of a long crack (``toughness``), or the strength that
            toughness and length make in one dimension.
        energy: Of :func:`brittle`.
    """
    strength = math.sqrt(3.0 * young * toughness / (8.0 * length))  # of AT1
    kappa = moduli(elastic(young, poisson, density))[1]
    pressed = 8.0 * strength / kappa  # p0: a tenth of it is what the surface bears in tension
    softening = toughness / (2.0 * dx * energy * kappa * pressed)
    row = brittle(
        young, poisson, density, friction=2.0, cohesion=0.1, strength=pressed,
        softening=softening, energy=energy, dx=dx, reference=dx,
    )  # fmt: skip
    return row | {"length": length, "split": split, "model": model, "prefer": prefer}


def plate(lower: Floats, size: Floats, dx: float, per_cell: int, seed: int = 0) -> Floats:
    """A sheet of points off their rows, the lower half the mirror image of the upper, [N, 3].

    Points in rows would favour cracks along them. The plate is centred on y = 0.
    """
    points = sheet([lower[0], 0.0], [size[0], 0.5 * size[1]], dx, per_cell)
    step = dx / edge_points(per_cell)
    off = np.random.default_rng(seed).random((points.shape[0], 2)) - 0.5
    points[:, :2] += 0.5 * step * off
    return np.concatenate([points, points * [1.0, -1.0, 1.0]])


def notched(points: Floats, tip: float, dx: float) -> Floats:
    """The points without those of a notch along y = 0, three cells wide, up to x = ``tip``."""
    return points[(points[:, 0] > tip) | (np.abs(points[:, 1]) > 1.51 * dx)]


def stretched(count: int, strain: Floats | float) -> Floats:
    """``b - I`` of matter stretched along y, [N, 6]."""
    found = np.zeros((count, 6))
    found[:, 1] = (1.0 + strain) ** 2 - 1.0
    return found


def branches(x: Floats, broken: NDArray[np.bool_], dx: float, begin: float) -> NDArray[np.int64]:
    """How many cracks cross each column of two cells from x = ``begin`` on, [C]."""
    hit = x[broken & (x[:, 0] > begin)]
    counts = []
    for low in np.arange(begin, x[:, 0].max() - dx, 2.0 * dx):
        y = np.sort(hit[(hit[:, 0] >= low) & (hit[:, 0] < low + 2.0 * dx), 1])
        counts.append(0 if y.size == 0 else 1 + int((np.diff(y) > 2.5 * dx).sum()))
    return np.array(counts)


def reach_of(scene: Scene, damage: Floats, tip: float) -> Floats:
    """Distance of the furthest broken point from the tip of the notch, over time [m], [T]."""
    away = np.hypot(scene.x[:, 0] - tip, scene.x[:, 1])
    ahead = scene.x[:, 0] > tip
    return np.array([away[ahead & (row >= BROKEN)].max(initial=0.0) for row in damage])


def fastest(times: Floats, reach: Floats) -> float:
    """Largest speed over two samples [m/s]."""
    return float(((reach[2:] - reach[:-2]) / (times[2:] - times[:-2])).max(initial=0.0))


# --- Branching ------------------------------------------------------------------------------------

_GLASS = (32e9, 0.2, 2450.0)
_TRACTION = 1e6


def _soft(young: float, poisson: float, density: float, dx: float) -> tuple[dict[str, Any], float]:
    """Row of a layer that carries the traction, and its stretch along y."""
    soft = elastic(1e-4 * young, poisson, 4e-4 * density)
    mu, kappa = moduli(soft)
    low, high = 1.0, 3.0
    for _ in range(60):
        s = 0.5 * (low + high)
        stress = mu * s ** (-5.0 / 3.0) * 2.0 / 3.0 * (s * s - 1.0) + 0.5 * kappa * (s - 1.0 / s)
        low, high = (s, high) if stress < _TRACTION else (low, s)
    return soft, low


def _judge_branching(scene: Scene, run: Run) -> Iterator[Measure]:
    damage, dx, tip = damage_of(scene, run), scene.dx, float(scene.facts["tip"])
    plain = scene.materials[1]
    limit = rayleigh_speed(
        float(plain["young_modulus"]), float(plain["poisson_ratio"]), float(plain["density"])
    )
    broken = damage[-1] >= BROKEN
    counts = branches(scene.x, broken, dx, tip)
    forked = np.flatnonzero(counts >= 2)
    most = int(np.median(counts[forked])) if forked.size >= 4 else int(counts.max(initial=0) > 0)
    source = "Borden et al. 2012: one crack becomes a Y"
    yield Measure("cracks behind the fork", most, 2.0, abs(most - 2.0), 0.5, "", source)
    reach = reach_of(scene, damage, tip)
    speed = fastest(scene.times, reach) / limit
    error = speed if reach[-1] > 0.0 else math.inf
    yield Measure(
        "fastest tip over c_R, a bound", speed, 0.75, error, 0.75, "", "Freund 1990; Borden et al."
    )
    off = math.nan
    if most == 2:
        y = [
            scene.x[broken & (side * scene.x[:, 1] > 0.0) & (scene.x[:, 0] > tip)]
            for side in (1, -1)
        ]
        tops = [
            np.array([np.abs(p[(p[:, 0] >= low) & (p[:, 0] < low + 2.0 * dx), 1]).max(initial=0.0)
                      for low in tip + 2.0 * dx * forked])
            for p in y
        ]  # fmt: skip
        off = float(np.abs(tops[0] - tops[1]).max()) / dx
    yield Measure("branches off each other's mirror image", off, 0.0, off, 2.0, "dx", "symmetry")


def branching_plate(dx: float, per_cell: int, length: float, samples: int = 20) -> Scene:
    """The scene of :func:`branching` with cracks of any width ``length`` [m]."""
    row = griffith(*_GLASS, toughness=3.0, length=length, dx=dx)
    soft, stretch = _soft(*_GLASS, dx)
    layer = dx * round(4e-3 / dx)
    wide, high, tip = 0.1, 0.04, 0.05
    points = plate(np.zeros(2), np.array([wide, high + 2.0 * (layer + 2.0 * dx)]), dx, per_cell)
    points = notched(points, tip, dx)
    pulls = np.abs(points[:, 1]) > 0.5 * high
    volume = np.full(points.shape[0], slab_volume(dx, per_cell))
    volume[pulls] /= stretch
    # cracks may not start at the loaded edges
    breakable = (np.abs(points[:, 1]) < 0.5 * high - 4.0 * dx) & (points[:, 0] < wide - 2.0 * dx)
    return free(
        "branching", points, [0.0] * 3, dx, per_cell, np.linspace(0.0, 80e-6, samples + 1)[1:],
        (soft, elastic(*_GLASS), row),
        material=np.where(pulls, 0, 1 + breakable), volume=volume,
        strain=stretched(points.shape[0], np.where(pulls, stretch - 1.0, 0.0)),
        colliders=(*walls(dx), *held(0.5 * high + layer)), asks=("damage",), facts={"tip": tip},
    )  # fmt: skip


def held(height: float) -> tuple[dict[str, Any], dict[str, Any]]:
    """Walls that hold what lies beyond y = ``height`` and -``height``."""
    return plane(1, height, -1.0, "sticky"), plane(1, -height, 1.0, "sticky")


@case(kind="fracture", dx=5e-4, ladder=(2e-3, 1e-3, 5e-4), judge=_judge_branching)
def branching(dx: float, per_cell: int) -> Scene:
    """Notched glass under 1 MPa at once: its crack runs and forks, both branches mirror images.

    Borden et al. 2012: 100 x 40 mm, notch of 50 mm. The traction is that of a soft layer on each
    edge, ten thousand times softer than the glass and stretched before, so that it stays.
    """
    return branching_plate(dx, per_cell, 2.0 * dx)


# --- PMMA strip -----------------------------------------------------------------------------------

PMMA = (3.09e9, 0.35, 1180.0)
PMMA_TOUGHNESS = 300.0


def stretched_strip(
    name: str,
    solid: tuple[float, float, float],
    toughness: float,
    size: tuple[float, float],
    tip: float,
    release: float,
    dx: float,
    per_cell: int,
    length: float,
    seconds: float,
    samples: int = 20,
    shift: float = 0.0,
    seed: int = 0,
    energy: float = _ENERGY,
) -> Scene:
    """A strip that is held stretched, with a notch from its left edge.

    Args:
        name: Of the case.
        solid: Young's modulus [Pa], Poisson's ratio, density [kg/m^3].
        toughness: Gc [J/m^2].
        size: Width and height [m].
        tip: Length of the notch [m].
        release: Energy that a long crack releases per area, over the toughness.
        dx: Node spacing [m].
        per_cell: Points per cell.
        length: Width of the crack, l [m].
        seconds: Simulated [s].
        samples: Times that are asked for.
        shift: Of the strip along y on the grid [dx].
        seed: Of the places of its points.
        energy: As in :func:`griffith`.
    """
    row = griffith(*solid, toughness=toughness, length=length, dx=dx, energy=energy)
    modulus = wave_speed(row) ** 2 * solid[2]
    strain = math.sqrt(2.0 * release * toughness / (modulus * size[1]))
    points = plate(np.zeros(2), np.array([size[0], size[1] + 4.0 * dx]), dx, per_cell, seed)
    points = notched(points, tip, dx)
    breakable = np.abs(points[:, 1]) < 0.5 * size[1] - 4.0 * dx
    points[:, 1] += shift * dx
    return free(
        name, points, [0.0] * 3, dx, per_cell, np.linspace(0.0, seconds, samples + 1)[1:],
        (elastic(*solid), row), material=breakable,
        volume=np.full(points.shape[0], slab_volume(dx, per_cell) / (1.0 + strain)),
        strain=stretched(points.shape[0], strain),
        colliders=(*walls(dx), *held(0.5 * size[1]), plane(0, size[0], -1.0)),  # goes on there
        asks=("damage",), facts={"tip": tip, "release": release, "toughness": toughness},
    )  # fmt: skip


def _judge_strip(scene: Scene, run: Run) -> Iterator[Measure]:
    damage, dx, tip = damage_of(scene, run), scene.dx, float(scene.facts["tip"])
    plain = scene.materials[0]
    limit = rayleigh_speed(
        float(plain["young_modulus"]), float(plain["poisson_ratio"]), float(plain["density"])
    )
    counts = branches(scene.x, damage[-1] >= BROKEN, dx, tip)
    share = float((counts >= 2).mean())
    source = "Bleyer, Roux-Langlois, Molinari 2017: branches from a release of about 2 Gc"
    error = max(0.0, 0.1 - share)
    yield Measure(
        "share of the way with branches, at least 0.1", share, 0.1, error, 0.05, "", source
    )
    reach = reach_of(scene, damage, tip)
    speed = fastest(scene.times, reach) / limit
    error = speed if reach[-1] > 0.0 else math.inf
    yield Measure("fastest tip over c_R, a bound", speed, 0.75, error, 0.75, "", source)


@case(kind="fracture", dx=1e-4, ladder=(4e-4, 2e-4, 1e-4), judge=_judge_strip)
def pmma_strip(dx: float, per_cell: int) -> Scene:
    """Strip of PMMA held stretched, that releases 2.6 times its toughness: its crack branches.

    Bleyer et al. 2017: 32 x 16 mm, notch of 4 mm.
    """
    return stretched_strip(
        "pmma_strip", PMMA, PMMA_TOUGHNESS, (0.032, 0.016), 0.004, 2.6, dx, per_cell, 2.0 * dx,
        60e-6, energy=0.0645,
    )  # fmt: skip


# --- Peak load of a notched square ----------------------------------------------------------------

_SIDE, _STEEL = 1e-3, (210e9, 0.3, 7850.0)


def _judge_peak(scene: Scene, run: Run) -> Iterator[Measure]:
    if run.impulse is None:
        raise SceneError(f"{run.method}, {scene.name}: hand in `impulse`; it is judged by forces")
    force, moved = pulled(scene, run)
    at = int(np.argmax(force))
    source = "Miehe, Welschinger, Hofacker 2010"
    yield Measure(
        "largest force", force[at] / 1e6, 0.701, abs(force[at] / 0.701e6 - 1.0), 0.05, "kN/mm",
        source,
    )  # fmt: skip
    yield Measure(
        "displacement at it", moved[at] * 1e6, 5.55, abs(moved[at] / 5.55e-6 - 1.0), 0.05, "um",
        source,
    )  # fmt: skip
    broken = damage_of(scene, run)[-1] >= BROKEN
    off = (
        float(np.abs(scene.x[broken, 1]).max(initial=0.0)) / scene.dx if broken.any() else math.nan
    )
    yield Measure(
        "broken point furthest from the line of the notch", off, 0.0, off, 3.0, "dx", source
    )


def pulled(scene: Scene, run: Run) -> tuple[Floats, Floats]:
    """Force on the upper grip per thickness [N/m] and its way [m] over time, [T - 1] each."""
    assert run.impulse is not None
    given = run.impulse[:, -2, 1]
    span = np.diff(scene.times)
    middle = 0.5 * (scene.times[1:] + scene.times[:-1])
    return np.diff(given) / span / scene.dx, 2.0 * float(scene.facts["speed"]) * middle


def notched_square(
    dx: float, per_cell: int, length: float, crossings: float, prefer: str = "strength"
) -> Scene:
    """The scene of :func:`notch_peak`, drawn out over so many crossings of its pressure wave."""
    row = griffith(
        *_STEEL,
        toughness=2700.0,
        length=length,
        dx=dx,
        split="none",
        model="at2",
        prefer=prefer,
        energy=0.0706,  # strains of percents
    )
    seconds = crossings * _SIDE / wave_speed(row)
    speed = 0.5 * 7e-6 / seconds  # of each grip: 7 um in all
    points = plate(np.zeros(2), np.array([_SIDE, _SIDE + 4.0 * dx]), dx, per_cell)
    points = notched(points, 0.5 * _SIDE, dx)
    velocity = np.zeros_like(points)
    velocity[:, 1] = np.clip(points[:, 1] / (0.5 * _SIDE), -1.0, 1.0) * speed
    breakable = np.abs(points[:, 1]) < 0.5 * _SIDE - 4.0 * dx
    grips = [
        g | {"velocity": [0.0, s * speed, 0.0]}
        for g, s in zip(held(0.5 * _SIDE), (1.0, -1.0), strict=True)
    ]
    return free(
        "notch_peak", points, velocity, dx, per_cell, np.linspace(0.0, seconds, 61)[1:],
        (elastic(*_STEEL), row), material=breakable,
        volume=np.full(points.shape[0], slab_volume(dx, per_cell)),
        colliders=(*walls(dx), *grips), asks=("damage", "impulse"), facts={"speed": speed},
    )  # fmt: skip


@case(kind="fracture", dx=7.5e-6, ladder=(3e-5, 1.5e-5, 7.5e-6), judge=_judge_peak)
def notch_peak(dx: float, per_cell: int) -> Scene:
    """Notched square of steel pulled slowly: the force that it bears, and where it breaks.

    Miehe et al. 2010: 1 mm, Gc 2700 J/m^2, AT2 with l = 0.015 mm, no split.
    """
    return notched_square(dx, per_cell, max(1.5e-5, 2.0 * dx), 30.0)
