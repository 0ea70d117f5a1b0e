"""Different rows of a table: those of torch.unique, in its order."""

from __future__ import annotations

import pytest
import torch

from gsfluent.pipeline.matter.brittle import distinct_rows


@pytest.mark.parametrize("seed", range(4))
def test_rows_and_order_are_those_of_unique(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    table = torch.randint(-3, 3, (500, 5), generator=generator).double() * 0.37
    table[:, 2] = 1e-300  # a column of one value
    rows, which = distinct_rows(table)
    wanted, inverse = torch.unique(table, dim=0, return_inverse=True)
    assert torch.equal(rows, wanted) and torch.equal(which, inverse)
    assert torch.equal(rows[which], table)


def test_one_row() -> None:
    rows, which = distinct_rows(torch.tensor([[1.0, 2.0]] * 3))
    assert rows.tolist() == [[1.0, 2.0]] and which.tolist() == [0, 0, 0]
