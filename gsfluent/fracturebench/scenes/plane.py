"""Plane-strain fracture: Brazilian disc, notch in tension, double cantilever, Kalthoff-Winkler."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator

import numpy as np

from ..registry import case
from ..run import Measure, Run
from ..scene import Floats, Scene, SceneError, wave_speed
from ..scenes.rows import BROKEN, brittle, damage_of
from ..scenes.slabs import HEAVY, heavy, sheet, slab_volume, walls
from ..shapes import elastic, free, plane

_PLAIN = elastic(1e9, 0.2, 1000.0)


def rayleigh_speed(young: float, poisson: float, density: float) -> float:
    """Speed of a Rayleigh wave [m/s], by Viktorov's fit (within half a percent)."""
    shear = math.sqrt(young / (2.0 * (1.0 + poisson)) / density)
    return shear * (0.862 + 1.14 * poisson) / (1.0 + poisson)


def break_times(scene: Scene, damage: Floats) -> Floats:
    """When each point broke [s], halfway between samples; infinite if it did not, [N]."""
    broken = damage >= BROKEN
    first = np.argmax(broken, axis=0)
    times = np.concatenate([[0.0], scene.times])
    when = 0.5 * (times[first] + times[first + 1])
    return np.where(broken.any(axis=0), when, np.inf)


def front_speed(x: Floats, when: Floats, low: float, high: float) -> float:
    """Speed of a front between two places, by a line through the arrivals [m/s].

    Args:
        x: Places [m], [N].
        when: Arrival at each [s], infinite where it did not come, [N]. Of points that are equally
            far the first counts.
        low: First place [m].
        high: Last place [m].

    Returns:
        The speed; 0 if the front does not reach ``high``, infinite if it is everywhere at once.
    """
    places = np.unique(np.round(x[(x >= low) & (x <= high)], 9))
    if places.size < 2:
        return 0.0
    first = np.array([when[np.abs(x - p) < 1e-8].min() for p in places])
    if not np.isfinite(first).all():
        return 0.0
    # a place behind the front cannot be reached later than one ahead of it
    first = np.minimum.accumulate(first[::-1])[::-1]
    away = places - places.mean()
    slowness = float((away * first).sum() / (away * away).sum())
    return 1.0 / slowness if slowness > 0.0 else math.inf


# --- Brazilian disc -------------------------------------------------------------------------------

_RADIUS, _HALF_ANGLE, _RAMP = 0.5, 0.15, 40.0


def _judge_disc(scene: Scene, run: Run) -> Iterator[Measure]:
    damage, facts = damage_of(scene, run), scene.facts
    radius, dx = _RADIUS, scene.dx
    away = np.hypot(scene.x[:, 0], scene.x[:, 1])
    intact = np.flatnonzero(damage.max(axis=1) < 0.01)
    settled = [i for i in intact if scene.times[i] > float(facts["settled"])]
    source = "Hondros 1959, load on an arc"
    wide = math.sin(2.0 * _HALF_ANGLE) / _HALF_ANGLE
    if run.stress is None:
        raise SceneError(f"{run.method}, {scene.name}: hand in `stress`; the disc is judged by it")
    load = float(facts["tension"]) * np.minimum(1.0, scene.times / float(facts["ramp"]))
    for axis, name, wanted in (
        (0, "tensile stress at the centre over 2P/(pi D t)", wide - 1.0),
        (1, "stress along the load over 2P/(pi D t)", -wide - 1.0),
    ):
        value = math.nan
        if settled:
            seen = run.stress[settled][:, away < 1.5 * dx, axis].mean(axis=1)
            value = float((seen / load[settled]).mean())
        yield Measure(name, value, wanted, abs(value / wanted - 1.0), 0.05, "", source)
    source = "splitting from the centre along the loaded diameter"
    broken = damage >= BROKEN
    at = np.flatnonzero(broken.any(axis=1))
    place = width = reach = math.nan
    if at.size:
        place = float(away[broken[at[0]]].mean()) / dx
        # the crack when it has just run: later the halves are crushed by the load that goes on
        end = min(at[0] + int(facts["run"]), broken.shape[0] - 1)
        found = np.abs(scene.x[broken[end], :2])
        middle = found[found[:, 1] < 0.5 * radius]
        width = float(middle[:, 0].max()) / dx if middle.size else math.nan
        reach = float(found[:, 1].max()) / radius
    yield Measure("first broken point from the centre", place, 0.0, place, 2.0, "dx", source)
    yield Measure("half width of the crack, middle half", width, 0.0, width, 2.0, "dx", source)
    yield Measure(
        "reach of the crack along the diameter, of 0.75 that can break", reach, 0.75,
        abs(reach / 0.75 - 1.0), 0.1, "radii", source,
    )  # fmt: skip


@case(
    kind="fracture", dx=_RADIUS / 12, ladder=(_RADIUS / 8, _RADIUS / 12, _RADIUS / 16),
    judge=_judge_disc,
)  # fmt: skip
def brazilian_disc(dx: float, per_cell: int) -> Scene:
    """Brazilian disc: stress at the centre, first damage there, crack along the loaded diameter.

    Even radial pressure on two arcs grows linearly in time and the motion is damped, so that the
    load hardly moves anything. Beyond three quarters of the radius the disc is elastic, because a
    material that crushes would do so where the load enters.
    """
    row = brittle(
        1e9, 0.2, 1000.0, friction=2.4, cohesion=0.05, strength=0.02, softening=0.02,
        energy=0.0502, dx=dx, reference=_RADIUS / 12.0,
    )  # fmt: skip
    c, tension = wave_speed(_PLAIN), 0.01 * 1e9
    points = sheet([-_RADIUS, -_RADIUS], [2.0 * _RADIUS, 2.0 * _RADIUS], dx, per_cell)
    away = np.hypot(points[:, 0], points[:, 1])
    points, away = points[away <= _RADIUS], away[away <= _RADIUS]
    angle = np.arctan2(np.abs(points[:, 0]), np.abs(points[:, 1]))
    loaded = np.flatnonzero((away > _RADIUS - 0.71 * dx) & (angle < _HALF_ANGLE))
    push = -points[loaded] / away[loaded, None] * [1.0, 1.0, 0.0]
    upper = points[loaded, 1] > 0.0
    force = math.pi * _RADIUS * dx * tension  # P of a slab of thickness dx
    push *= force / -push[upper, 1].sum()
    crossing = 2.0 * _RADIUS / c
    times = np.linspace(0.0, 20.0 * crossing, 161)[1:]
    n = points.shape[0]
    return free(
        "brazilian_disc", points, [0.0, 0.0, 0.0], dx, per_cell, times, (_PLAIN, row),
        material=(np.abs(points[:, 1]) < 0.75 * _RADIUS).astype(np.int32),
        volume=np.full(n, slab_volume(dx, per_cell)), colliders=walls(dx),
        drives=(
            {"points": "all", "damping": c / (2.0 * _RADIUS)},
            {"points": loaded.tolist(), "force": push.tolist(), "ramp": _RAMP * crossing},
        ),
        asks=("damage", "stress"),
        facts={"tension": tension, "ramp": _RAMP * crossing, "settled": 7.0 * crossing, "run": 12},
    )  # fmt: skip


# --- Single-edge notch in tension -----------------------------------------------------------------

_HEIGHT, _NOTCH = 0.5, 0.2


def _judge_notch(scene: Scene, run: Run) -> Iterator[Measure]:
    limit = rayleigh_speed(1e9, 0.2, 1000.0)
    when = break_times(scene, damage_of(scene, run))
    x = scene.x[:, 0]
    places = [0.25 + 0.1 * i for i in range(6)]
    speeds = [front_speed(x, when, a, b) / limit for a, b in itertools.pairwise(places)]
    mean, fastest = front_speed(x, when, 0.3, 0.75) / limit, max(speeds)
    source = "Freund 1990, Dynamic Fracture Mechanics; Viktorov's c_R"
    # a crack that never ran has speed 0 and must not pass
    error = fastest if mean > 0.0 else math.inf
    yield Measure(
        "fastest tenth of the crack over c_R, a bound", fastest, 1.0, error, 1.0, "", source
    )
    error = mean if mean > 0.0 else math.inf
    yield Measure("mean speed of the crack over c_R, a bound", mean, 1.0, error, 1.0, "", source)
    broken = np.isfinite(when) & (x > _NOTCH)
    off = float(np.abs(scene.x[broken, 1]).max()) / scene.dx if broken.any() else math.nan
    yield Measure(
        "broken point furthest from the line of the notch", off, 0.0, off, 3.0, "dx", "symmetry"
    )


def notch(dx: float, per_cell: int, pull: float, weight: float) -> Scene:
    """The scene of :func:`notch_tension`, grips pulled at ``pull`` times the wave speed."""
    row = brittle(
        1e9, 0.2, 1000.0, friction=2.0, cohesion=0.1, strength=0.005, softening=0.001,
        energy=0.0887, dx=dx, reference=1.0 / 32.0,
    )  # fmt: skip
    c = wave_speed(_PLAIN)
    points = sheet([0.0, -0.5 * _HEIGHT], [1.0, _HEIGHT], dx, per_cell)
    points = points[(points[:, 0] > _NOTCH) | (np.abs(points[:, 1]) > 1.01 * dx)]
    y = points[:, 1]
    velocity = np.zeros_like(points)
    velocity[:, 1] = 2.0 * pull * c * y / _HEIGHT
    edge = 0.5 * _HEIGHT - 2.0 * dx
    # finely while a crack may run
    start = 9.0 * 6e-6 / pull
    times = np.concatenate(
        [np.linspace(0.0, start, 31)[1:], np.linspace(start, start + 7.0, 141)[1:]]
    )
    times /= c
    return free(
        "notch_tension", points, velocity, dx, per_cell, times,
        (_PLAIN, row, heavy(_PLAIN, weight)),
        material=np.where(np.abs(y) > edge, 2, np.abs(y) < 0.125).astype(np.int32),
        volume=np.full(y.size, slab_volume(dx, per_cell)), colliders=walls(dx),
        drives=(
            {"points": np.flatnonzero(y > edge).tolist(), "velocity": [None, pull * c, None]},
            {"points": np.flatnonzero(y < -edge).tolist(), "velocity": [None, -pull * c, None]},
        ),
        asks=("damage",),
    )  # fmt: skip


@case(kind="fracture", dx=1 / 32, ladder=(1 / 24, 1 / 32, 1 / 48), judge=_judge_notch)
def notch_tension(dx: float, per_cell: int) -> Scene:
    """Single-edge notch in tension: its crack runs straight and slower than a Rayleigh wave.

    The strip is torn so slowly that waves cross it many times before the crack starts. Torn faster,
    all of it reaches its strength before a crack has passed, and what then runs is no crack.
    """
    return notch(dx, per_cell, 6e-6, HEAVY)


# --- Kalthoff and Winkler -------------------------------------------------------------------------

_SIDE, _SLOT, _SLOT_HEIGHT = 0.1, 0.05, 0.025


def _judge_kalthoff(scene: Scene, run: Run) -> Iterator[Measure]:
    broken = damage_of(scene, run)[-1] >= BROKEN
    arm = scene.x[broken, :2] - np.array(scene.facts["tip"])
    reach = np.hypot(arm[:, 0], arm[:, 1])
    above = (arm[:, 1] > 0.0) & (reach > 0.004)  # beyond the blunt tip
    angle, length, off = math.nan, 0.0, math.inf
    if above.any():
        angle = float(np.median(np.degrees(np.arctan2(arm[above, 1], arm[above, 0]))))
        length = float(reach[above].max())
        off = max(63.0 - angle, angle - 70.0, 0.0)
    yield Measure(
        "direction of the crack, distance to 63..70", angle, 70.0, off, 7.0, "degrees",
        "Kalthoff and Winkler 1988",
    )  # fmt: skip
    yield Measure(
        "length of the crack", length * 1e3, 40.0, max(0.0, 1.0 - length / 0.025), 0.2, "mm",
        "at least 25 mm of the 80 mm to the upper edge, or the angle says little",
    )  # fmt: skip


@case(kind="fracture", dx=_SIDE / 64, ladder=(_SIDE / 48, _SIDE / 64), judge=_judge_kalthoff)
def kalthoff(dx: float, per_cell: int) -> Scene:
    """Kalthoff-Winkler: a notch of maraging steel hit in shear cracks in tension, at 70 degrees.

    Half of the symmetric test: plate of 100 mm, notch of 50 mm at 25 mm from the plane of symmetry,
    projectile of the same steel at 33 m/s. Fracture energy is that of 18Ni1900, strength half of
    the real one, so that a crack needs 8 to 10 cells to soften and not two.
    """
    plain = elastic(190e9, 0.3, 8000.0)
    row = brittle(
        190e9, 0.3, 8000.0, friction=2.0, cohesion=0.05, strength=0.05, softening=0.0172,
        energy=0.0404, dx=dx, reference=_SIDE / 64.0,
    )  # fmt: skip
    plate = sheet([0.0, 0.0], [_SIDE, _SIDE], dx, per_cell)
    open_ = (plate[:, 0] < _SLOT) & (np.abs(plate[:, 1] - _SLOT_HEIGHT) < 0.76 * dx)
    plate = plate[~open_]
    shot = sheet([-0.05, 0.0], [0.05, _SLOT_HEIGHT - dx], dx, per_cell)
    points = np.concatenate([plate, shot])
    velocity = np.zeros_like(points)
    velocity[plate.shape[0] :, 0] = 33.0
    # what is crushed at the edge or lies on the plane of symmetry is no part of the question
    breakable = (points[:, 0] > 0.1 * _SIDE) & (points[:, 1] > 3.0 * dx)
    breakable[plate.shape[0] :] = False
    shift = dx * round(0.05 / dx + 4.0)
    return free(
        "kalthoff", points + [shift, 0.0, 0.0], velocity, dx, per_cell,
        np.linspace(0.0, 80e-6, 9)[1:], (plain, row), material=breakable.astype(np.int32),
        volume=np.full(points.shape[0], slab_volume(dx, per_cell)),
        colliders=(*walls(dx), plane(1)), asks=("damage",),
        facts={"tip": [shift + _SLOT, _SLOT_HEIGHT]},
    )  # fmt: skip
