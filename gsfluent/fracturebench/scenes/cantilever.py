"""Double cantilever: the energy that a crack takes per area."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from ..registry import case
from ..run import Measure, Run
from ..scene import Floats, Scene, SceneError, wave_speed
from ..scenes.rows import BROKEN, brittle, damage_of
from ..scenes.slabs import heavy, sheet, slab_volume, walls
from ..shapes import elastic, free
from ..statistics import stored_energy

_HEIGHT, _NOTCH = 0.375, 0.25
_SECTION = (0.125, 0.1875)
_WAY = (0.3125, 0.5)
"""Places of the tip between which energy is counted [m]."""
_PLAIN = elastic(1e9, 0.2, 1000.0)


def energy_beyond(scene: Scene, run: Run, low: float, high: float) -> tuple[Floats, Floats]:
    """Energy that went through a section towards larger x, and what of it is there [J], [T] each.

    The section is a column of points ``low <= x < high`` in matter that does not break: power
    ``-(1 / width) sum V sigma_x . v``, summed over the samples. What is there is kinetic and stored
    energy of small strains; the column itself counts in proportion.

    Raises:
        SceneError: The run handed in no stresses.
    """
    if run.stress is None:
        raise SceneError(f"{run.method}, {scene.name}: hand in `stress`; this case is judged by it")
    x, volume = scene.x[:, 0], scene.volume
    column = (x >= low) & (x < high)
    pull = run.stress[:, column][..., [0, 3, 4]]
    power = -np.einsum("n,tni,tni->t", volume[column], pull, run.v[:, column]) / (high - low)
    times, power = np.append(0.0, scene.times), np.append(0.0, power)
    passed = np.cumsum(0.5 * (power[1:] + power[:-1]) * np.diff(times))
    share = np.clip((x - low) / (high - low), 0.0, 1.0)
    motion = 0.5 * (run.v**2).sum(axis=2) @ (scene.mass * share)
    return passed, motion + stored_energy(scene, run.stress) @ share


def crack_tip(scene: Scene, damage: Floats, line: float, width: float) -> Floats:
    """Place along x of the furthest broken point within ``width`` of a line in y [m], [T]."""
    near = np.abs(scene.x[:, 1] - line) < width
    x = scene.x[near, 0]
    broken = damage[:, near] >= BROKEN
    return np.where(broken.any(axis=1), np.where(broken, x, -np.inf).max(axis=1), _NOTCH)


def crack_length(scene: Scene, damage: Floats, line: float, width: float) -> Floats:
    """Length of all cracks beyond the notch and within ``width`` of a line in y [m], [T].

    Cracks may run side by side. In each column of points every run of broken ones is a crack.
    """
    near = (np.abs(scene.x[:, 1] - line) < width) & (scene.x[:, 0] > _NOTCH)
    x, y = scene.x[near, 0], scene.x[near, 1]
    step = float(np.diff(np.unique(np.round(y, 9))).min())
    column = np.round((x - x.min()) / step).astype(np.int64)
    row = np.round((y - y.min()) / step).astype(np.int64) + 1  # row 0 is never broken
    broken = np.zeros((len(damage), column.max() + 1, row.max() + 1), dtype=bool)
    time, point = np.nonzero(damage[:, near] >= BROKEN)
    broken[time, column[point], row[point]] = True
    runs = broken[:, :, 1:] & ~broken[:, :, :-1]
    return np.asarray(runs.sum(axis=(1, 2)) * step, dtype=np.float64)


def per_area(tip: Floats, energy: Floats, width: float, length: Floats | None = None) -> float:
    """Slope of an energy over the area of cracks while the tip is in 0.3125..0.5 m [J/m^2].

    Args:
        tip: :func:`crack_tip` [m], [T].
        energy: [J], [T].
        width: Of the slab [m].
        length: Of the cracks [m], [T]; one crack up to the tip when absent.
    """
    on = (tip >= _WAY[0]) & (tip <= _WAY[1])
    away = (tip if length is None else length)[on]
    away = away - away.mean()
    return float((away * energy[on]).sum() / (away * away).sum()) / width


def _judge(scene: Scene, run: Run) -> Iterator[Measure]:
    damage = damage_of(scene, run)
    tip = crack_tip(scene, damage, 0.5 * _HEIGHT, 0.0625)
    passed, there = energy_beyond(scene, run, *_SECTION)
    value, row = math.nan, scene.materials[1]
    if ((tip >= _WAY[0]) & (tip <= _WAY[1])).sum() > 2 and tip[-1] > _WAY[1]:
        length = crack_length(scene, damage, 0.5 * _HEIGHT, 0.0625)
        value = per_area(tip, passed - there, scene.dx, length)
    wanted = float(row["fracture_energy"])
    error = abs(value / wanted - 1.0)
    yield Measure(
        "energy gone per area of the crack", value, wanted, error, 0.3, "J/m^2",
        "energy through a section of the arms less what is there, over the area of all cracks; "
        "fracture energy of the row",
    )  # fmt: skip


def cantilever(dx: float, per_cell: int, speed: float, seconds: float) -> Scene:
    """The scene of :func:`double_cantilever` at any speed of an arm over that of a pressure wave.

    It lasts ``seconds`` travel times along the slab.
    """
    row = brittle(
        1e9, 0.2, 1000.0, friction=2.0, cohesion=0.1, strength=0.02, softening=0.01,
        energy=0.0817, dx=dx, reference=1.0 / 32.0,
    )  # fmt: skip
    c = wave_speed(_PLAIN)
    points = sheet([0.0, 0.0], [1.0, _HEIGHT], dx, per_cell)
    middle = points[:, 1] - 0.5 * _HEIGHT
    keep = (points[:, 0] > _NOTCH) | (np.abs(middle) > 1.01 * dx)
    points, middle = points[keep], middle[keep]
    end, edge = points[:, 0] < 0.0626, 0.5 * _HEIGHT - 0.0626
    held = end & (np.abs(middle) > edge)
    times = np.linspace(0.0, seconds / c, 141)[1:]
    return free(
        "double_cantilever", points, [0.0, 0.0, 0.0], dx, per_cell, times,
        (_PLAIN, row, heavy(_PLAIN)),
        material=np.where(held, 2, np.abs(middle) < 0.0625).astype(np.int32),
        volume=np.full(middle.size, slab_volume(dx, per_cell)), colliders=walls(dx),
        drives=tuple(
            {
                "points": np.flatnonzero(end & (sign * middle > edge)).tolist(),
                "velocity": [None, sign * speed * c, None], "ramp": 1.0 / c,
            }
            for sign in (1.0, -1.0)
        ),
        asks=("damage", "stress"),
    )  # fmt: skip


@case(kind="fracture", dx=1 / 32, ladder=(1 / 32, 1 / 48, 1 / 64), judge=_judge)
def double_cantilever(dx: float, per_cell: int) -> Scene:
    """Double cantilever: a crack takes the energy per area that its material says, at every dx.

    Arms of a notched slab are wedged apart at 0.001 c each after a ramp. A layer of an eighth of a
    metre around the middle can break, the rest is elastic. The notch is two cells wide and scene
    and grid are mirrored, so that a crack may start at each of its corners: the area is of both.
    """
    return cantilever(dx, per_cell, 0.001, 14.0)
