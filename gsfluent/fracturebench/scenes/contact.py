"""Elastic bodies that touch: they part freely, bounce head on and askew, fall on a sticky floor."""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ..registry import case
from ..run import Measure, Run
from ..scene import Floats, Scene, wave_speed
from ..shapes import ball, box, elastic, free, plane


@functools.cache
def _stored(name: str) -> dict[str, Any]:
    """What ``scripts/fracturebench/references.py`` computed for a case."""
    text = (Path(__file__).parents[1] / "data" / "references.json").read_text(encoding="utf-8")
    return dict(json.loads(text)[name])


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
    material = elastic(1e5, 0.2, 1000.0)
    body = np.repeat([0, 1], [left.shape[0], right.shape[0]])
    speed = 0.01 * wave_speed(material)
    velocity = np.zeros((body.shape[0], 3))
    velocity[:, 0] = np.where(body == 1, speed, -speed)
    times = np.linspace(0.0, 0.3 * edge / speed, 5)[1:]
    return free(
        "pull_apart", np.concatenate([left, right]), velocity, dx, per_cell, times, material,
        body=body, facts={"speed": speed},
    )  # fmt: skip


_JELLY = elastic(1e5, 0.3, 1000.0)
_RADIUS, _SPEED, _GAP = 0.05, 0.02, 0.25
_LINE = np.array([2.0, 1.0, 0.5]) / math.sqrt(5.25)
"""Line of centres: no direction that a grid prefers."""
_SIDE = np.array([1.0, -2.0, 0.0]) / math.sqrt(5.0)


def _meeting(name: str, dx: float, per_cell: int, angle: float, last: float, asked: int) -> Scene:
    """Two balls that meet at ``angle`` [deg] to their line of centres, ``last`` [R / c] more."""
    points, volume = ball(_RADIUS, dx, per_cell)
    slope = math.radians(angle)
    along = math.cos(slope) * _LINE + math.sin(slope) * _SIDE
    c = wave_speed(_JELLY)
    speed, gap = _SPEED * c, _GAP * _RADIUS
    touch = gap / speed
    place = _RADIUS * _LINE + gap * along
    n = points.shape[0]
    velocity = np.repeat([speed * along, -speed * along], n, axis=0)
    end = touch + last * _RADIUS / c
    return free(
        name, np.concatenate([points - place, place - points]), velocity, dx, per_cell,
        np.linspace(0.0, end, asked + 1)[1:], _JELLY, volume=np.concatenate([volume, volume]),
        body=np.repeat([0, 1], n),
        facts={"speed": speed, "touch": touch, "unit": _RADIUS / c, "radius": _RADIUS},
    )  # fmt: skip


def _crossings(t: Floats, p: Floats) -> float:
    """Time from 0.9 of a momentum to its opposite of half the size."""
    fall = np.minimum.accumulate(p)
    if not np.isfinite(fall).all() or fall[-1] > -0.5:
        return math.inf
    first, second = (float(np.interp(-level, -fall, t)) for level in (0.9, -0.5))
    return second - first


def momentum_history(scene: Scene, run: Run) -> tuple[Floats, Floats, Floats]:
    """Time since contact [R / c], momentum of the first ball over that at the start, reference."""
    stored = _stored("collide")
    first = scene.body == 0
    mass = scene.mass[first]
    seen = (run.v[:, first] @ _LINE) @ mass / (float(mass.sum()) * float(scene.facts["speed"]))
    since = (scene.times - float(scene.facts["touch"])) / float(scene.facts["unit"])
    return since, seen, np.interp(since, stored["times"], stored["momentum"])


def _judge_collide(scene: Scene, run: Run) -> Iterator[Measure]:
    since, seen, exact = momentum_history(scene, run)
    source = "finite elements, scripts/fracturebench/references.py"
    error = float(np.sqrt(np.mean((seen - exact) ** 2)))
    yield Measure(
        "momentum of a ball through the impact, rms over the first", error, 0.0, error, 0.2, "",
        source,
    )  # fmt: skip
    back, known_back = -float(seen[-1]), -float(_stored("collide")["momentum"][-1])
    yield Measure("restitution", back, known_back, abs(back - known_back), 0.05, "", source)
    lasted, known_lasted = _crossings(since, seen), _crossings(since, exact)
    yield Measure(
        "time from 0.9 to -0.5 of the momentum", lasted, known_lasted,
        abs(lasted / known_lasted - 1.0), 0.1, "R/c", source,
    )  # fmt: skip
    size = float(scene.mass[scene.body == 0].sum()) * float(scene.facts["speed"])
    drift = float(np.abs(scene.mass @ run.v).max()) / size
    yield Measure("momentum of both balls", drift, 0.0, drift, 1e-5, "", "conservation")


@case(
    kind="contact", dx=0.05 / 6, judge=_judge_collide,
    ladder=(0.05 / 3, 0.0125, 0.01, 0.05 / 6, 0.05 / 7),
)  # fmt: skip
def collide(dx: float, per_cell: int) -> Scene:
    """Two elastic balls meet head on: momentum through the impact, restitution."""
    return _meeting("collide", dx, per_cell, 0.0, 16.0, 24)


@functools.cache
def _hertz(angle: float) -> Floats:
    """Velocity of the first of two smooth balls after they met at an angle, over v0, [3].

    The balls slide along each other while they touch, so that the line of centres turns: by a
    tenth of a radian here. Hertz's force with depth d, times 1 + s sqrt(d / R): s is fitted to the
    finite elements of ``collide`` (a few hundredths of the radius are no longer a small contact).
    Runge and Kutta's fourth order on half the distance of the centres.
    """
    slope = math.radians(angle)
    young, nu = float(_JELLY["young_modulus"]), float(_JELLY["poisson_ratio"])
    mass = 4.0 / 3.0 * math.pi * _RADIUS**3 * float(_JELLY["density"])
    stiff = 4.0 / 3.0 * 0.5 * young / (1.0 - nu * nu) * math.sqrt(0.5 * _RADIUS) / mass
    more = float(_stored("collide")["stiffening"])
    state = np.array([_RADIUS, 0.0, -math.cos(slope), -math.sin(slope)])
    state[2:] *= _SPEED * wave_speed(_JELLY)

    def rate(s: Floats) -> Floats:
        half = math.hypot(s[0], s[1])
        depth = max(2.0 * (_RADIUS - half), 0.0)
        push = stiff * depth**1.5 * (1.0 + more * math.sqrt(depth / _RADIUS)) / half
        return np.array([s[2], s[3], push * s[0], push * s[1]])

    dt = 40.0 * _RADIUS / wave_speed(_JELLY) / 2000
    for _ in range(2000):
        a = rate(state)
        b = rate(state + 0.5 * dt * a)
        c = rate(state + 0.5 * dt * b)
        state = state + dt / 6.0 * (a + 2.0 * b + 2.0 * c + rate(state + dt * c))
    # the state is that of the second ball, which flies against the line of centres
    return -(state[2] * _LINE + state[3] * _SIDE) / (_SPEED * wave_speed(_JELLY))


def _judge_oblique(scene: Scene, run: Run) -> Iterator[Measure]:
    speed, radius = float(scene.facts["speed"]), float(scene.facts["radius"])
    exact = _hertz(45.0)
    spins, turns, normals = [], [], []
    for body in (0, 1):
        of = scene.body == body
        mass = scene.mass[of]
        total = float(mass.sum())
        before, after = mass @ scene.v[of] / total, mass @ run.v[-1, of] / total
        start = before / speed
        got, known = after / speed - start, (exact if body == 0 else -exact) - start
        angle = math.atan2(float(np.linalg.norm(np.cross(known, got))), float(known @ got))
        # bodies that missed each other took no impulse and have no direction
        turns.append(angle if np.linalg.norm(got) > 0.2 else math.inf)
        normals.append(float(after @ _LINE) / speed * (1.0 if body == 0 else -1.0))
        arm = run.x[-1, of] - mass @ run.x[-1, of] / total
        inertia = float(mass @ (arm**2).sum(axis=1)) * 2.0 / 3.0
        rate = (mass[:, None] * np.cross(arm, run.v[-1, of] - after)).sum(axis=0) / inertia
        spins.append(float(np.linalg.norm(rate)) * radius / speed)
    spin, turn = max(spins), max(turns)
    both = math.hypot(spin, turn)
    free_of = "no friction, no torque"
    source = "paths of balls with the force of collide"
    yield Measure(
        "spin and direction of the impulse, both errors", both, 0.0, both, 0.03, "",
        f"{free_of}; {source}",
    )  # fmt: skip
    yield Measure("spin after the impact", spin, 0.0, spin, 0.02, "v0/R", free_of)
    yield Measure("direction of the impulse, error", turn, 0.0, turn, 0.03, "rad", source)
    back, known_back = 0.5 * sum(normals), float(exact @ _LINE)
    yield Measure(
        "velocity along the line of centres", back, known_back, abs(back - known_back), 0.1, "v0",
        source,
    )  # fmt: skip


@case(
    kind="contact", dx=0.05 / 6, judge=_judge_oblique,
    ladder=(0.05 / 3, 0.0125, 0.01, 0.05 / 6, 0.05 / 7),
)  # fmt: skip
def oblique(dx: float, per_cell: int) -> Scene:
    """Two smooth elastic balls meet at 45 degrees and leave without spin."""
    return _meeting("oblique", dx, per_cell, 45.0, 16.0, 4)


_EDGE = 0.1


def height_history(scene: Scene, run: Run) -> tuple[Floats, Floats, Floats]:
    """Time [edge / c], height of the centre over its start [edge], and its reference."""
    stored = _stored("drop")
    mass = scene.mass / scene.mass.sum()
    seen = (run.x[..., 2] - scene.x[:, 2]) @ mass / _EDGE
    since = scene.times * wave_speed(scene.materials[0]) / _EDGE
    return since, seen, np.interp(since, stored["times"], stored["height"])


def _judge_drop(scene: Scene, run: Run) -> Iterator[Measure]:
    _, seen, exact = height_history(scene, run)
    source = "finite elements, scripts/fracturebench/references.py"
    error = float(np.sqrt(np.mean((seen - exact) ** 2) / np.mean(exact**2)))
    yield Measure("height of the centre, relative rms", error, 0.0, error, 0.3, "", source)
    low, known = float(seen.min()), float(exact.min())
    yield Measure(
        "deepest fall of the centre over the edge", low, known, abs(low / known - 1.0), 0.2, "",
        source,
    )  # fmt: skip


@case(
    kind="contact", dx=0.01, judge=_judge_drop,
    ladder=(0.025, 0.1 / 6, 0.0125, 0.01, 0.1 / 12),
)  # fmt: skip
def drop(dx: float, per_cell: int) -> Scene:
    """Jelly cube that arrives on a sticky floor, as in the demos of physics on Gaussians."""
    points = box([-0.5 * _EDGE, -0.5 * _EDGE, 0.0], [_EDGE] * 3, dx, per_cell)
    stored = _stored("drop")
    c = wave_speed(_JELLY)
    gravity = float(stored["gravity"]) * c * c / _EDGE
    end = float(stored["times"][-1]) * _EDGE / c
    return free(
        "drop", points, [0.0, 0.0, -float(stored["speed"]) * c], dx, per_cell,
        np.linspace(0.0, end, 21)[1:], _JELLY, gravity=(0.0, 0.0, -gravity),
        colliders=(plane(2, kind="sticky"),),
    )  # fmt: skip
