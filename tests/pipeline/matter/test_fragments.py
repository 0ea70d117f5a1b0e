"""Fragments on graphs whose components are known."""

from __future__ import annotations

import pytest
import torch

from gsfluent.pipeline.matter import fragments
from gsfluent.pipeline.matter.fragments import components, find_fragments, rest_links


def rope(count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Points in a row, one apart, each linked to the next."""
    rest = torch.zeros(count, 3)
    rest[:, 0] = torch.arange(count)
    links = torch.stack([torch.arange(count - 1), torch.arange(1, count)], dim=1)
    return rest, links


def test_an_unbroken_rope_is_one_piece():
    rest, links = rope(10)
    broken = torch.zeros(10, dtype=torch.bool)
    pieces = find_fragments(links, rest, rest, broken, torch.ones(10), smallest=2)
    assert pieces.count == 1 and pieces.largest == 1.0
    assert pieces.labels.tolist() == [0] * 10


def test_a_broken_point_parts_a_rope_and_belongs_to_no_piece():
    rest, links = rope(10)
    broken = torch.zeros(10, dtype=torch.bool)
    broken[6] = True
    pieces = find_fragments(links, rest, rest, broken, torch.ones(10), smallest=2)
    assert pieces.labels.tolist() == [0] * 6 + [-1] + [7] * 3
    assert pieces.ids.tolist() == [0, 7]
    assert pieces.mass_fractions.tolist() == pytest.approx([0.6, 0.3])
    assert pieces.debris_fraction == pytest.approx(0.1)


def test_a_link_stretched_beyond_twice_its_length_is_cut():
    rest, links = rope(6)
    broken = torch.zeros(6, dtype=torch.bool)
    for gap, count in ((0.9, 1), (1.1, 2)):
        position = rest.clone()
        position[3:, 0] += gap
        pieces = find_fragments(links, rest, position, broken, torch.ones(6), smallest=2)
        assert pieces.count == count


def test_small_components_are_debris():
    rest, links = rope(10)
    broken = torch.zeros(10, dtype=torch.bool)
    broken[2] = True
    pieces = find_fragments(links, rest, rest, broken, torch.ones(10), smallest=3)
    assert pieces.labels.tolist() == [-1] * 3 + [3] * 7


def test_pieces_are_ordered_by_mass_not_by_count():
    rest, links = rope(7)
    broken = torch.zeros(7, dtype=torch.bool)
    broken[4] = True
    mass = torch.tensor([1.0, 1, 1, 1, 1, 10, 10])
    pieces = find_fragments(links, rest, rest, broken, mass, smallest=2)
    assert pieces.ids.tolist() == [5, 0]


def test_a_piece_keeps_its_number_when_another_breaks_off():
    rest, links = rope(12)
    broken = torch.zeros(12, dtype=torch.bool)
    broken[4] = True
    before = find_fragments(links, rest, rest, broken, torch.ones(12), smallest=2)
    broken[9] = True
    after = find_fragments(links, rest, rest, broken, torch.ones(12), smallest=2)
    assert before.ids.tolist() == [5, 0]
    assert set(after.ids.tolist()) == {0, 5, 10}
    assert torch.equal(before.labels[:9], after.labels[:9])


def test_links_join_neighbours_of_one_body_only():
    rest, _ = rope(6)
    links = rest_links(rest, ((0, 3), (3, 6)), (1.0, 1.0))
    assert sorted(links.tolist()) == [[0, 1], [1, 2], [3, 4], [4, 5]]


def test_bad_links_are_refused():
    rest, _ = rope(3)
    broken = torch.zeros(3, dtype=torch.bool)
    with pytest.raises(ValueError, match="rows 0 to 2"):
        find_fragments(torch.tensor([[0, 3]]), rest, rest, broken, torch.ones(3))
    with pytest.raises(ValueError, match="mass must have 3 rows"):
        find_fragments(torch.tensor([[0, 1]]), rest, rest, broken, torch.ones(2))


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


def test_pieces_found_on_the_device_are_the_same_pieces() -> None:
    generator = torch.Generator().manual_seed(1)
    rest = torch.rand(2000, 3, generator=generator, dtype=torch.float64)
    links = rest_links(rest, ((0, 2000),), (0.08,))
    broken = (rest[:, 0] - 0.5).abs() < 0.08
    mass = torch.rand(2000, generator=generator) + 0.5
    host = find_fragments(links, rest, rest, broken, mass)
    a, b = links[~(broken[links].any(dim=1))].T
    there = fragments._on_device(a, b, broken, mass, fragments.SMALLEST)
    assert host.count >= 2 and torch.equal(host.labels, there.labels)
    assert torch.equal(host.ids, there.ids)
    assert torch.allclose(host.mass_fractions, there.mass_fractions, atol=1e-9)
    assert abs(host.debris_fraction - there.debris_fraction) < 1e-8
