"""Dust: volumes, the law of sizes, that rows alone decide, and that its matter leaves its chunk."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from test_chunks import apart, binding, drawn, halves, moment

from gsfluent.draw import draw
from gsfluent.pipeline.cracks.dust import (
    _ROOM,
    BETA,
    DARKEST,
    FINE,
    JUICE,
    MIST,
    MOST,
    THINNEST,
    Dust,
    Grains,
    grains,
    per_point,
    sizes,
    splats_of,
)
from gsfluent.pipeline.cracks.stage import Repair
from gsfluent.pipeline.matter.carry import Carry
from gsfluent.pipeline.render.camera import look_at
from gsfluent.results.frames import DUST


@pytest.fixture(scope="module")
def bound() -> Carry:
    return binding()


def chips_of(chips: Grains):
    """Diameter of balls of the volumes of chips [m], and how many splats each has, [C]."""
    key = torch.stack([chips.row.double(), *chips.frame.double().unbind(dim=1)], dim=1)
    _, many = torch.unique_consecutive(key, dim=0, return_counts=True)
    amount = torch.stack([part.sum() for part in chips.amount.split(many.tolist())])
    return (6.0 / torch.pi * amount).pow(1.0 / 3.0), many


@pytest.mark.parametrize("wet", [True, False])
@pytest.mark.parametrize(
    ("least", "most", "count"), [(0.125, 1.0, 300), (0.7, 2.8, 20_000), (1.9, 7.0, 200_000)]
)
def test_volumes_are_those_of_the_points_on_average(
    least: float, most: float, count: int, wet: bool
) -> None:
    """Chips larger than a point are had by some points only, whoever else there is."""
    rows, edge = torch.arange(count), torch.full((count,), 2e-3)
    chips, mist = grains(rows, edge, least, most, wet)
    whole = len(rows) * 2e-3**3
    assert float(mist.amount.sum()) == pytest.approx(MIST[wet] * whole)
    assert float(chips.amount.sum()) == pytest.approx((1.0 - MIST[wet]) * whole, rel=0.05)
    size, many = chips_of(chips)
    assert torch.equal(many, splats_of(size / 2e-3 / most))
    size = size / 2e-3
    assert float(size.min()) > 0.999 * least and float(size.max()) < 1.001 * most
    some, _ = grains(rows[::7], edge[::7], least, most, wet)
    assert torch.equal(some.row, chips.row[chips.row % 7 == 0])
    assert len((chips.row * _ROOM + chips.number).unique()) == len(chips.row)
    assert int(chips.number.max()) < _ROOM - 1
    assert float(chips.offset.abs().max()) <= 1e-3 * 1.001
    assert float(chips.toward.norm(dim=1).max()) <= 1.0 + 1e-6


def test_chips_are_as_frequent_as_their_size_says() -> None:
    low, high = 0.2, 2.0
    chips, _ = grains(torch.arange(2000), torch.ones(2000), low, high, wet=False)
    size, _ = chips_of(chips)
    # likeliest exponent of a law between two bounds, by Newton's method
    mean, b = float((size / low).log().mean()), 3.0
    span = float(torch.tensor(high / low).log())
    for _ in range(60):
        tail = torch.exp(torch.tensor(-(b - 1.0) * span)).item()
        value = 1.0 / (b - 1.0) - span * tail / (1.0 - tail) - mean
        slope = -1.0 / (b - 1.0) ** 2 + span**2 * tail / (1.0 - tail) ** 2
        b -= value / slope
    assert b == pytest.approx(BETA, abs=0.1)


def flown(bound: Carry, way: float, wet: bool = True):
    """Chips and mist of 40 points that have gone a way, drawn."""
    rows, edge = torch.arange(40), torch.full((40,), 2e-3)
    here = torch.zeros(40, 3) + torch.tensor([0.0, 0.0, 1.0])
    gone = torch.tensor([way, 0.0, 0.0]).expand(40, 3)
    made = grains(rows, edge, 0.7, 2.8, wet)
    return [
        (g, g.at(here[g.row], lambda p: p).drawn(here, edge, gone, torch.ones_like, None).gaussians)
        for g in made
    ]


def test_never_a_bead_and_never_a_scrap(bound: Carry) -> None:
    """What is seen one by one has flat sides all around a body, and tumbles as one."""
    (made, near), _ = flown(bound, 0.01)
    (_, far), _ = flown(bound, 0.5)
    assert float((near.scales.amax(dim=1) / near.scales.amin(dim=1)).min()) > 4.0
    size, many = chips_of(made)
    first = many.cumsum(0) - many
    for seen in (near, far):
        for a, n, wide in zip(first.tolist(), many.tolist(), size.tolist(), strict=True):
            normal, place = seen.normals[a : a + n], seen.means[a : a + n]
            assert n >= 12  # six, one a side, are scraps of paper
            # sides look all ways, and away from the middle
            arm = place - place.mean(dim=0)
            assert float(((arm * normal).sum(dim=1) > 0.0).float().mean()) > 0.9
            # thick: nothing like a sheet, and as large as its volume says
            span = torch.linalg.svdvals(arm) / n**0.5
            assert float(span[2]) > 0.3 * float(span[0])
            assert 0.7 < float(arm.norm(dim=1).mean()) / (0.5 * wide) < 1.5
            # no splat is so wide that it sticks out as a flag
            assert float(seen.scales[a : a + n].amax()) < 0.45 * wide
            arms, places = made.arm[a : a + n].double(), place.double()
            wanted = torch.cdist(arms, arms)
            assert torch.allclose(torch.cdist(places, places), wanted, atol=2e-6)
    turned = (near.normals * far.normals).sum(dim=1)
    assert float(turned.min()) < 0.0


def test_a_chip_hides_what_is_behind_it() -> None:
    """From all sides, in its middle: its splats leave no holes."""
    rows = torch.arange(12)
    chips, _ = grains(rows, torch.full((12,), 4e-3), 1.0, 2.8, wet=False)
    _, many = chips_of(chips)
    white = chips.at(torch.zeros(len(chips.row), 3), lambda p: torch.ones_like(p))
    still = torch.zeros(12, 3)
    drawn = white.drawn(still, torch.full((12,), 4e-3), still, torch.ones_like, None).gaussians
    first = 0
    for n in many.tolist():
        chip = drawn.select(torch.arange(first, first + n))
        first += n
        middle = chip.means.mean(dim=0)
        for turn in (0.0, 90.0, 200.0):
            camera = look_at(middle.double(), 0.05, turn, 20.0, (64, 64))
            alpha = draw(chip, camera, near=1e-3).alpha[30:34, 30:34]
            assert float(alpha.min()) > 0.75 and float(alpha.mean()) > 0.93


def test_a_chip_from_the_skin_wears_it_on_one_side(bound: Carry) -> None:
    rows = torch.arange(200)
    chips, _ = grains(rows, torch.full((200,), 2e-3), 1.0, 2.8, wet=True)
    red, white = torch.tensor([0.8, 0.1, 0.1]), torch.tensor([0.9, 0.9, 0.8])
    skin = lambda p: torch.where((p[:, 2] > 0.0)[:, None], red, white)  # noqa: E731
    color = chips.at(torch.zeros(len(chips.row), 3), skin).color
    parts = color.split(chips_of(chips)[1].tolist())
    both = [bool((c == red).all(1).any() and (c == white).all(1).any()) for c in parts]
    assert sum(both) > 0.6 * len(both)


def test_mist_hides_what_its_drops_hide(bound: Carry) -> None:
    """And ever less as it spreads; in the end nothing at all: a picture leaves out what is thinner
    than 1 / 255, and where hundreds of puffs ended one behind the other there was an edge."""
    amount = 2e-3**3 * MIST[1]
    before = 1.0
    for way in (0.005, 0.01):
        _, (_, mist) = flown(bound, way)
        wide = mist.scales[:, 0].double()
        seen = -(1.0 - THINNEST - mist.opacities.double()).log() * 2.0 * torch.pi * wide.square()
        assert torch.allclose(seen, torch.full_like(seen, 1.5 * amount / FINE), rtol=1e-3)
        assert float(mist.opacities.max()) < 0.5 * before
        before = float(mist.opacities.min())
    _, (_, mist) = flown(bound, 0.1)
    assert float(mist.opacities.max()) == 0.0


def test_a_row_has_its_grains_whatever_is_around() -> None:
    rows = torch.tensor([5, 900, 31, 77, 4_000_000])
    mixed = torch.tensor([77, 4_000_000, 5, 31, 900])
    edge = torch.full((5,), 2e-3)
    made = (grains(r, edge, 0.25, 1.0, wet=True) for r in (rows, mixed))
    for one, two in zip(*made, strict=True):
        for row in rows.tolist():
            for name in ("offset", "toward", "lag", "quats", "scales", "number", "arm", "spin"):
                pair = (getattr(g, name)[g.row == row] for g in (one, two))
                assert torch.equal(*pair)
        first, second = (one.offset[one.row == row][:1] for row in (5, 31))
        assert not torch.allclose(first, second)


@pytest.mark.parametrize("wet", [True, False])
def test_chips_lie_on_the_floor_and_mist_wets_it(wet: bool) -> None:
    """What is high has what it had in flight; nothing is below the floor."""
    rows, floor = torch.arange(3), 0.25
    edge = torch.full((3,), 6e-3)
    place = torch.tensor([[0.0, 0.0, 0.004], [0.1, 0.0, 0.011], [0.2, 0.0, 0.2]])
    place[:, 2] += floor
    way = torch.tensor([0.03, 0.0, -0.02]).expand(3, 3)
    seen = []
    for made in grains(rows, edge, 0.25, 1.0, wet):
        made = made.at(place[made.row], lambda p: torch.full_like(p, 0.5))
        drawn = made.drawn(place, edge, way, lambda r: torch.ones(len(r)), floor).gaussians
        free = made.drawn(place, edge, way, lambda r: torch.ones(len(r)), None).gaussians
        seen.append((made, drawn))
        lying, high = made.row == 0, made.row == 2
        for name in ("means", "quats", "scales", "opacities", "sh"):
            assert torch.equal(getattr(drawn, name)[high], getattr(free, name)[high])
        # a corner of a chip may sink in
        assert float(drawn.means[:, 2].min()) > floor - 6e-4
    (chips, drawn), (mist, puffs) = seen
    # on its broad side: what is lying is lower than what flies
    heights = [float(drawn.means[chips.row == k, 2].std()) for k in (0, 2)]
    assert heights[0] < heights[1]
    # the highest side of the largest chip, whose longest edge is more than that of its cube
    assert float((drawn.means[chips.row == 0, 2] - floor).max()) < 1.25 * 6e-3
    lying = mist.row == 0
    assert float((puffs.scales[lying, 2] / puffs.scales[lying, 0]).max()) < 0.3
    darker = float(puffs.sh[lying].mean()) < float(puffs.sh[mist.row == 2].mean()) - 0.1
    assert darker == wet


def test_much_dust_has_larger_chips() -> None:
    assert sizes(0.5, 24_000, 100.0) == (0.5, pytest.approx(24_000 ** (1 / 3) / 8))
    found = [sizes(0.1, 24_000, n)[0] for n in (10.0, 3000.0, 9000.0, 30_000.0, 1e6)]
    assert found == sorted(found) and found[0] < found[-1]
    for n in (10.0, 1000.0, 10_000.0):
        assert n * per_point(*sizes(0.1, 24_000, n)) <= MOST


def thrown(bound: Carry, far: float):
    """Two halves, of which every 97th point has gone up."""
    unit = halves(bound)
    unit[::97] = -1
    fly = torch.zeros_like(bound.matter.rest)
    fly[::97, 2] = far
    return moment(bound, unit, apart(bound, 0.1) + fly), unit[::97].numel()


def test_dust_leaves_with_its_matter(bound: Carry) -> None:
    points, many = thrown(bound, 5.0)
    history = Repair().begin(bound)
    cracks = history.step(points)
    dust = cracks.births.ids >= DUST
    rows = cracks.births.anchor[dust]
    assert rows.unique().tolist() == cracks.dust.tolist() == list(range(0, 97 * many, 97))
    assert len(cracks.births.ids.unique()) == len(cracks.births.ids)
    # around their points, and coloured like what was there
    g = cracks.births.gaussians.select(dust)
    off = (g.means - points.position[rows]).norm(dim=1)
    assert float(off.max()) < (0.2 + 0.4) * 5.2 + 0.02
    # what is not dust stays down, and the pit is empty
    assert float(cracks.births.gaussians.select(~dust).means[:, 2].max()) < 0.2
    bare = cracks.rest.opacities < 1e-6
    assert 0 < int(bare.sum()) < 0.1 * bare.numel()
    near = torch.cdist(bound.gaussians.means[bare], bound.matter.rest[::97]).amin(dim=1)
    assert float(near.max()) < 1.5 * bound.matter.spacing[0]
    # the volumes of what is drawn: the regions', and the grains'
    partition = history._gaps._partitions[0]
    whole = sum(partition._volumes.values())
    assert whole == int((partition.depth > 0.0).sum())
    wanted = whole * many / len(bound.matter.rest)
    ash = [s.ids[e["dust"]] for s, e in zip(partition.splits, history._gaps._events, strict=True)]
    assert partition.volume(ash[0]) == pytest.approx(wanted, rel=0.02)


def test_dust_does_not_pop(bound: Carry) -> None:
    """What has just become dust changes nothing; then it leaves by degrees, for good."""
    history = Repair().begin(bound)
    spacing = bound.matter.spacing[0]
    before = drawn(bound, history, thrown(bound, 0.0)[0])
    assert int((before.ids >= DUST).sum()) == 0
    found = []
    for far in (0.8, 1.2, 3.0, 3.0, 0.5):
        now = drawn(bound, history, thrown(bound, far * spacing)[0])
        assert "easing" not in history.state()  # degrees of their own
        dust = now.ids >= DUST
        found.append((now.ids[dust], float(now.gaussians.opacities[dust].mean())))
    assert all(torch.equal(found[0][0], ids) for ids, _ in found)
    opacity = [value for _, value in found]
    assert 0.0 < opacity[0] < opacity[1] < opacity[2] == opacity[3] == opacity[4]


def test_mist_of_juice_has_the_colour_of_the_flesh(bound: Carry) -> None:
    dust = Repair().begin(bound)._gaps._dust
    solid = bound.scene.bodies[0].solid
    inside = solid.depth > solid.depth[solid.occupancy].median()
    rind, flesh = torch.tensor([0.2, 0.5, 0.1]), torch.tensor([0.9, 0.2, 0.2])
    color = torch.where(inside[..., None], flesh, rind)
    body = SimpleNamespace(solid=solid.replace(color=color))
    dust._scene = SimpleNamespace(bodies=(body,))
    places = bound.matter.rest[:5]
    drops = dust._juice(0, lambda p: rind.expand(len(p), 3), places)
    torch.testing.assert_close(
        drops, torch.lerp(rind, flesh, JUICE).expand(5, 3), atol=0.03, rtol=0
    )


def test_chips_of_what_is_dry_are_no_black_specks() -> None:
    bound = binding(material="bone")
    assert bound.scene is not None
    dust = Dust(bound.scene, bound.matter)
    flesh = dust._flesh(0, lambda p: torch.full_like(p, 0.6)).float()
    shown = torch.tensor([[0.02, 0.0, 0.0], [0.5, 0.45, 0.4], [0.9, 0.9, 0.9]])
    chips = dust._dry(0, lambda p: shown, torch.zeros(3, 3))
    assert float(chips[0].mean()) == pytest.approx(DARKEST * float(flesh.mean()), rel=1e-3)
    torch.testing.assert_close(chips[1:], shown[1:])


def test_what_lies_scatters_no_more(bound: Carry) -> None:
    """Its chunk goes on; the grains stay where they are."""
    history = Repair().begin(bound)
    unit, rest = halves(bound), bound.matter.rest
    unit[::97] = -1
    lies = torch.zeros(len(rest), 1, dtype=torch.bool)
    lies[::97] = True
    means = []
    for step in (0.2, 0.4, 0.9):
        move = torch.where(lies, torch.tensor([0.0, 0.0, 0.1]), torch.tensor([step, 0.0, 0.0]))
        births = history.step(moment(bound, unit, move)).births
        means.append(births.gaussians.means[births.ids >= DUST])
    assert len(means[0]) and torch.equal(means[0], means[1]) and torch.equal(means[1], means[2])


def test_a_run_with_dust_can_be_taken_up(bound: Carry) -> None:
    history, other = Repair().begin(bound), Repair().begin(bound)
    history.step(thrown(bound, 0.02)[0])
    other.restore(history.state())
    want, got = (h.step(thrown(bound, 0.03)[0]) for h in (history, other))
    assert torch.equal(want.births.ids, got.births.ids)
    assert int((want.births.ids >= DUST).sum()) > 0
    for name in ("means", "scales", "opacities", "sh"):
        assert torch.equal(*(getattr(c.births.gaussians, name) for c in (want, got)))
    assert torch.equal(want.rest.opacities, got.rest.opacities)
    assert torch.equal(want.carry.owner, got.carry.owner)


def chips(bound: Carry, dusty: int):
    """Two halves with two chips of 20 points at their tops, which have shed some of these."""
    unit = halves(bound)
    high = bound.matter.rest[:, 2].argsort(descending=True)
    right = (bound.matter.rest[:, 0] > 0.0)[high]
    for own in (high[right][:20], high[~right][:20]):
        unit[own] = own[-1]
        unit[own[:dusty]] = -1
    return moment(bound, unit, apart(bound, 0.1))


def test_a_chip_is_not_divided_when_its_points_have_become_dust(bound: Carry) -> None:
    """It stays what it was cut as, with its skin: apart they would be a spray of grains."""
    history, again = Repair().begin(bound), Repair().begin(bound)
    history.step(chips(bound, 0))
    whole = history._gaps
    assert len(whole._events) == len(whole._partitions[0].splits) == 1 and whole._regions == 4
    for dusty in (8, 12, 20):
        cracks = history.step(chips(bound, dusty))
        assert cracks.dust is None and int((cracks.births.ids >= DUST).sum()) == 0
        assert len(whole._events) == 1 and int(whole._gone.sum()) == 0
    assert set(whole._chunk.unique().tolist()) == {0, 1, 2, 3}
    again.restore(history.state())
    got = again.step(chips(bound, 20))
    for name in ("ids", "anchor"):
        assert torch.equal(*(getattr(c.births, name) for c in (cracks, got)))
    assert torch.equal(again._gaps._chunk, whole._chunk)


def test_no_dust_no_grains(bound: Carry) -> None:
    history = Repair().begin(bound)
    cracks = history.step(moment(bound, halves(bound), apart(bound, 0.1)))
    assert cracks.dust is None and int((cracks.births.ids >= DUST).sum()) == 0
    assert cracks.rest.opacities is bound.gaussians.opacities
    assert history.state()["dust"]["rows"].numel() == 0


@pytest.mark.cuda
def test_the_same_dust_on_a_gpu() -> None:
    found = []
    for device in ("cpu", "cuda"):
        bound = binding(device)
        births = Repair().begin(bound).step(thrown(bound, 0.3)[0]).births
        dust = births.ids >= DUST
        ids, order = births.ids[dust].sort()
        found.append((ids.cpu(), births.gaussians.select(dust).means[order].cpu()))
    assert torch.equal(found[0][0], found[1][0])
    assert torch.allclose(found[0][1], found[1][1], atol=1e-6)
