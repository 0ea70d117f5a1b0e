"""Motions known at every point: a pulse along a bar, and an affine flow that carries Gaussians."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from ..registry import case
from ..run import Measure, Run
from ..scene import Floats, Scene
from ..shapes import box, elastic, free

_BAR = elastic(5e5, 0.0, 1000.0)
_LENGTH, _WIDTH, _STRAIN = 1.0, 0.25, 1e-3


def _pushed(s: Floats) -> Floats:
    """Integral of the pulse cos^2(pi s / 2 w), |s| < w, from 0; odd in s, [m]."""
    s = np.clip(s, -_WIDTH, _WIDTH)
    return 0.5 * s + 0.5 * _WIDTH / math.pi * np.sin(math.pi * s / _WIDTH)


def _moved(x: Floats, run: float) -> Floats:
    """Displacement at ``x`` once waves have run so far, for a pulse of velocity c at the end 0.

    D'Alembert: half of the pulse and its mirror image beyond each free end go either way.
    """
    total = np.zeros_like(x)
    for image in (-2.0 * _LENGTH, 0.0, 2.0 * _LENGTH):
        total += _pushed(x - image + run) - _pushed(x - image - run)
    return 0.5 * total


def _exact_wave(scene: Scene) -> Floats:
    """Displacement of all points along the bar [m], [T, N]."""
    c, x = float(scene.facts["speed"]), scene.x[:, 0]
    return np.stack([_moved(x, c * t) for t in scene.times]) * float(scene.facts["amplitude"])


def wave_history(scene: Scene, run: Run) -> tuple[Floats, Floats, Floats]:
    """Times [s], mean displacement of the far end [m], and its reference."""
    far = scene.x[:, 0] > 0.95 * _LENGTH
    seen = (run.x[:, far, 0] - scene.x[far, 0]).mean(axis=1)
    return scene.times, seen, _exact_wave(scene)[:, far].mean(axis=1)


def _judge_wave(scene: Scene, run: Run) -> Iterator[Measure]:
    c, amplitude = float(scene.facts["speed"]), float(scene.facts["amplitude"])
    exact, seen = _exact_wave(scene), run.x[..., 0] - scene.x[:, 0]
    error = float(np.sqrt(np.mean((seen - exact) ** 2) / np.mean(exact**2)))
    source = "d'Alembert between free ends, c = sqrt(E / rho)"
    yield Measure("displacement of all points, relative rms", error, 0.0, error, 0.1, "", source)
    # an end is twice as fast as the wave: it moves by the whole integral, half of it on arrival
    _, end, known = wave_history(scene, run)
    half = 0.5 * amplitude * float(_pushed(np.array(_WIDTH)))
    seconds = []
    for history in (end, known):
        rising = np.maximum.accumulate(history)
        reached = np.isfinite(history).all() and rising[-1] > half
        seconds.append(float(np.interp(half, rising, scene.times)) if reached else math.inf)
    got = c * seconds[1] / seconds[0]
    yield Measure(
        "speed of the wave, by half height at the far end", got, c, abs(got / c - 1.0), 0.03, "m/s",
        source + "; GaussianBench A3 allows 15 %",
    )  # fmt: skip


@case(kind="elastic", dx=1 / 48, ladder=(1 / 24, 1 / 32, 1 / 48, 1 / 64), judge=_judge_wave)
def bar_wave(dx: float, per_cell: int) -> Scene:
    """Pulse that leaves one end of a free bar and arrives at the other: speed and dispersion."""
    thick = 1.0 / 12.0
    points = box([0.0, 0.0, 0.0], [_LENGTH, thick, thick], dx, per_cell)
    x = points[:, 0]
    c = math.sqrt(_BAR["young_modulus"] / _BAR["density"])
    inside = x < _WIDTH
    velocity, affine = np.zeros_like(points), np.zeros((points.shape[0], 3, 3))
    velocity[:, 0] = _STRAIN * c * np.where(inside, np.cos(0.5 * math.pi * x / _WIDTH) ** 2, 0.0)
    steep = -0.5 * math.pi / _WIDTH * np.sin(math.pi * x / _WIDTH)
    affine[:, 0, 0] = _STRAIN * c * np.where(inside, steep, 0.0)
    times = np.linspace(0.0, 1.3 * _LENGTH / c, 25)[1:]
    return free(
        "bar_wave", points, velocity, dx, per_cell, times, _BAR, affine=affine,
        facts={"speed": c, "amplitude": _STRAIN},
    )  # fmt: skip


_ALONG, _ACROSS = np.array([2.0, 1.0, 2.0]) / 3.0, np.array([-1.0, 2.0, 0.0]) / math.sqrt(5.0)
_FLOW = 1.5 * np.outer(_ALONG, _ACROSS)
"""Simple shear along no plane of the grid [1/s]. Without stress points fly straight, and of all
affine flows only this kind stays what it is meanwhile: L^2 = 0."""
_SPREAD = np.diag([1.0, 0.25, 0.04])
"""Covariance that every point carries at the start, in any unit of area."""


def _judge_flow(scene: Scene, run: Run) -> Iterator[Measure]:
    source = "x = (I + t L) X, F = I + t L; GaussianBench C1"
    exact = np.eye(3) + scene.times[:, None, None] * _FLOW
    worst = math.inf
    said = "covariance F S F^T, largest error over its size"
    if run.deformation is not None:
        f = run.deformation[-1]
        got = f @ _SPREAD @ f.transpose(0, 2, 1)
        want = exact[-1] @ _SPREAD @ exact[-1].T
        worst = float(np.linalg.norm(got - want, axis=(1, 2)).max() / np.linalg.norm(want))
    else:
        said += " (the run holds no deformation)"
    yield Measure(said, worst, 0.0, worst, 1e-3, "", source)
    place = np.einsum("tij,nj->tni", exact, scene.x)
    error = float(np.sqrt(np.mean((run.x - place) ** 2) / np.mean(place**2)))
    yield Measure("positions, relative rms", error, 0.0, error, 1e-3, "", source)


@case(kind="elastic", dx=0.05, ladder=(0.1, 0.05, 0.025), judge=_judge_flow)
def covariance_transport(dx: float, per_cell: int) -> Scene:
    """Dust in a shear flow askew to the grid: how covariances are carried along."""
    points = box([-0.2, -0.2, -0.2], [0.4] * 3, dx, per_cell)
    # stress is without weight here: 1e-9 of density times velocity squared
    dust = elastic(1e-7, 0.0, 1000.0)
    n = points.shape[0]
    return free(
        "covariance_transport", points, points @ _FLOW.T, dx, per_cell,
        np.linspace(0.0, 1.0, 5)[1:], dust, affine=np.broadcast_to(_FLOW, (n, 3, 3)).copy(),
        asks=("deformation",),
    )  # fmt: skip
