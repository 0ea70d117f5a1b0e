"""Elastic bodies in free flight, whose small motions are known exactly."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator

import numpy as np

from ..registry import case
from ..ritz import Modes, ball_rule, box_rule, modes
from ..run import Measure, Run
from ..scene import Floats, Scene
from ..shapes import ball, box, elastic, free


def _rms(seen: Floats, exact: Floats) -> float:
    return float(np.sqrt(np.mean((seen - exact) ** 2) / np.mean(exact**2)))


def mode_history(scene: Scene, run: Run, shape: Floats) -> tuple[Floats, Floats, Floats]:
    """Displacement of a mode over its amplitude, its velocity likewise, and the exact first."""
    omega, size = float(scene.facts["omega"]), float(scene.facts["amplitude"])
    mass = scene.mass[:, None]
    whole = float((mass * shape * shape).sum()) * size
    u = (mass * shape * (run.x - scene.x)).sum(axis=(1, 2)) / whole
    v = (mass * shape * run.v).sum(axis=(1, 2)) / (whole * omega)
    return u, v, np.sin(omega * scene.times)


def _mode_measures(
    scene: Scene, run: Run, shape: Floats, what: str, source: str
) -> Iterator[Measure]:
    """Judge the motion of one mode: displacements against a sine, and what is left of it."""
    omega = float(scene.facts["omega"])
    u, v, exact = mode_history(scene, run, shape)
    error = _rms(u, exact)
    yield Measure(
        f"displacement of {what}, relative rms", error, 0.0, error, 0.1, "", source + " sin(w t)"
    )
    last = scene.times > scene.times[-1] - 2.0 * math.pi / omega * 1.01
    left = float(np.sqrt(np.mean(u[last] ** 2 + v[last] ** 2)))
    yield Measure(
        f"amplitude of {what} in the last period", left, 1.0, abs(left - 1.0), 0.1, "", "no damping"
    )


def _times(omega: float, periods: int, each: int = 8) -> Floats:
    return 2.0 * math.pi / (omega * each) * np.arange(1.0, periods * each + 1)


_BAR = elastic(1e5, 0.0, 1000.0)
_LENGTH = 1.0


def _bar_shape(x: Floats) -> Floats:
    shape = np.zeros_like(x)
    shape[:, 0] = np.cos(math.pi * x[:, 0] / _LENGTH)
    return shape


def _judge_bar(scene: Scene, run: Run) -> Iterator[Measure]:
    source = "A cos(pi x / L), w = pi c / L, c = sqrt(E / rho):"
    yield from _mode_measures(scene, run, _bar_shape(scene.x), "the first mode", source)


@case(kind="elastic", dx=1 / 24, ladder=(1 / 8, 1 / 12, 1 / 16, 1 / 24, 1 / 32), judge=_judge_bar)
def bar(dx: float, per_cell: int) -> Scene:
    """Free bar vibrating along itself: speed of the wave, dispersion and damping."""
    thick = 0.25 * _LENGTH
    points = box([0.0, -0.5 * thick, -0.5 * thick], [_LENGTH, thick, thick], dx, per_cell)
    k, c = math.pi / _LENGTH, math.sqrt(_BAR["young_modulus"] / _BAR["density"])
    omega, amplitude = k * c, 1e-3 * _LENGTH / math.pi
    affine = np.zeros((points.shape[0], 3, 3))
    affine[:, 0, 0] = -amplitude * omega * k * np.sin(k * points[:, 0])
    return free(
        "bar", points, amplitude * omega * _bar_shape(points), dx, per_cell, _times(omega, 3), _BAR,
        affine=affine, facts={"omega": omega, "amplitude": amplitude},
    )  # fmt: skip


_SOFT, _STIFF = elastic(5e4, 0.0, 1000.0), elastic(2e5, 0.0, 1000.0)
_HALF = 0.05
_Q = math.atan(math.sqrt(2.0))


def _halves(x: Floats) -> tuple[Floats, Floats]:
    """Displacement and slope of the first mode of the bar of two halves, [N] each."""
    # waves run twice as fast in the stiff half; 2 tan(2 q) = -4 tan(q) has tan q = sqrt 2
    slow, fast = 2.0 * _Q / _HALF, _Q / _HALF
    ratio = math.cos(2.0 * _Q) / math.cos(_Q)
    soft, back = x < _HALF, 2.0 * _HALF - x
    u = np.where(soft, np.cos(slow * x), ratio * np.cos(fast * back))
    slope = np.where(soft, -slow * np.sin(slow * x), ratio * fast * np.sin(fast * back))
    return u, slope


def _over(part: float, whole: float) -> float:
    return part / whole if whole else math.nan


def _judge_halves(scene: Scene, run: Run) -> Iterator[Measure]:
    start = scene.x[:, 0]
    shape = np.zeros_like(scene.x)
    shape[:, 0], _ = _halves(start)
    source = "cos(k1 x), k1 = 2 k2, tan(k2 L / 2) = sqrt 2, w = k2 c2:"
    yield from _mode_measures(scene, run, shape, "the first mode", source)
    # strains of both halves near the joint, each as a multiple of the mode's own slope there
    u = np.tensordot(np.sin(float(scene.facts["omega"]) * scene.times), run.x[..., 0] - start, 1)
    ratio = []
    for low, high in ((0.5, 0.9), (1.1, 1.5)):
        near = (start > low * _HALF) & (start < high * _HALF)
        x = start[near] - start[near].mean()
        ratio.append(_over(float(x @ u[near]), float(x @ shape[near, 0])))
    jump = _over(*ratio)  # not a number where a half has but one layer there, or nothing moved
    yield Measure(
        "traction in the soft half over the stiff one's", jump, 1.0, abs(jump - 1.0), 0.15, "",
        "equal tractions, strains 4 to 1; GaussianBench B1 allows 15 %",
    )  # fmt: skip


@case(
    kind="elastic",
    dx=0.005,
    ladder=(0.02, 0.0125, 0.01, 0.00625, 0.005, 0.004),
    judge=_judge_halves,
)
def two_material_bar(dx: float, per_cell: int) -> Scene:
    """Free bar of a soft and a stiff half (1 to 4) in its first mode: the joint carries it."""
    thick = 0.04
    points = box([0.0, 0.0, 0.0], [2.0 * _HALF, thick, thick], dx, per_cell)
    omega = _Q / _HALF * math.sqrt(_STIFF["young_modulus"] / _STIFF["density"])
    amplitude = 1e-3 * 2.0 * _HALF / math.pi
    u, slope = _halves(points[:, 0])
    velocity, affine = np.zeros_like(points), np.zeros((points.shape[0], 3, 3))
    velocity[:, 0], affine[:, 0, 0] = amplitude * omega * u, amplitude * omega * slope
    return free(
        "two_material_bar", points, velocity, dx, per_cell, _times(omega, 3), (_SOFT, _STIFF),
        affine=affine, material=points[:, 0] > _HALF,
        facts={"omega": omega, "amplitude": amplitude},
    )  # fmt: skip


_BEAM = elastic(5e5, 0.3, 1000.0)
_SIZE = (0.4, 0.05, 0.05)


@functools.cache
def _bending_modes() -> Modes:
    half = [0.5 * s for s in _SIZE]
    # across the beam all sections move as one: even on every axis in y; the rest follows from it
    parity = ((1, 1, 0), (0, 0, 0), (0, 1, 1))
    return modes(box_rule(half, (17, 9, 9)), half, _BEAM, parity, (16, 8, 8))


def _bending(points: Floats) -> tuple[float, Floats, Floats]:
    """Frequency [1/s], shape (1 in the middle) and gradient of the first bending mode."""
    half = [0.5 * s for s in _SIZE]
    found = _bending_modes()
    shape, gradient = found.at(np.vstack([points - half, np.zeros((1, 3))]), 1)
    middle = shape[-1, 1]
    return float(found.omega[1]), shape[:-1] / middle, gradient[:-1] / middle


def _judge_beam(scene: Scene, run: Run) -> Iterator[Measure]:
    shape = _bending(scene.x)[1]
    source = "Ritz (Visscher et al. 1991), 6.8192 Hz; Euler-Bernoulli would be 7.181 Hz:"
    yield from _mode_measures(scene, run, shape, "the first bending mode", source)


@case(kind="elastic", dx=0.05 / 6, ladder=(0.025, 0.05 / 3, 0.0125, 0.05 / 6), judge=_judge_beam)
def beam(dx: float, per_cell: int) -> Scene:
    """Free beam 8 times as long as thick in its first bending mode (body of GaussianBench A2)."""
    points = box([0.0, 0.0, 0.0], _SIZE, dx, per_cell)
    omega, shape, gradient = _bending(points)
    amplitude = 0.02 * _SIZE[1]
    return free(
        "beam", points, amplitude * omega * shape, dx, per_cell, _times(omega, 2), _BEAM,
        affine=amplitude * omega * gradient, facts={"omega": omega, "amplitude": amplitude},
    )  # fmt: skip


_JELLY = elastic(1e5, 0.3, 1000.0)
_RADIUS, _OMEGA, _BREATHS = 0.05, 10.0, 5


@functools.cache
def _breathing() -> tuple[Floats, Floats]:
    """Frequencies [1/s] and shares of the modes that the turning of a ball excites.

    In the turning frame the force rho w^2 (x, y, 0) sets in at once, so that mode k moves as
    F_k (1 - cos(w_k t)) / w_k^2. The share is what it adds to the moment of inertia about the axis
    over that of the ball at rest. Coriolis' force changes w_k by (w / w_k)^2, below 1e-3.
    """
    points, weights = rule = ball_rule(_RADIUS, 9)
    parity = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
    found = modes(rule, (_RADIUS,) * 3, _JELLY, parity, (7, 7, 7))
    density = float(_JELLY["density"])
    flat = points * np.array([1.0, 1.0, 0.0])
    inertia = density * float((weights[:, None] * flat * flat).sum())
    push = np.array(
        [
            density * float((weights[:, None] * flat * found.at(points, k)[0]).sum())
            for k in range(found.omega.shape[0])
        ]
    )
    return found.omega, 2.0 * (_OMEGA * push / found.omega) ** 2 / inertia


def growth_history(scene: Scene, run: Run) -> tuple[Floats, Floats, Floats]:
    """Times [s] of the breathing, growth of the moment of inertia, and its reference."""
    early = scene.times < scene.facts["breathing"]
    mass, x = scene.mass, run.x[early]
    arm = x - (mass @ x / mass.sum())[:, None]
    rate, share = _breathing()
    exact = (share * (1.0 - np.cos(np.outer(scene.times[early], rate)))).sum(axis=1)
    first = float(mass @ (scene.x[:, :2] ** 2).sum(axis=1))
    seen = (arm[..., :2] ** 2).sum(axis=2) @ mass / first - 1.0
    return scene.times[early], seen, exact


def _judge_spin(scene: Scene, run: Run) -> Iterator[Measure]:
    mass = scene.mass
    end = run.x[-1] - mass @ run.x[-1] / mass.sum()
    _, seen, exact = growth_history(scene, run)
    error = _rms(seen, exact)
    source = "modes of a ball by Ritz under centrifugal force"
    yield Measure(
        "growth of the moment of inertia, relative rms", error, 0.0, error, 0.2, "", source
    )
    begun = float((mass[:, None] * np.cross(scene.x, scene.v)).sum(axis=0)[2])
    kept = float((mass[:, None] * np.cross(end, run.v[-1])).sum(axis=0)[2]) / begun
    yield Measure(
        "angular momentum left after a turn", kept, 1.0, abs(kept - 1.0), 1e-3, "",
        "conservation; GaussianBench A1",
    )  # fmt: skip
    x, start = end, scene.x
    sine = float(mass @ (start[:, 0] * x[:, 1] - start[:, 1] * x[:, 0]))
    cosine = float(mass @ (start[:, 0] * x[:, 0] + start[:, 1] * x[:, 1]))
    rate, share = _breathing()
    turn = _OMEGA * scene.seconds
    # the angular momentum stays, the inertia grows: the mean of the growth slows the turn
    exact_turn = turn - _OMEGA * float(
        (share * (scene.seconds - np.sin(rate * scene.seconds) / rate)).sum()
    )
    seen_turn = math.atan2(sine, cosine)
    seen_turn += 2.0 * math.pi * float(np.round((exact_turn - seen_turn) / (2.0 * math.pi)))
    yield Measure(
        "angle turned", seen_turn, exact_turn, abs(seen_turn / exact_turn - 1.0), 1e-3, "rad",
        "angular momentum over moment of inertia",
    )  # fmt: skip


@case(
    kind="elastic", dx=0.05 / 7, ladder=(0.025, 0.05 / 3, 0.0125, 0.01, 0.05 / 7), judge=_judge_spin
)
def spin(dx: float, per_cell: int) -> Scene:
    """Elastic ball turning in empty space: how it widens, what it keeps (GaussianBench A1)."""
    points, volume = ball(_RADIUS, dx, per_cell)
    turn = np.array([[0.0, -_OMEGA, 0.0], [_OMEGA, 0.0, 0.0], [0.0, 0.0, 0.0]])
    slowest = 2.6462 / _RADIUS * math.sqrt(_JELLY["young_modulus"] / 2.6 / _JELLY["density"])
    breathing = _times(slowest, _BREATHS, 4)
    times = np.append(breathing, 2.0 * math.pi / _OMEGA)
    return free(
        "spin", points, points @ turn.T, dx, per_cell, times, _JELLY, volume=volume,
        affine=np.broadcast_to(turn, (points.shape[0], 3, 3)).copy(),
        facts={"radius": _RADIUS, "omega": _OMEGA, "breathing": float(breathing[-1]) * 1.001},
    )  # fmt: skip
