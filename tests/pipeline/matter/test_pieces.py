"""Pieces of broken bodies on graphs whose pieces are known, and that nothing depends on order."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from torch import Tensor

from gsfluent.pipeline.matter.fragments import rest_links
from gsfluent.pipeline.matter.pieces import Pieces, Web, dust_limit, find_pieces


def web_of(
    rest: Tensor, links: Tensor, *, dust: float = 1.0, mass: Tensor | None = None, h: float = 1.0,
    stiff: bool = False,
) -> Web:  # fmt: skip
    """One body that can break."""
    count = rest.shape[0]
    return Web(
        links, rest, torch.zeros(count, dtype=torch.int64), torch.tensor([h]).double(),
        torch.ones(count) if mass is None else mass, torch.zeros(count, dtype=torch.bool),
        torch.tensor([True]), torch.tensor([dust]).double(), torch.tensor([stiff]),
    )  # fmt: skip


def rope(count: int) -> Web:
    """Points in a row, one apart, each linked to the next."""
    rest = torch.zeros(count, 3)
    rest[:, 0] = torch.arange(count)
    return web_of(rest, torch.stack([torch.arange(count - 1), torch.arange(1, count)], dim=1))


def look(web: Web, broken: list[int], position: Tensor | None = None, least: int = 2) -> Pieces:
    mark = torch.zeros(web.rest.shape[0], dtype=torch.bool)
    mark[broken] = True
    cut = torch.zeros(web.links.shape[0], dtype=torch.bool)
    return find_pieces(web, web.rest if position is None else position, mark, cut, least=least)


def block(side: int = 14, seed: int = 0) -> tuple[Web, Tensor, Tensor]:
    """A jittered cube of points with three broken, opened layers: web, places now, broken."""
    generator = torch.Generator().manual_seed(seed)
    axis = torch.arange(side, dtype=torch.float64)
    rest = torch.cartesian_prod(axis, axis, axis)
    rest = rest + 0.5 * (torch.rand(rest.shape, generator=generator, dtype=torch.float64) - 0.5)
    rest = rest.float()
    count = rest.shape[0]
    web = web_of(rest, rest_links(rest, ((0, count),), (1.0,)))
    normals = torch.nn.functional.normalize(torch.randn(3, 3, generator=generator), dim=1)
    away = (rest - 0.5 * side) @ normals.T
    broken = (away.abs() < 1.2).any(dim=1)
    # Each of the eight sectors moves outwards; the bands open where they are crossed.
    position = rest.double() + 1.3 * torch.tanh(away.double()) @ normals.double()
    return web, position, broken


def test_an_unbroken_body_is_one_piece_whatever_its_size() -> None:
    for count in (1, 10, 100):
        pieces = look(rope(count), [], least=64)
        assert pieces.unit.tolist() == [0] * count == pieces.fragments.labels.tolist()
        assert pieces.fragments.count == 1 and pieces.fragments.largest == 1.0


def test_a_small_body_that_breaks_keeps_its_larger_part() -> None:
    pieces = look(rope(20), [6], least=64)
    assert pieces.fragments.labels.tolist() == [7] * 20


@pytest.mark.parametrize(
    "normal", [(1.0, 0, 0), (1.0, 1, 0), (1.0, 1, 1), (0.92, 0.38, 0), (0.3, 0.5, 0.8)]
)
def test_a_border_knows_no_axes(normal: tuple[float, float, float]) -> None:
    """Through a flat band of four spacings, at any angle to the lattice of points."""
    axis = torch.arange(-9.5, 10.0, dtype=torch.float64)
    rest = torch.cartesian_prod(axis, axis, axis)
    rest = rest[rest.norm(dim=1) < 10.0].float()
    n = torch.nn.functional.normalize(torch.tensor(normal, dtype=torch.float64), dim=0)
    away = rest.double() @ n + 0.2
    web = web_of(rest, rest_links(rest, ((0, len(rest)),), (1.0,)))
    position = rest.double() + away.clamp(-0.5, 0.5)[:, None] * n
    pieces = find_pieces(
        web, position, away.abs() < 2.0, torch.zeros(len(web.links), dtype=torch.bool), least=64
    )
    assert pieces.fragments.count == 2
    beside = pieces.unit[web.links]
    middle = rest.double()[web.links[beside[:, 0] != beside[:, 1]]].mean(dim=1)
    spread = middle - middle.mean(dim=0)
    found = torch.linalg.eigh(spread.T @ spread)[1][:, 0]
    assert math.degrees(math.acos(min(1.0, float((found @ n).abs())))) < 1.0
    assert abs(float((middle @ n).mean()) + 0.2) < 0.5


def test_a_broken_point_belongs_to_the_piece_it_lies_closer_to() -> None:
    """A crack that has not opened parts two seeds; the border lies where the band opened most."""
    web = rope(12)
    for place in (5, 6):
        position = web.rest.double().clone()
        position[place:, 0] += 0.4  # opened, not torn
        pieces = look(web, [5], position)
        labels = pieces.fragments.labels.tolist()
        assert labels == [0] * place + [6] * (12 - place)
        assert pieces.cut_links.nonzero()[:, 0].tolist() == [place - 1]
        assert pieces.fragments.debris_fraction == pytest.approx(0.0, abs=1e-9)


def test_a_link_is_cut_at_half_as_far_again_where_broken_and_twice_as_far_elsewhere() -> None:
    web = rope(8)
    for gap, broken, cut in ((0.45, [3], False), (0.55, [3], True), (0.95, [], False),
                             (1.05, [], True)):  # fmt: skip
        position = web.rest.double().clone()
        position[4:, 0] += gap
        found = look(web, broken, position, least=3)
        assert bool(found.cut_links[3]) == (cut or bool(broken))
        assert found.fragments.count == (2 if broken or cut else 1)


def test_a_cut_outlives_its_cause() -> None:
    web = rope(8)
    position = web.rest.double().clone()
    position[4:, 0] += 0.55
    broken = torch.zeros(8, dtype=torch.bool)
    broken[3] = True
    first = find_pieces(web, position, broken, torch.zeros(7, dtype=torch.bool), least=3)
    healed = torch.zeros(8, dtype=torch.bool)
    again = find_pieces(web, web.rest, healed, first.cut_links, least=3)
    assert again.fragments.count == 2 and torch.equal(again.cut_links, first.cut_links)
    labels = torch.tensor([0] * 4 + [4] * 4)
    assert torch.equal(again.unit, labels)


def test_what_nothing_reaches_is_chip_or_dust_by_its_size() -> None:
    web = rope(48)
    position = web.rest.double().clone()
    # Twenty stay; then eight, a cell of them, seven, one and the rest fly off, each far away.
    for start, shift in ((20, 40.0), (28, 90.0), (35, 140.0), (36, 190.0)):
        position[start:, 1] += shift
    pieces = look(web, [], position, least=12)
    labels = pieces.fragments.labels.tolist()
    assert labels == [0] * 20 + [-1] * 16 + [36] * 12
    assert pieces.chip.nonzero()[:, 0].tolist() == list(range(20, 28))
    assert pieces.unit[20:28].tolist() == [20] * 8
    assert pieces.dust.nonzero()[:, 0].tolist() == list(range(28, 36))
    assert not pieces.unit[28:36].ge(0).any()


def test_bits_that_move_with_their_piece_belong_to_it() -> None:
    web, _, broken = block()
    alone = torch.zeros_like(broken)
    alone[len(alone) // 2] = True
    a, b = web.links.unbind(dim=1)
    cut = alone[a] | alone[b]
    still = find_pieces(web, web.rest, alone, cut)
    assert still.fragments.count == 1 and not still.dust.any()
    # turned and moved as a whole it is the same
    angle = 0.7
    turn = torch.tensor(
        [[math.cos(angle), -math.sin(angle), 0.0], [math.sin(angle), math.cos(angle), 0.0],
         [0.0, 0.0, 1.0]], dtype=torch.float64)  # fmt: skip
    moved = web.rest.double() @ turn.T + torch.tensor([40.0, -3.0, 9.0], dtype=torch.float64)
    assert not find_pieces(web, moved, alone, cut).dust.any()
    moved[alone] += 30.0
    flown = find_pieces(web, moved, alone, cut)
    assert torch.equal(flown.dust, alone) and flown.fragments.labels[alone].tolist() == [-1]


def test_dust_is_bounded_and_the_surplus_joins_its_piece() -> None:
    web, _, _ = block()
    count = web.rest.shape[0]
    powder = (web.rest[:, 2] > 11.4).nonzero()[:, 0]
    powder = powder[::4]
    broken = torch.zeros(count, dtype=torch.bool)
    broken[powder] = True
    a, b = web.links.unbind(dim=1)
    cut = broken[a] | broken[b]
    position = web.rest.double().clone()
    position[powder, 0] += 1.7  # beyond the piece's rigid motion, beside its matter
    for share in (0.0, 0.05, 0.2):
        part = dataclasses.replace(web, dust=torch.tensor([share]).double())
        pieces = find_pieces(part, position, broken, cut)
        loose = float(pieces.dust.sum()) / count
        largest = torch.tensor([int((pieces.unit == pieces.fragments.ids[0]).sum())])
        limit = float(dust_limit(part.dust, torch.tensor([count - len(powder)])))
        assert loose <= limit and int(largest) > 0.8 * count
        assert (loose == 0.0) if share == 0.0 else (loose > 0.0)
        # What has left before counts.
        gone = pieces.dust
        again = find_pieces(part, position, broken, cut, gone=gone)
        assert torch.equal(again.dust, gone)
    flown = position.clone()
    flown[powder] += 50.0
    none = dataclasses.replace(web, dust=torch.zeros(1, dtype=torch.float64))
    assert int(find_pieces(none, flown, broken, cut).dust.sum()) == len(powder)


def test_the_bound_on_dust_falls_with_the_size_of_the_pieces() -> None:
    # An octave in size costs a factor of 2^(-1/2): eight times the points.
    limits = dust_limit(torch.ones(2).double(), torch.tensor([1000, 8000]))
    assert float(limits[0] / limits[1]) == pytest.approx(math.sqrt(2.0))


def shuffled(
    web: Web, position: Tensor, broken: Tensor, order: Tensor
) -> tuple[Web, Tensor, Tensor]:
    place = torch.empty_like(order)
    place[order] = torch.arange(len(order))
    links = place[web.links]
    links = links[torch.randperm(len(links), generator=torch.Generator().manual_seed(5))]
    links = torch.stack([links.amin(dim=1), links.amax(dim=1)], dim=1)
    return web_of(web.rest[order], links), position[order], broken[order]


def canonical(labels: Tensor) -> Tensor:
    """Each label as the first row that has it; -1 stays."""
    ids, index = torch.unique(labels, return_inverse=True)
    rows = torch.arange(len(labels))
    first = torch.full_like(ids, len(labels)).scatter_reduce(0, index, rows, "amin")
    return torch.where(labels < 0, labels, first[index])


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_order_of_the_points_changes_nothing(seed: int) -> None:
    web, position, broken = block(seed=seed)
    cut = torch.zeros(web.links.shape[0], dtype=torch.bool)
    found = find_pieces(web, position, broken, cut)
    assert found.fragments.count >= 4
    assert float((found.fragments.labels >= 0).double().mean()) > 0.97
    order = torch.randperm(len(broken), generator=torch.Generator().manual_seed(seed + 9))
    other, now, mark = shuffled(web, position, broken, order)
    again = find_pieces(other, now, mark, cut)
    for name in ("unit", "dust", "chip"):
        one, two = getattr(found, name), torch.empty_like(getattr(found, name))
        two[order] = getattr(again, name)
        if name == "unit":
            two = torch.where(two < 0, two, order[two.clamp(min=0)])
            assert torch.equal(canonical(one), canonical(two))
        else:
            assert torch.equal(one, two)
    assert sorted(found.fragments.mass_fractions.tolist()) == pytest.approx(
        sorted(again.fragments.mass_fractions.tolist()), abs=1e-12
    )


def test_the_number_of_threads_changes_nothing() -> None:
    web, position, broken = block()
    cut = torch.zeros(web.links.shape[0], dtype=torch.bool)
    before = torch.get_num_threads()
    found = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        found.append(find_pieces(web, position, broken, cut))
    torch.set_num_threads(before)
    assert torch.equal(found[0].unit, found[1].unit)
    assert torch.equal(found[0].cut_links, found[1].cut_links)


@pytest.mark.cuda
@pytest.mark.parametrize("seed", [0, 1])
def test_a_gpu_finds_the_same_pieces(seed: int) -> None:
    web, position, broken = block(seed=seed)
    cut = torch.zeros(web.links.shape[0], dtype=torch.bool)
    host = find_pieces(web, position, broken, cut)
    there = Web(*(getattr(web, field.name).cuda() for field in dataclasses.fields(web)))
    device = find_pieces(there, position.cuda(), broken.cuda(), cut.cuda())
    for name in ("unit", "dust", "chip", "cut_links"):
        assert torch.equal(getattr(host, name), getattr(device, name).cpu()), name
    assert torch.equal(host.fragments.ids, device.fragments.ids)


def test_bad_links_are_refused() -> None:
    web = rope(3)
    with pytest.raises(ValueError, match="rows 0 to 2"):
        look(dataclasses.replace(web, links=torch.tensor([[0, 3]])), [])
    with pytest.raises(ValueError, match="mass must have 3 rows"):
        look(dataclasses.replace(web, mass=torch.ones(2)), [])
    none = torch.zeros(3, dtype=torch.bool)
    with pytest.raises(ValueError, match="cut_links must have 2 rows"):
        find_pieces(web, web.rest, none, none)


def bar(stiff: bool) -> tuple[Web, Tensor]:
    """A bar of 6 x 6 x 24 points, and its crack: all across but for a neck of three points."""
    axis = torch.arange(6.0)
    rest = torch.cartesian_prod(axis, axis, torch.arange(24.0))
    web = web_of(rest, rest_links(rest, ((0, len(rest)),), (1.0,)), stiff=stiff)
    across = (rest[:, 2] > 10.5) & (rest[:, 2] < 12.5)
    neck = across & (rest[:, 0] < 1) & (rest[:, 1] < 3)
    return web, across & ~neck


@pytest.mark.parametrize("welded", [False, True])
@pytest.mark.parametrize("stiff", [False, True])
def test_no_neck_holds_what_is_stiff(stiff: bool, welded: bool) -> None:
    web, crack = bar(stiff)
    # of a body in which nothing is broken any more nothing is asked
    end = web.rest[:, 2] > 22.5
    cut = torch.zeros(len(web.links), dtype=torch.bool)
    found = find_pieces(web, web.rest, end if welded else crack | end, cut, ever=crack | end)
    assert found.fragments.count == (2 if stiff else 1)
    assert not bool(found.dust.any())
