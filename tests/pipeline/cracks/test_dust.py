"""Dust: volumes, the law of sizes, that rows alone decide, and that its matter leaves its chunk."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from test_chunks import apart, binding, drawn, halves, moment

from gsfluent import geometry
from gsfluent.pipeline.cracks.dust import (
    BETA,
    COARSEST,
    JUICE,
    MOST,
    SIGMA,
    SPREAD,
    finest,
    grains,
    per_point,
)
from gsfluent.pipeline.cracks.stage import Repair
from gsfluent.pipeline.matter.carry import Carry
from gsfluent.results.frames import DUST


@pytest.fixture(scope="module")
def bound() -> Carry:
    return binding()


@pytest.mark.parametrize("wet", [True, False])
@pytest.mark.parametrize("least", [0.125, 0.25, 0.5])
def test_volumes_sum_to_those_of_the_points(least: float, wet: bool) -> None:
    rows = torch.tensor([3, 70_001, 12, 8])
    edge = torch.tensor([1e-3, 2e-3, 5e-3, 1e-2])
    made = grains(rows, edge, least, wet)
    for row, own in zip(rows.tolist(), edge.double().tolist(), strict=True):
        assert float(made.volume[made.row == row].sum()) == pytest.approx(own**3, rel=1e-6)
    inside = (
        made.offset.abs().amax(dim=1)
        <= 0.5 * edge.repeat_interleave(round(per_point(least, wet))) * 1.001
    )
    assert bool(inside.all())
    assert float(made.toward.norm(dim=1).max()) <= 1.0 + 1e-6


def test_grains_larger_than_a_point_have_its_volume_on_average() -> None:
    rows, edge = torch.arange(60_000), torch.full((60_000,), 2e-3)
    made = grains(rows, edge, 1.5, wet=True)
    size = (6.0 / torch.pi * made.volume).pow(1.0 / 3.0)
    assert float(size.min()) > 2.9e-3 and float(size.max()) < 5e-3
    assert 0 < len(made.row) < 0.5 * len(rows) and len(made.row.unique()) == len(made.row)
    assert float(made.volume.sum()) == pytest.approx(len(rows) * 2e-3**3, rel=0.02)
    some = grains(rows[::7], edge[::7], 1.5, wet=True)
    assert torch.equal(some.row, made.row[made.row % 7 == 0])  # a row has its own, or none


@pytest.mark.parametrize("least", [0.125, 0.2])
def test_grains_are_as_frequent_as_their_size_says(least: float) -> None:
    made = grains(torch.arange(2000), torch.ones(2000), least, wet=False)
    size = (6.0 / torch.pi * made.volume).pow(1.0 / 3.0)
    low, high = least, COARSEST
    assert float(size.min()) > 0.9 * low and float(size.max()) < 1.1 * high
    # likeliest exponent of a law between two bounds, by Newton's method
    mean, b = float((size / low).log().mean()), 3.0
    span = float(torch.tensor(high / low).log())
    for _ in range(60):
        tail = torch.exp(torch.tensor(-(b - 1.0) * span)).item()
        value = 1.0 / (b - 1.0) - span * tail / (1.0 - tail) - mean
        slope = -1.0 / (b - 1.0) ** 2 + span**2 * tail / (1.0 - tail) ** 2
        b -= value / slope
    assert b == pytest.approx(BETA, abs=0.1)


def test_a_row_has_its_grains_whatever_is_around() -> None:
    rows = torch.tensor([5, 900, 31, 77, 4_000_000])
    mixed = torch.tensor([77, 4_000_000, 5, 31, 900])
    one, two = (grains(r, torch.full((5,), 2e-3), 0.25, wet=True) for r in (rows, mixed))
    for row in rows.tolist():
        for name in ("offset", "toward", "lag", "quats", "scales", "number"):
            pair = (getattr(g, name)[g.row == row] for g in (one, two))
            assert torch.equal(*pair)
    first, second = (one.offset[one.row == row] for row in (5, 31))
    assert not torch.allclose(first, second)


@pytest.mark.parametrize("wet", [True, False])
def test_drops_spread_on_the_floor_and_grains_lie_on_it(wet: bool) -> None:
    """Volumes stay; what is high has the bits that it had in flight; nothing is below the floor."""
    rows, floor = torch.arange(3), 0.25
    edge = torch.full((3,), 6e-3)
    place = torch.tensor([[0.0, 0.0, 0.004], [0.1, 0.0, 0.011], [0.2, 0.0, 0.2]])
    place[:, 2] += floor
    way = torch.tensor([0.03, 0.0, -0.02]).expand(3, 3)
    made = grains(rows, edge, 0.25, wet)
    made = made.at(place[made.row], torch.zeros_like)
    drawn = made.drawn(place, edge, way, lambda row: torch.ones_like(edge)[row], floor).gaussians
    volume = drawn.scales.double().prod(dim=1)
    assert torch.allclose(volume, made.scales.double().prod(dim=1), rtol=1e-5)
    lying, between, high = (made.row == k for k in range(3))
    assert torch.equal(drawn.scales[high], made.scales[high])
    assert torch.equal(drawn.quats[high], made.quats[high])
    half = geometry.quaternion_to_matrix(drawn.quats)[:, 2] * drawn.scales / SIGMA
    bottom = drawn.means[:, 2] - half.norm(dim=1) - floor
    assert float(bottom[lying].abs().max()) < 1e-6
    assert float(bottom[between | high].min()) > -1e-3
    ratio = drawn.scales[lying].amax(dim=1) / drawn.scales[lying].amin(dim=1)
    assert float(ratio.min()) >= SPREAD**3 - 1e-3 if wet else float(ratio.max()) < 3.0
    if wet:
        assert float(drawn.normals[lying][:, 2].abs().min()) > 1.0 - 1e-5


def test_much_dust_has_larger_grains() -> None:
    assert finest(10.0, False) == 0.125
    sizes = [finest(float(n), False) for n in (10, 3000, 9000, 30_000, 1e6)]
    assert sizes == sorted(sizes) and sizes[-1] == 0.5
    assert all(
        n * per_point(finest(n, wet), wet) <= MOST
        for n in (10.0, 1000.0, 10_000.0)
        for wet in (True, False)
    )


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
        dust = now.ids >= DUST
        found.append((now.ids[dust], float(now.gaussians.opacities[dust].mean())))
    assert all(torch.equal(found[0][0], ids) for ids, _ in found)
    opacity = [value for _, value in found]
    assert 0.0 < opacity[0] < opacity[1] < opacity[2] == opacity[3] == opacity[4]


def test_drops_are_of_many_sizes_in_the_colour_of_the_flesh(bound: Carry) -> None:
    made = grains(torch.arange(500), torch.full((500,), 6e-3), 0.25, wet=True)
    size = (6.0 / torch.pi * made.volume).pow(1.0 / 3.0)
    assert float(size.max() / size.min()) > 3.5
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


def test_a_chip_is_not_divided_and_melts_when_most_of_it_is_dust(bound: Carry) -> None:
    history, other = Repair().begin(bound), Repair().begin(bound)
    for h in (history, other):
        h.step(chips(bound, 0))
    whole = history._gaps
    partition = whole._partitions[0]
    assert len(whole._events) == len(partition.splits) == 1 and whole._regions == 4
    assert history.step(chips(bound, 8)).dust is None
    assert len(whole._events) == 1
    many = len(other.step(chips(bound, 12)).births.ids)  # the same without the step between
    cracks = history.step(chips(bound, 12))
    assert len(cracks.births.ids) == many
    # nothing was cut anew, all points of both are dust, and a run that is taken up has the same
    assert len(whole._events) == 3 and len(partition.splits) == 1
    assert int(whole._gone.sum()) == 40 and torch.equal(whole._ash, other._gaps._ash)
    assert set(whole._chunk.unique().tolist()) == {0, 1}
    again = Repair().begin(bound)
    again.restore(history.state())
    want, got = (h.step(chips(bound, 12)) for h in (history, again))
    for name in ("ids", "anchor"):
        assert torch.equal(*(getattr(c.births, name) for c in (want, got)))
    assert torch.equal(again._gaps._chunk, whole._chunk)
    assert torch.equal(again._gaps._ash, whole._ash)


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
