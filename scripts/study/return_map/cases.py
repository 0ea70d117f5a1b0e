"""Scenes and one-particle paths of ``scripts/study/return_map/run.py``, and what is measured."""

from __future__ import annotations

import math
import time
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gsfluent import ops

DX = 1.0 / 32.0
POISSON, FRICTION, HARDENING, ALPHA0, DENSITY = 0.38, 1.85, 3.0, -0.04, 1.0
SPEED, CFL, FLOOR = 6.0, 0.3, 3.0 * DX


class Variant(NamedTuple):
    """One return mapping: how it is called and named; ``law`` 0 is the elastic control."""

    name: str
    k: float = 2.0
    epsilon: float = 0.0
    implicit: bool = False
    law: int = 1

    def options(self) -> dict[str, Any]:
        return {"k": self.k, "epsilon": self.epsilon, "implicit": self.implicit}


CENTRES = {
    "fixed centre": (math.inf, 0.0),
    "k = 2, epsilon = 0 (paper)": (2.0, 0.0),
    "k = 2, epsilon = 0.05": (2.0, 0.05),
    "k = 2, epsilon = 0.1": (2.0, 0.1),
    "k = 2, epsilon = 0.2": (2.0, 0.2),
    "k = 8, epsilon = 0.1": (8.0, 0.1),
}
ELASTIC = Variant("elastic, no yielding", law=0)
VARIANTS = [
    Variant(f"{name}, {'implicit' if implicit else 'explicit'}", k, epsilon, implicit)
    for implicit in (False, True)
    for name, (k, epsilon) in CENTRES.items()
]
DEFAULT = next(v for v in VARIANTS if v[1:4] == (2.0, 0.1, True))


class Scene(NamedTuple):
    """A solid thrown at a floor, until ``until`` seconds or for ``steps`` steps."""

    name: str
    shape: str
    young: float
    cohesion: float
    gravity: float
    until: float = 0.0
    steps: int = 0


# equations.md 7.6: ball of radius 0.2 at 6 m/s; solver.md 0.6: 6 272 particles, 400 steps.
SCENES = {
    "ball": Scene("ball", "ball", 166.0, 0.6, -15.0, until=0.103),
    "ball-weak": Scene("ball-weak", "ball", 166.0, 0.1, -15.0, until=0.103),
    "block": Scene("block", "block", 2000.0, 0.6, -9.81, steps=400),
    "block-weak": Scene("block-weak", "block", 2000.0, 0.1, -9.81, steps=400),
}


def points(shape: str) -> Tensor:
    """Eight per cell, one particle distance above the floor."""
    ticks = torch.arange(0.0, 1.0, 0.5 * DX, dtype=torch.float64) + 0.25 * DX
    x = torch.cartesian_prod(ticks, ticks, ticks)
    if shape == "ball":
        center = torch.tensor([0.5, 0.5, FLOOR + 0.2 + 0.5 * DX], dtype=torch.float64)
        return x[((x - center) ** 2).sum(1) < 0.2**2]
    size = torch.tensor([7.0, 7.0, 16.0], dtype=torch.float64) * DX
    low = torch.tensor([12.0 * DX, 12.0 * DX, FLOOR + 0.5 * DX], dtype=torch.float64)
    return x[((x > low) & (x < low + size)).all(1)]


def params(young: float, cohesion: float, dtype: torch.dtype) -> Tensor:
    """One row of NACC material."""
    strength = {"friction": FRICTION, "cohesion": cohesion, "hardening": HARDENING}
    return ops.material_params(young, POISSON, density=DENSITY, **strength).to(dtype)


def wave_speed(young: float) -> float:
    """Of pressure waves [m/s]."""
    return math.sqrt(young * (1 - POISSON) / ((1 + POISSON) * (1 - 2 * POISSON) * DENSITY))


class Run(NamedTuple):
    """What is left of a thrown solid, in the numbering of :func:`points`."""

    position: Tensor
    alpha: Tensor
    state: ops.MpmState
    dt: float


def throw(
    scene: Scene,
    variant: Variant,
    dtype: torch.dtype,
    *,
    seed: int | None = None,
    place: int = 0,
    refine: int = 1,
    part: float = 1.0,
) -> Run:
    """Throw a solid at the floor; ``seed`` shuffles the particles, ``refine`` divides dt.

    ``place`` moves the solid against the grid; ``part`` < 1 stops after that part of the time.
    """
    x = points(scene.shape) + place * DX * torch.tensor([0.37, 0.21, 0.13], dtype=torch.float64)
    n = len(x)
    order = torch.arange(n)
    if seed is not None:
        order = torch.randperm(n, generator=torch.Generator().manual_seed(seed))
    dt = CFL * DX / (wave_speed(scene.young) + SPEED)
    steps = scene.steps or math.ceil(scene.until / dt)
    dt = scene.until / steps if scene.until else dt
    velocity = torch.zeros(n, 3, dtype=dtype)
    velocity[:, 2] = -SPEED
    floor = torch.zeros(1, 16, dtype=dtype)
    floor[0, [1, 2, 5, 8]] = torch.tensor([2.0, 0.3, FLOOR, 1.0], dtype=dtype)
    volume = torch.full((n,), (0.5 * DX) ** 3, dtype=dtype)
    law = torch.tensor([variant.law], dtype=torch.int32)
    row = params(scene.young, scene.cohesion, dtype)
    alpha = torch.full((n,), ALPHA0, dtype=dtype)
    with torch.no_grad():
        state = ops.mpm_state(x[order].to(dtype), velocity, law=law, params=row, alpha=alpha)
        state = ops.rollout(
            state,
            round(part * steps * refine),
            mass=DENSITY * volume,
            volume=volume,
            dx=DX,
            dt=dt / refine,
            law=law,
            params=row,
            gravity=(0.0, 0.0, scene.gravity),
            colliders=floor,
            **variant.options(),
        )
    back = torch.argsort(order)
    return Run(state.position[back].double(), state.alpha[back].double(), state, dt / refine)


def apart(a: Run, b: Run) -> dict[str, float]:
    """How far two runs of the same particles are apart."""
    return {
        "rms": float((a.position - b.position).square().sum(1).mean().sqrt()) / DX,
        "alpha": float((a.alpha - b.alpha).abs().max()),
        "mean_alpha": float((a.alpha - b.alpha).abs().mean()),
    }


def broken(run: Run) -> float:
    """Fraction of particles without strength."""
    return float((run.alpha >= 0.0).double().mean())


# --- one particle ---

PATHS = {
    "simple shear": [[0.0, 1.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]],
    "isotropic tension": [[1 / 3, 0.0, 0.0], [0.0, 1 / 3, 0.0], [0.0, 0.0, 1 / 3]],
    "uniaxial tension": [[1.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]],
    "deviatoric stretch": [[1.0, 0.0, 0.0], [0.0, -0.5, 0.0], [0.0, 0.0, -0.5]],
    "uniaxial compression": [[-1.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]],
}
STRAIN = 0.6  # logarithmic, or the angle in shear


def path(name: str, variant: Variant, steps: int) -> dict[str, float | None]:
    """Strain at which alpha reaches 0 (None: never), last alpha and last q / mu; flesh, float64."""
    row = params(2000.0, 0.6, torch.float64)
    step = STRAIN / steps * torch.tensor(PATHS[name], dtype=torch.float64)
    increment = torch.matrix_exp(step)[None] - torch.eye(3, dtype=torch.float64)
    law = torch.tensor([1], dtype=torch.int32)
    strain = torch.zeros(1, 6, dtype=torch.float64)
    alpha = torch.full((1,), ALPHA0, dtype=torch.float64)
    stress, fails = strain, None
    for i in range(steps):
        strain, alpha, stress, _ = ops.return_mapping(
            strain, alpha, increment, law=law, params=row, **variant.options()
        )
        if fails is None and float(alpha) >= 0.0:
            fails = STRAIN * (i + 1) / steps
    deviator = stress[0].clone()
    deviator[:3] -= deviator[:3].mean()
    square = (deviator[:3] ** 2).sum() + 2.0 * (deviator[3:] ** 2).sum()
    q = float((1.5 * square).sqrt() / row[0, 0])
    return {"fails": fails, "alpha": float(alpha), "q": q}


# --- speed ---


def speed(state: ops.MpmState, dt: float, variant: Variant, strong: bool) -> dict[str, float]:
    """Process time of one call per particle [ns], least of nine; ``strong`` keeps all elastic."""
    copies = 4
    strain, alpha, affine = (
        t.repeat(copies, *[1] * (t.dim() - 1)) for t in (state.strain, state.alpha, state.affine)
    )
    if strong:
        alpha = torch.full_like(alpha, -10.0)
    arguments = (strain, alpha, dt * affine)
    scene = SCENES["ball"]
    table = {
        "law": torch.tensor([variant.law], dtype=torch.int32),
        "params": params(scene.young, scene.cohesion, strain.dtype),
    }
    best, plastic = math.inf, 0
    for _ in range(9):
        start = time.process_time()
        info = ops.return_mapping(*arguments, **table, **variant.options())[3]
        best = min(best, time.process_time() - start)
        plastic = int(info[0])
    return {"ns": 1e9 * best / len(alpha), "yielding": plastic / len(alpha)}
