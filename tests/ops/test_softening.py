"""softening_paths: against the same paths step by step with return_mapping, and what it refuses."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.materials import LAWS

ROW = (1e6, 2e6, 1.5, 0.3, 20.0, 0.0, 1000.0, 0.0)


def by_steps(params: Tensor, alpha: Tensor, stretch: Tensor, steps: int) -> tuple[Tensor, Tensor]:
    count = len(params)
    law = torch.full((count,), LAWS["nacc"], dtype=torch.int32)
    strain, stress = torch.zeros(2, count, 6, dtype=torch.float64)
    work, left = torch.zeros_like(alpha), torch.zeros_like(strain)
    spent = torch.full_like(alpha, math.nan)
    increment = torch.zeros(count, 3, 3, dtype=torch.float64)
    increment[:, 0, 0] = torch.expm1(stretch / steps)
    for _ in range(steps):
        before = stress[:, 0]
        strain, alpha, stress, _ = ops.return_mapping(
            strain, alpha, increment, law=law, params=params
        )
        work = work + 0.5 * (before + stress[:, 0]) * stretch / steps
        gone = (alpha >= 0.0) & spent.isnan()
        left, spent = torch.where(gone[:, None], strain, left), torch.where(gone, work, spent)
    return spent, left


def test_paths_are_those_of_the_return_map() -> None:
    params = torch.tensor([ROW] * 12, dtype=torch.float64)
    params[:, 4] = torch.linspace(1.0, 60.0, 12, dtype=torch.float64)
    alpha = torch.linspace(-0.2, -0.01, 12, dtype=torch.float64).flip(0)
    stretch = -4.0 * alpha
    stretch[5] = 1e-6  # too short a path: its strength stays
    found = ops.softening_paths(params, alpha, stretch, steps=150)
    wanted = by_steps(params, alpha, stretch, 150)
    kept = wanted[0].isnan()
    assert bool(kept[5]) and int(kept.sum()) < 6
    assert torch.equal(found[0].isnan(), kept)
    assert torch.equal(found[0][~kept], wanted[0][~kept])
    assert torch.equal(found[1], wanted[1])


def test_what_it_refuses() -> None:
    params, one = torch.tensor([ROW], dtype=torch.float64), torch.full((1,), -0.1).double()
    with pytest.raises(ValueError, match="steps must be at least 1"):
        ops.softening_paths(params, one, -one, steps=0)
    with pytest.raises(ValueError, match="alpha"):
        ops.softening_paths(params, one[:0], -one, steps=4)
    with pytest.raises(TypeError, match="params"):
        ops.softening_paths(params.float(), one, -one, steps=4)
    params[0, 1] = -1.0
    with pytest.raises(ValueError, match="kappa"):
        ops.softening_paths(params, one, -one, steps=4)
    with pytest.raises(NotImplementedError, match="no gradient"):
        grown = torch.tensor([ROW], dtype=torch.float64, requires_grad=True)
        ops.softening_paths(grown, one, -one, steps=4)[0].sum().backward()
