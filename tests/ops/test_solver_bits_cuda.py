"""The same bits from the resident solver on a GPU, where speeds are mixed and homes are shared.

Below 600 000 points two CTAs share a home and chance decides which of them takes a point. A home
whose own unit is finer than the step's (all of it is 10^-6 and less of the fastest point) must
hand over exactly all the same (docs/theory/solver-sums.md).
"""

from __future__ import annotations

from typing import Any

import pytest
import torch
from solver_scenes import DX, cube, elastic_row
from torch import Tensor

from gsfluent import has_cuda, ops

pytestmark = [
    pytest.mark.cuda,
    pytest.mark.skipif(not has_cuda(), reason="needs a GPU and gsfluent's CUDA kernels"),
]
SPEED = 10.0
STEPS = 20
REPEATS = 5
NAMES = ("position", "velocity", "affine", "strain")


def two_bodies(slow: float, points: int = 2 * 55_296, *, colliders: bool = False) -> dict[str, Any]:
    """Arguments of Solver: one cube at 10 m/s, one with random velocities of ``slow`` of that.

    Args:
        slow: Speed of the second cube over that of the first.
        points: Points in all; those beyond the first of each cube are left out.
        colliders: A plane under both cubes and a sphere under the fast one, hit at once.
    """
    cells = 1
    while 16 * cells**3 < points:
        cells += 1
    edge = cells * DX
    parts = [
        cube(cells, (0.0, 0.0, 0.0), seed=0)[: points - points // 2],
        cube(cells, (edge + 0.3, 0.0, 0.0), seed=1)[: points // 2],
    ]
    position = torch.cat(parts)
    n, first = len(position), len(parts[0])
    generator = torch.Generator().manual_seed(2)
    velocity = SPEED * slow * torch.randn(n, 3, generator=generator)
    velocity[:first] = torch.tensor([0.0, 0.0, -SPEED])
    rows = None
    if colliders:
        low = [0.0, 0.0, 0.5 * DX]
        ball = [0.1, 0.1, -0.02]
        rows = torch.stack(
            [
                ops.collider_row("plane", point=low, friction=0.3),
                ops.collider_row("sphere", point=ball, radius=0.05, friction=0.3),
            ]
        ).float()
    given = {
        "position": position,
        "velocity": velocity,
        "mass": torch.full((n,), 1000.0 * DX**3 / 8),
        "volume": torch.full((n,), DX**3 / 8),
        "law": torch.zeros(1, dtype=torch.int32),
        "params": torch.tensor([elastic_row(1e6)]),
        "body": (torch.arange(n) >= first).to(torch.int32),
        "colliders": rows,
    }
    moved = {k: v.cuda() if isinstance(v, Tensor) else v for k, v in given.items()}
    # a grid that rests: only there do slow points keep all digits of their velocity
    return moved | {"dx": DX, "gravity": (0.0, 0.0, 0.0), "frame": None if colliders else (0, 0, 0)}


def bits(given: dict[str, Any], steps: int, back: Tensor | None = None) -> list[Tensor]:
    """The state after some steps, in the order of the unshuffled points, and the impulses."""
    solver = ops.Solver(**given)
    solver.advance(steps=steps)
    values = [getattr(solver, name) for name in NAMES]
    return [v if back is None else v[back] for v in values] + [solver.impulse]


def shuffled(given: dict[str, Any], seed: int) -> tuple[dict[str, Any], Tensor]:
    """The points in another order, and where each of the old order is."""
    n = given["position"].shape[0]
    order = torch.randperm(n, generator=torch.Generator().manual_seed(seed)).cuda()
    mixed = {
        k: v[order] if isinstance(v, Tensor) and v.shape[:1] == (n,) else v
        for k, v in given.items()
    }
    return mixed, order.argsort()


def assert_same(given: dict[str, Any], steps: int, repeats: int) -> None:
    first = bits(given, steps)
    assert all(bool(torch.isfinite(v).all()) for v in first)
    runs = [bits(given, steps) for _ in range(repeats - 1)]
    mixed, back = shuffled(given, seed=3)
    runs.append(bits(mixed, steps, back))
    for run in runs:
        for name, value, want in zip((*NAMES, "impulse"), run, first, strict=True):
            differs = int((value != want).flatten(1).any(1).sum())
            assert differs == 0, f"{name} of {differs} rows"


@pytest.mark.parametrize("slow", [1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9])
def test_mixed_speeds(slow: float) -> None:
    given = two_bodies(slow)
    assert given["position"].shape[0] == 2 * 55_296
    assert_same(given, STEPS, REPEATS)


@pytest.mark.parametrize("slow", [1e-3, 1e-6, 1e-9])
def test_mixed_speeds_with_colliders(slow: float) -> None:
    given = two_bodies(slow, colliders=True)
    assert_same(given, STEPS, REPEATS)
    solver = ops.Solver(**given)
    solver.advance(steps=STEPS)
    assert bool((solver.impulse.norm(dim=1) > 0).all())  # both were hit


@pytest.mark.parametrize("points", [599_999, 600_001])
def test_where_homes_cease_to_be_shared(points: int) -> None:
    given = two_bodies(1e-6, points)
    assert given["position"].shape[0] == points
    assert_same(given, 4, 3)


def test_slow_matter_keeps_its_velocity() -> None:
    """2^-46 of the fastest point's momentum is the unit here: 10^-8 of its speed has 19 bits."""
    given = two_bodies(1e-8)
    own = given["body"] == 1
    alone = {
        k: v[own] if isinstance(v, Tensor) and v.shape[:1] == own.shape else v
        for k, v in given.items()
    } | {"body": None}
    both, one = (ops.Solver(**arguments, dt=1e-4) for arguments in (given, alone))
    for solver in (both, one):
        solver.advance(steps=5)
    want = one.velocity.double()
    wrong = both.velocity[own].double() - want
    assert float(wrong.square().mean().sqrt()) < 1e-4 * float(want.square().mean().sqrt())
