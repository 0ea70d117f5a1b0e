"""Order statistics of geometry.py against torch's own."""

from __future__ import annotations

import pytest
import torch

from gsfluent.geometry import ascending, quantiles


@pytest.mark.parametrize("shape", [(1,), (2, 3), (17,), (1000, 3)])
def test_quantiles_are_those_of_torch(shape: tuple[int, ...]) -> None:
    values = torch.randn(shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    shares = (0.0, 0.1, 0.5, 0.95, 1.0)
    want = torch.quantile(values, torch.tensor(shares, dtype=torch.float64), dim=0)
    assert torch.equal(quantiles(values, shares), want)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_ascending_sorts_columns(dtype: torch.dtype) -> None:
    values = torch.randn(500, 4, generator=torch.Generator().manual_seed(2)).to(dtype)
    values[::7] = values[3]  # ties
    before = values.clone()
    assert torch.equal(ascending(values), values.sort(0).values)
    assert torch.equal(values, before)
