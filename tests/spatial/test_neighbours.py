"""Nearest neighbours are those of a tree."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from gsfluent.spatial.neighbours import nearest, nearest_in_group, nearest_rows


def _cloud(kind: str) -> tuple[torch.Tensor, np.ndarray]:
    random = np.random.default_rng(4)
    if kind == "shell":
        points = random.standard_normal((3000, 3))
        points /= np.linalg.norm(points, axis=1, keepdims=True)
        queries = 1.02 * points[:400] + 0.01 * random.standard_normal((400, 3))
    elif kind == "far":  # queries away from everything, points in two clumps
        points = np.concatenate([random.random((500, 3)), 40.0 + random.random((500, 3))])
        queries = 100.0 * random.random((60, 3)) - 30.0
    else:  # all at one place
        points = np.zeros((50, 3))
        queries = random.random((20, 3))
    return torch.from_numpy(points), queries


@pytest.mark.parametrize("kind", ["shell", "far", "same"])
@pytest.mark.parametrize("count", [1, 12, 50])
@pytest.mark.parametrize("cell", [1e-3, 0.05, 10.0])
def test_cells_find_what_a_tree_finds(kind: str, count: int, cell: float) -> None:
    points, queries = _cloud(kind)
    expected = cKDTree(points.numpy()).query(queries, k=[*range(1, count + 1)])[0]
    distance, index = (torch.from_numpy(x) for x in nearest(points, queries, count, cell))
    np.testing.assert_allclose(distance.numpy(), expected, rtol=1e-9, atol=1e-12)
    reached = (points[index] - torch.from_numpy(queries)[:, None]).norm(dim=2)
    np.testing.assert_allclose(reached.numpy(), distance.numpy(), rtol=1e-9, atol=1e-12)
    assert all(len(set(row.tolist())) == count for row in index)


def test_nothing_asked_nothing_found() -> None:
    points, _ = _cloud("shell")
    distance, index = nearest_rows(points, torch.zeros(0, 3, dtype=torch.float64), 3, 0.1)
    assert distance.shape == (0, 3)
    assert index.shape == (0, 3)


@pytest.mark.parametrize(("count", "cell"), [(0, 1.0), (4000, 1.0), (1, 0.0), (1, float("nan"))])
def test_refusals(count: int, cell: float) -> None:
    points, queries = _cloud("shell")
    with pytest.raises(ValueError, match="nearest"):
        nearest(points, queries, count, cell)


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
def test_groups_are_searched_as_each_by_itself(device: str) -> None:
    make = torch.Generator().manual_seed(7)
    points = torch.rand(900, 3, generator=make)
    points[::3] = (points[::3] * 8).round() / 8  # distances that are the same
    group = torch.randint(0, 40, (900,), generator=make) ** 2
    group[group == 49] = 50
    queries = torch.cat([points[:300], torch.rand(50, 3, generator=make) * 3 - 1])
    wanted = torch.cat([group[:300], torch.randint(0, 40, (50,), generator=make) ** 2])
    count = 30  # more than some groups have
    found = nearest_in_group(*(x.to(device) for x in (points, group, queries, wanted)), count, 0.1)
    distance, index = (x.cpu() for x in found)
    assert (wanted == 49).any()
    for name in wanted.unique().tolist():
        its, mine = (group == name).nonzero()[:, 0], (wanted == name).nonzero()[:, 0]
        k = min(count, len(its))
        assert bool((index[mine, k:] == -1).all())
        assert bool(distance[mine, k:].isinf().all())
        if k:
            apart, rows = nearest_rows(points[its], queries[mine], k, 0.1)
            assert torch.equal(index[mine, :k], its[rows])
            torch.testing.assert_close(distance[mine, :k], apart, rtol=1e-12, atol=0.0)


def test_no_groups_nothing_found() -> None:
    none, nobody = torch.zeros(0, 3), torch.zeros(0, dtype=torch.int64)
    distance, index = nearest_in_group(
        none, nobody, torch.zeros(2, 3), torch.tensor([0, 1]), 3, 1.0
    )
    assert bool(distance.isinf().all()) and bool((index == -1).all())


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
def test_groups_are_searched_within_reach_alone(device: str) -> None:
    make = torch.Generator().manual_seed(3)
    points, queries = torch.rand(300, 3, generator=make), 3 * torch.rand(80, 3, generator=make)
    group, wanted = torch.arange(300) % 4, torch.arange(80) % 5
    asked = [x.to(device) for x in (points, group, queries, wanted)]
    whole, every = (x.cpu() for x in nearest_in_group(*asked, 6, 0.1))
    distance, index = (x.cpu() for x in nearest_in_group(*asked, 6, 0.1, 0.25))
    assert bool((whole < 0.25).any()) and bool((whole > 0.25).any())
    assert torch.equal(distance, torch.where(whole <= 0.25, whole, torch.inf))
    assert torch.equal(index, torch.where(whole <= 0.25, every, -1))


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
@pytest.mark.parametrize("spread", [0.01, 0.5, 4.0, 1e6])
def test_few_queries_find_what_many_find(spread: float, device: str) -> None:
    """Only points near them are asked first; some have to ask all."""
    make = torch.Generator().manual_seed(5)
    points = torch.rand(4000, 3, generator=make)
    queries = 0.5 + spread * (torch.rand(40, 3, generator=make) - 0.5)
    group = torch.arange(4000) % 3
    asked = torch.cat([queries, torch.rand(2000, 3, generator=make)])  # too many to choose
    wanted = torch.arange(2040) % 4  # there is no group 3
    for count in (1, 7):
        everywhere = nearest_rows(points.to(device), asked.to(device), count, 0.02)
        here = nearest_rows(points.to(device), queries.to(device), count, 0.02)
        for whole, some in zip(everywhere, here, strict=True):
            assert torch.equal(some, whole[:40])
        for reach in (0.03, 0.5, float("inf")):
            given = [x.to(device) for x in (points, group, asked, wanted)]
            everywhere = nearest_in_group(*given, count, 0.02, reach)
            few = [x[:40] if n > 1 else x for n, x in enumerate(given)]
            here = nearest_in_group(*few, count, 0.02, reach)
            for whole, some in zip(everywhere, here, strict=True):
                assert torch.equal(some, whole[:40])
