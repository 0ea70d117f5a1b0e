"""Links, components and nearest seeds against plain sweeps, on every device."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.ops.graph import FAR_KEY
from gsfluent.ops.reference import graph as reference

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)]
LAW = {"open": 1.5, "torn": 2.0, "steep": 4.0, "unit": 1024.0, "shift": 24}


def web(seed: int, count: int = 400, links: int = 1500) -> tuple[Tensor, torch.Generator]:
    """Random links of points, some of them twice and some from a point to itself."""
    random = torch.Generator().manual_seed(seed)
    return torch.randint(0, count, (links, 2), generator=random), random


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("seed", range(3))
def test_costs_of_links_round_alike_everywhere(device: str, seed: int) -> None:
    links, random = web(seed)
    rest = torch.rand(400, 3, generator=random, dtype=torch.float64)
    moved = rest * (1.0 + torch.rand(400, 1, generator=random, dtype=torch.float64))
    length = (rest[links[:, 0]] - rest[links[:, 1]]).norm(dim=1)
    marks = [torch.rand(400, generator=random) < share for share in (0.3, 0.1, 0.8, 0.05)]
    before = torch.rand(len(links), generator=random) < 0.1
    spacing = 0.1 + torch.rand(400, generator=random, dtype=torch.float64)
    for gone in (None, marks[3]):
        given = (links, length, spacing, moved, *marks[:3], before, gone)
        want = reference.link_costs(*given, **LAW)
        there = (None if part is None else part.to(device) for part in given)
        got = ops.link_costs(*there, **LAW)
        for a, b in zip(got, want, strict=True):
            assert torch.equal(a.cpu(), b)
        assert 0 < int(want[0].sum()) < len(links) and int((want[1] > 0).sum()) > 100


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("links", [0, 60, 300, 3000])
def test_components(device: str, links: int) -> None:
    for seed in range(3):
        pairs, random = web(seed, links=links)
        apart = torch.rand(links, generator=random) < 0.3
        inside = torch.rand(400, generator=random) < 0.7
        for given in ((None, None), (apart, None), (None, inside), (apart, inside)):
            want = reference.components(pairs, 400, *given)
            there = (None if part is None else part.to(device) for part in given)
            assert torch.equal(ops.components(pairs.to(device), 400, *there).cpu(), want)


@pytest.mark.parametrize("device", DEVICES)
def test_a_chain_is_one_whatever_its_order(device: str) -> None:
    rows = torch.randperm(20_000, generator=torch.Generator().manual_seed(0))
    links = torch.stack([rows[:-1], rows[1:]], dim=1).to(device)
    assert bool((ops.components(links, 20_000) == 0).all())
    key = torch.full((20_000,), FAR_KEY)
    key[rows[0]] = 5
    got = ops.nearest_seeds(
        links, torch.full((19_999,), 3, device=device), key.to(device),
        torch.ones(20_000, dtype=torch.bool, device=device),
    )  # fmt: skip
    assert torch.equal(got.cpu()[rows], 5 + 3 * torch.arange(20_000))


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("seed", range(4))
def test_nearest_seeds_are_shortest_paths(device: str, seed: int) -> None:
    links, random = web(seed, links=900)
    cost = torch.randint(-2, 50, (900,), generator=random) << 24
    key = torch.full((400,), FAR_KEY)
    key[torch.randint(0, 400, (12,), generator=random)] = torch.arange(12)
    other = (torch.rand(400, generator=random) < 0.8) & (key == FAR_KEY)
    want = reference.nearest_seeds(links, cost, key, other)
    got = ops.nearest_seeds(*(part.to(device) for part in (links, cost, key, other)))
    assert torch.equal(got.cpu(), want)
    assert torch.equal(want[~other], key[~other]) and 50 < int((want < FAR_KEY).sum()) < 400


@pytest.mark.parametrize("device", DEVICES)
def test_what_names_no_point_is_no_link(device: str) -> None:
    links = torch.tensor([[0, 1], [-1, 2], [2, 9], [1, 1 << 40]], device=device)
    assert ops.components(links, 4).tolist() == [0, 0, 2, 3]
    key = torch.tensor([0, FAR_KEY, FAR_KEY, FAR_KEY], device=device)
    cost, all_ = torch.ones(4, dtype=torch.int64, device=device), torch.ones_like(key) > 0
    assert ops.nearest_seeds(links, cost, key, all_).tolist() == [0, 1, FAR_KEY, FAR_KEY]
    flat = torch.ones(4, dtype=torch.float64, device=device)
    found = ops.link_costs(
        links, flat, flat, torch.full((4, 3), torch.nan, device=device).double(),
        *[torch.zeros_like(all_)] * 2, all_, torch.zeros_like(all_), **LAW,
    )  # fmt: skip
    # a point at nan is torn from nothing and leads nowhere
    assert not bool(found[0].any()) and not bool(found[1].any()) and not bool(found[2].any())


def test_arguments_are_checked() -> None:
    links, cost = torch.zeros(2, 2, dtype=torch.int64), torch.zeros(2, dtype=torch.int64)
    key, other = torch.zeros(3, dtype=torch.int64), torch.zeros(3, dtype=torch.bool)
    with pytest.raises(TypeError, match="links"):
        ops.components(links.int(), 3)
    with pytest.raises(ValueError, match="count"):
        ops.components(links, -1)
    with pytest.raises(ValueError, match="inside"):
        ops.components(links, 3, inside=other[:2])
    with pytest.raises(ValueError, match="other"):
        ops.nearest_seeds(links, cost, key, other[:2])
    flat, none = torch.ones(3, dtype=torch.float64), torch.zeros(2, dtype=torch.bool)
    given = (links, flat[:2], flat, flat[:, None].repeat(1, 3), other, other, other, none)
    with pytest.raises(ValueError, match="shift"):
        ops.link_costs(*given, **{**LAW, "shift": 31})
    library = torch.ops.gsfluent
    torch.library.opcheck(library.components.default, (links, 3, None, other))
    torch.library.opcheck(library.nearest_seeds.default, (links, cost, key, other))
    numbers = tuple(LAW.values())
    torch.library.opcheck(library.link_costs.default, (*given[:-1], None, none, *numbers))
