"""Links at rest, connected components, and the masses of pieces."""

from __future__ import annotations

import pytest
import torch

from gsfluent.pipeline.matter.fragments import components, mass_shares, rest_links, weigh


def test_links_join_neighbours_of_one_body_only():
    rest = torch.arange(6.0)[:, None] * torch.tensor([1.0, 0.0, 0.0])
    links = rest_links(rest, ((0, 3), (3, 6)), (1.0, 1.0))
    assert sorted(links.tolist()) == [[0, 1], [1, 2], [3, 4], [4, 5]]


def test_components_on_the_device_are_those_of_scipy() -> None:
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    generator = torch.Generator().manual_seed(3)
    for count, links in ((1, 0), (50, 20), (400, 380), (3000, 6000)):
        a = torch.randint(0, count, (links,), generator=generator)
        b = torch.randint(0, count, (links,), generator=generator)
        graph = coo_matrix((torch.ones(links).numpy(), (a.numpy(), b.numpy())), (count, count))
        _, label = connected_components(graph, directed=False)
        first = torch.full((count,), count).scatter_reduce_(
            0, torch.from_numpy(label).long(), torch.arange(count), "amin"
        )
        assert torch.equal(components(a, b, count), first[torch.from_numpy(label).long()])
    # a long chain in the worst order
    chain = torch.randperm(2000, generator=generator)
    assert not components(chain[1:], chain[:-1], 2000).any()


def test_pieces_are_ordered_by_mass_not_by_count() -> None:
    labels = torch.tensor([0, 0, 0, 0, -1, 5, 5])
    pieces = weigh(labels, mass_shares(torch.tensor([1.0, 1, 1, 1, 1, 10, 10])))
    assert pieces.ids.tolist() == [5, 0] and pieces.labels.tolist() == labels.tolist()
    assert pieces.mass_fractions.tolist() == pytest.approx([0.8, 0.16])
    assert pieces.debris_fraction == pytest.approx(0.04) and pieces.largest == pytest.approx(0.8)
