"""Range of the solver's fixed-point sums on a GPU: docs/theory/solver-sums.md in numbers.

The units come from where they are made, the clock of a primed solver; the sums are those of
``gsfluent/ops/reference/fixed_point.py``, whose constants must be the ones of the kernel.
"""

from __future__ import annotations

import re
from fractions import Fraction
from pathlib import Path
from typing import Any

import pytest
import torch
from solver_scenes import DX, cube, elastic_row

from gsfluent import ops
from gsfluent.ops.reference import fixed_point as fixed
from gsfluent.ops.solver_buffers import MAX_HOME

CUDA = Path(__file__).parents[2] / "csrc" / "cuda"
KERNEL = "\n".join(p.read_text(encoding="utf-8") for p in sorted(CUDA.glob("solver/*")))
WEIGHT = Fraction(3, 4) ** 3
"""Largest weight of a quadratic B-spline in three dimensions."""


def points(spread: float, speed: float, seed: int = 0) -> dict[str, Any]:
    """Arguments of Solver: a strained cube of points whose masses differ by up to ``spread``."""
    position = cube(5, (0.0, 0.0, 0.0), seed=seed)
    n, generator = position.shape[0], torch.Generator().manual_seed(seed)
    mass = (1e-3 * spread ** torch.rand(n, generator=generator)).log2().round().exp2()
    return {
        "position": position,
        "velocity": speed * torch.randn(n, 3, generator=generator),
        "mass": mass,
        "volume": torch.full((n,), DX**3 / 8),
        "strain": 0.05 * torch.randn(n, 6, generator=generator),
        "affine": 0.3 * speed / DX * torch.randn(n, 3, 3, generator=generator),
        "dx": DX,
        "law": torch.zeros(1, dtype=torch.int32),
        "params": torch.tensor([elastic_row(1e6)]),
    }


def primed(given: dict[str, Any]) -> tuple[fixed.Transfer, dict[str, float]]:
    """What the points give in the first step, and the clock of that step."""
    solver = ops.Solver(**given)
    stress = solver.stress
    solver.advance(steps=1)
    clock = solver.clock()
    what = [given[name] for name in ("position", "velocity", "affine")]
    moved = fixed.transfer(
        *what, stress, given["mass"], given["volume"], dx=DX, dt=clock["dt"]
    )  # fmt: skip
    return moved, clock


def test_the_constants_are_those_of_the_kernel() -> None:
    def found(pattern: str) -> float:
        match = re.search(pattern, KERNEL)
        assert match, f"{pattern} is not in csrc/cuda/solver"
        return float(match.group(1))

    assert found(r"Fixed<float> \{[^}]*kBits = (\d+);") == fixed.WINDOW_BITS
    assert found(r"\(s\.home_bound\[home\], ([\d.]+), count") == fixed.MOMENTUM_SHARE
    assert found(r"\(s\.home_mass\[home\], ([\d.]+), count") == fixed.MASS_SHARE


@pytest.mark.parametrize("spread", [1.0, 1e6])
@pytest.mark.parametrize("speed", [1e-6, 3.0, 4e4])
def test_whole_numbers_hold_what_points_give(spread: float, speed: float) -> None:
    """No sum overflows, and each differs from the exact one by no more than the rounding."""
    given = points(spread, speed)
    t, clock = primed(given)
    sums = fixed.node_sums(t, clock["momentum_unit"], clock["mass_unit"])
    error = (sums.fixed - sums.exact).abs()
    assert bool((error <= sums.slack).all())
    assert bool((error[:, 3] > 0).any())  # whole numbers indeed
    # Of the whole, rounding leaves far less: it errs in both directions.
    if spread == 1.0:
        scale = torch.tensor([float(t.bound.sum())] * 3 + [float(given["mass"].sum())])
        assert bool(((sums.fixed - sums.exact).sum(dim=0).abs() < 1e-7 * scale).all())


@pytest.mark.parametrize("slow", [1.0, 1e-3, 1e-5, 1e-7, 1e-9])
@pytest.mark.parametrize("light", [1.0, 1e-6])
def test_who_takes_a_point_changes_no_sum(slow: float, light: float) -> None:
    """Two CTAs share a home, and which takes a point is chance: their halves add up exactly."""
    given = points(1.0, 3.0)
    half = given["position"][:, 0] > 2.5 * DX  # a part of the body is slower, a part lighter
    for name in ("velocity", "affine", "strain"):
        given[name][half] *= slow
    given["mass"][half] *= light
    given["volume"][half] *= light
    t, clock = primed(given)
    units = clock["momentum_unit"], clock["mass_unit"]
    whole = fixed.node_sums(t, *units)
    for seed in range(3):
        chance = torch.Generator().manual_seed(seed)
        part = torch.randint(2, t.home.shape, generator=chance)
        assert torch.equal(fixed.node_sums(t, *units, part).fixed, whole.fixed)


@pytest.mark.parametrize("spread", [1.0, 1e6])
@pytest.mark.parametrize("speed", [1e-6, 3.0, 4e4])
def test_the_clock_knows_the_largest_addend(spread: float, speed: float) -> None:
    t, clock = primed(points(spread, speed))
    room = clock["momentum_unit"] * 2.0 ** clock["unit_bits"]
    largest = float(t.bound.max())
    assert largest < room <= 2.0001 * largest
    addend = (t.weight[..., None] * t.given).abs()
    assert float(addend[..., :3].max()) < float(WEIGHT) * room
    # Rounding of the bound itself: (3/4)^3 of it is less than the share that the unit has room for.
    assert bool((addend[..., :3].amax(dim=(1, 2)) <= fixed.MOMENTUM_SHARE * t.bound).all())
    assert float(WEIGHT) * (1.0 + 1e-5) < fixed.MOMENTUM_SHARE <= fixed.MASS_SHARE


@pytest.mark.parametrize("count", [1, 2, 7, 2381, 2382, 40_000])
def test_all_points_at_one_node_with_the_largest_momentum_fit(count: int) -> None:
    """The worst that a state can do: all points half-way between nodes, all with the bound."""
    velocity, mass = 7.0, 2.0**-10
    solver = ops.Solver(
        torch.full((count, 3), 3.0 * DX, dtype=torch.float64),
        torch.full((count, 3), velocity),
        torch.full((count,), mass),
        torch.full((count,), DX**3 / 8),
        dx=DX, law=torch.zeros(1, dtype=torch.int32), params=torch.tensor([elastic_row(1e6)]),
        gravity=(0.0, 0.0, 0.0), frame=(0.0, 0.0, 0.0),
    )  # fmt: skip
    solver.advance(steps=1)
    clock = solver.clock()
    bound, half = Fraction(velocity) * Fraction(mass), Fraction(1, 2)
    up = fixed.ROUNDED_UP
    window = fixed.window_unit(float(bound) * up, fixed.MOMENTUM_SHARE, count)
    heavy = fixed.window_unit(mass * up, fixed.MASS_SHARE, count)
    for given, unit, word in (
        (bound, window, 31),
        (Fraction(mass), heavy, 31),
        (bound, clock["momentum_unit"], 63),
        (Fraction(mass), clock["mass_unit"], 63),
    ):
        # The sum of all windows is that of all points and of half a window's unit for each.
        slack = half + half * Fraction(window) / Fraction(unit) if word == 63 else half
        largest = count * (WEIGHT * given / Fraction(unit) + slack)
        assert largest < 2**word
        # And no digits are given away: eight times the range would not be needed.
        if word == 31 or clock["unit_bits"] < 52:
            assert largest > 2 ** (word - 5)


def test_the_most_points_of_a_home_fit_into_a_window() -> None:
    for share in (fixed.MOMENTUM_SHARE, fixed.MASS_SHARE):
        all_words = WEIGHT / Fraction(share) * 2**fixed.WINDOW_BITS
        assert all_words + Fraction(MAX_HOME, 2) < 2**31


def test_light_points_beside_heavy_ones_keep_their_velocity() -> None:
    """The figure of docs/theory/solver-sums.md for a jump of 1000 in the mass of points."""
    given = points(1.0, 0.01)
    light = given["position"][:, 0] < 0.05
    given["mass"] = torch.where(light, 1e-6, 1e-3)
    given["velocity"] = given["velocity"] + torch.tensor([3.0, 2.0, -1.0])
    given["strain"] = 0.0 * given["strain"]
    t, clock = primed(given)
    sums = fixed.node_sums(t, clock["momentum_unit"], clock["mass_unit"])
    wrong = sums.gathered(t.weight, sums.fixed) - sums.gathered(t.weight, sums.exact)
    error = wrong.norm(dim=1) / 14.0**0.5
    assert 1e-7 < float(error[light].square().mean().sqrt()) < 5e-4
    assert float(error[~light].square().mean().sqrt()) < 1e-5
