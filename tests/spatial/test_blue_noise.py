"""Blue noise of a jet: even, without rows, the same for the same seed."""

from __future__ import annotations

import math

import pytest
import torch

from gsfluent.spatial.blue_noise import blue_cylinder
from gsfluent.spatial.neighbours import nearest_rows

STEP = 0.002


@pytest.mark.parametrize(("radius", "length"), [(0.012, 0.06), (0.05, 0.012), (0.004, 0.1)])
def test_shares_are_equal_and_nobody_is_near(radius: float, length: float) -> None:
    points = blue_cylinder(radius, length, STEP, seed=3)
    assert points.shape[0] == round(math.pi * radius**2 * length / STEP**3)
    across = points[:, :2].norm(dim=1)
    assert float(across.max()) <= radius and float(points[:, 2].abs().max()) <= 0.5 * length
    distance = nearest_rows(points, points, 2, STEP)[0][:, 1] / STEP
    assert float(distance.min()) > 0.7 and float(distance.mean()) > 0.9
    half = (across < radius * math.sqrt(0.5)).double().mean()
    assert float(half) == pytest.approx(0.5, abs=0.06)
    below = (points[:, 2] < 0.0).double().mean()
    assert float(below) == pytest.approx(0.5, abs=0.03)


def test_every_slice_is_another() -> None:
    points = blue_cylinder(0.012, 0.1, STEP, seed=0)
    cell = torch.floor(points[:, :2] / (0.25 * STEP)).long()
    # A lattice of the same points stands in one of 16 such cells.
    seen = torch.unique(cell, dim=0).shape[0] / (math.pi * 0.012**2 / (0.25 * STEP) ** 2)
    assert seen > 0.75


def test_seed_is_all_it_hangs_on() -> None:
    a, b, other = (blue_cylinder(0.01, 0.03, STEP, seed) for seed in (5, 5, 6))
    assert torch.equal(a, b) and not torch.equal(a, other)
