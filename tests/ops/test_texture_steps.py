"""Steps of a texture's synthesis against one operation of torch at a time, on every device."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.ops.reference import texture as reference

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)]


def distributions(seed: int, length: int = 5000) -> tuple[Tensor, Tensor, Tensor]:
    """Values of four parts, quantiles of theirs, and others; one part has equal quantiles."""
    random = torch.Generator().manual_seed(seed)
    values = torch.randn(4, length, 3, generator=random)
    have = torch.randn(4, 65, 3, generator=random).sort(1).values
    have[1, 20:40] = have[1, 20:21]
    values[0, :65] = have[0]  # on a quantile
    return values, have, torch.randn(4, 65, 3, generator=random).sort(1).values


@pytest.mark.parametrize("device", DEVICES)
def test_rows_between_round_as_torch_does(device: str) -> None:
    random = torch.Generator().manual_seed(1)
    ordered = torch.randn(3, 300, 5, generator=random)
    low, high = (torch.randint(0, 300, (3, 65), generator=random) for _ in range(2))
    share = torch.rand(3, 65, generator=random)
    want = reference.rows_between(ordered, low, high, share)
    given = [part.to(device) for part in (ordered, low, high, share)]
    assert torch.equal(ops.rows_between(*given).cpu(), want)
    given[1][1, 2], given[2][2, 3] = 300, -1  # there are no such rows
    holes = ops.rows_between(*given).cpu().isnan()
    assert bool(holes[1, 2].all()) and bool(holes[2, 3].all()) and int(holes.sum()) == 10


@pytest.mark.parametrize("device", DEVICES)
def test_quantile_shifts_round_as_torch_does(device: str) -> None:
    for seed in range(3):
        given = distributions(seed)
        want = reference.quantile_shift(*given)
        got = ops.quantile_shift(*(part.to(device) for part in given)).cpu()
        assert torch.equal(got, want)
        assert not bool(want.isnan().any())


def test_a_distribution_gets_the_quantiles_that_it_is_to_have() -> None:
    values = torch.randn(1, 200001, 1, generator=torch.Generator().manual_seed(3))
    place = torch.linspace(0, 200000, 65).long()
    have = values.sort(1).values[:, place]
    want = torch.linspace(0, 1, 65).reshape(1, 65, 1) ** 2
    moved = (values + ops.quantile_shift(values, have, want)).sort(1).values[:, place]
    assert float((moved - want).abs().max()) < 1e-3  # what 1e-5 a quantile shifts


@pytest.mark.parametrize("device", DEVICES)
def test_votes_are_added_in_the_order_of_places(device: str) -> None:
    random = torch.Generator().manual_seed(7)
    side, edge = 24, 3
    inner = torch.arange(side**2).reshape(side, side)[2:-2, 2:-2].reshape(-1)
    center = inner[torch.randperm(len(inner), generator=random)[:150]]
    window = torch.arange(edge) - edge // 2
    offset = (window[:, None] * side + window).reshape(-1)
    patches = torch.rand(40, edge**2, 3, generator=random)
    best = torch.randint(0, 40, (150,), generator=random)
    weight, falloff = (torch.rand(n, generator=random) for n in (150, edge**2))
    total, share = torch.rand(side**2, 3, generator=random), torch.rand(side**2, generator=random)
    before = total.clone()
    given = (center, offset, best, patches, weight, falloff)
    sums = [part.to(device, copy=True) for part in (total, share)]
    ops.patch_votes(*(part.to(device) for part in given), *sums)
    reference.patch_votes(*given, total, share)
    assert torch.equal(sums[0].cpu(), total) and torch.equal(sums[1].cpu(), share)
    assert not torch.equal(total, before)


@pytest.mark.parametrize("device", DEVICES)
def test_votes_of_what_does_not_exist_are_mute(device: str) -> None:
    center = torch.tensor([0, 3, 9, 50], device=device)
    offset = torch.tensor([-1, 0, 1], device=device)
    best = torch.tensor([0, 7, 0, 0], device=device)
    patches = torch.ones(1, 3, 3, device=device)
    weight, falloff = torch.ones(4, device=device), torch.ones(3, device=device)
    total, share = torch.zeros(10, 3, device=device), torch.zeros(10, device=device)
    ops.patch_votes(center, offset, best, patches, weight, falloff, total, share)
    assert share.tolist() == [1, 1, 0, 0, 0, 0, 0, 0, 1, 1]
    assert torch.equal(total, share[:, None].expand(-1, 3))


def test_bad_input_is_refused() -> None:
    values, have, want = distributions(0, 100)
    with pytest.raises(ValueError, match="want"):
        ops.quantile_shift(values, have, want[:, :64])
    with pytest.raises(ValueError, match="two quantiles"):
        ops.quantile_shift(values, have[:, :1], want[:, :1])
    with pytest.raises(TypeError, match="ordered"):
        ops.rows_between(
            values.double(), *(torch.zeros(4, 2, dtype=torch.int64),) * 2, have[:, :2, 0]
        )
    with pytest.raises(ValueError, match="total"):
        ops.patch_votes(
            *(torch.zeros(2, dtype=torch.int64), torch.zeros(3, dtype=torch.int64)),
            torch.zeros(2, dtype=torch.int64), torch.ones(1, 3, 3), torch.ones(2), torch.ones(3),
            torch.zeros(10, 2), torch.zeros(10),
        )  # fmt: skip
