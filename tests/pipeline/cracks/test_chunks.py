"""Chunks: when they are cut, how they move, that nothing pops and that a run can be taken up."""

from __future__ import annotations

import pytest
import torch
from simulation_shapes import ellipsoid

from gsfluent import materials, ops
from gsfluent.data import TRANSITION, Gaussians
from gsfluent.errors import InputError
from gsfluent.geometry import look_at
from gsfluent.pipeline.cracks.chunk_faces import (
    ChunkCuts,
    ChunkFaces,
    find_cuts,
    find_faces,
    wide_cuts,
)
from gsfluent.pipeline.cracks.chunks import OPACITY
from gsfluent.pipeline.cracks.stage import Repair, Repaired
from gsfluent.pipeline.matter.carry import Carry, Points
from gsfluent.pipeline.matter.points import body_frame, build_matter
from gsfluent.pipeline.partition.roughness import amplitude
from gsfluent.pipeline.partition.splits import Splits
from gsfluent.pipeline.partition.tree import Partition
from gsfluent.scene.scene import Scene


def binding(device: str = "cpu", material: str = "fruit.apple") -> Carry:
    scene = Scene(floor=None)
    scene.add(ellipsoid(splats=600), materials.get(material))
    return Carry.bind(scene, build_matter(scene, 0.03, device=device))


@pytest.fixture(scope="module")
def bound() -> Carry:
    return binding()


def moment(
    bound: Carry, unit: torch.Tensor, moved: torch.Tensor | None = None, bent: float = 0.0
) -> Points:
    """Points of these pieces, moved by vectors and bent about y."""
    rest = bound.matter.rest
    position = rest.clone()
    position[:, 2] += bent * rest[:, 0].square()
    stretch = torch.eye(3, device=rest.device).repeat(len(rest), 1, 1)
    stretch[:, 2, 0] = 2.0 * bent * rest[:, 0]
    if moved is not None:
        position = position + moved
    none = torch.zeros_like(unit, dtype=torch.bool)
    return Points.of(position, stretch, unit.to(torch.int32), none, unit)


def halves(bound: Carry) -> torch.Tensor:
    right = bound.matter.rest[:, 0] > 0.0
    return torch.where(right, int(right.nonzero()[0]), int((~right).nonzero()[0]))


def apart(bound: Carry, gap: float) -> torch.Tensor:
    right = bound.matter.rest[:, :1] > 0.0
    return gap * right * torch.eye(3, device=right.device)[0]


def drawn(bound: Carry, history, points: Points) -> Repaired:
    cracks = history.step(points)
    motion = cracks.carry.follow(cracks.points, cracks.rest)
    return history.repair(cracks.carry, motion, history=history, cracks=cracks)


def picture(gaussians: Gaussians, eye: tuple[float, float, float] = (0.1, -0.3, 0.15)):
    view = look_at(torch.tensor(eye), torch.zeros(3), torch.eye(3)[2]).float()
    K = torch.tensor([[120.0, 0, 48], [0, 120.0, 48], [0, 0, 1]])
    g = gaussians
    return ops.rasterize(
        g.means, g.opacities, view, K, 96, 96, quats=g.quats, scales=g.scales, sh=g.sh
    )


def test_a_chip_keeps_its_shape_where_its_points_run_apart(bound: Carry) -> None:
    """Drawn around its points one by one, it would be a heap of beads."""
    rest, spacing = bound.matter.rest, bound.matter.spacing[0]
    tip = rest[rest[:, 2].argmax()]
    chip = (rest - tip).norm(dim=1).argsort()[:20]
    unit = torch.zeros(len(rest), dtype=torch.int64)
    unit[chip] = int(chip.min()) or 1
    middle = rest[chip].mean(dim=0)
    turn = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]).to(rest)
    away = torch.tensor([2.0, 0.0, 1.0]).to(rest)
    found = []
    for spread in (1.0, 2.0):
        moved = torch.zeros_like(rest)
        moved[chip] = middle + away + spread * (rest[chip] - middle) @ turn.T - rest[chip]
        points = moment(bound, unit, moved)
        fragments = points.fragments.clone()
        fragments[chip] = -1
        found.append(drawn(bound, Repair().begin(bound), points._replace(fragments=fragments)))
    whole, scattered = (done.gaussians.means for done in found)
    flown = whole[:, 0] > 1.0
    assert int(flown.sum()) > 20
    assert float((whole - scattered)[flown].norm(dim=1).max()) < 1e-3 * spacing


def test_a_splat_does_not_go_to_a_part_that_is_far_away(
    bound: Carry, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Splats off the matter had labels of the other half, and flew beside it as slivers."""
    far = int(bound.gaussians.means[:, 0].argmin())

    def mistaken(partition, seen, splats, rows, of):
        here, cuts = find_cuts(partition, seen, splats, rows, of)
        place = (rows == far).nonzero()[:, 0]
        here[place] = 1 - here[place]
        return here, cuts

    monkeypatch.setattr("gsfluent.pipeline.cracks.chunks.find_cuts", mistaken)
    history = Repair().begin(bound)
    done = drawn(bound, history, moment(bound, halves(bound), apart(bound, 0.3)))
    assert bound.gaussians.means[far, 0] < -5.0 * bound.matter.spacing[0]
    moved = done.gaussians.means[far] - bound.gaussians.means[far]
    assert float(moved.norm()) < 0.1 * bound.matter.spacing[0]
    assert int(history._gaps._region[far]) == int(history._gaps._chunk[done.anchor[far]])


@pytest.mark.parametrize("material", ["glass", "ceramic", "egg", "fruit.apple", "chocolate"])
def test_shards_of_what_is_stiff_are_never_seen_to_bend(material: str) -> None:
    """What is simulated softer bends by a point spacing; a shard of glass would look like a bar of
    rubber. Fruit bends. What has been pressed flat is no longer in one piece, and is drawn so."""
    bound = binding(material=material)
    rest, spacing = bound.matter.rest, bound.matter.spacing[0]
    far = rest[:, 0].abs().max()
    right = bound.gaussians.means[:, 0] > 0.2 * far
    away = torch.cdist(bound.gaussians.means[right], bound.gaussians.means[right])
    strained = []
    for bent in (2.0 * spacing / far**2, 40.0 * spacing / far**2):
        history = Repair().begin(bound)
        points = moment(bound, halves(bound), apart(bound, 0.2), bent=float(bent))
        means = drawn(bound, history, points).gaussians.means[: len(right)][right]
        strained.append(float((torch.cdist(means, means) - away).abs().max()))
    holds = material in ("glass", "ceramic", "egg")
    assert (strained[0] < 0.2 * spacing) == holds
    assert strained[1] > 2.0 * spacing


def test_a_crushed_rim_does_not_turn_a_stone() -> None:
    """Some points of one half have gone far; the others say where it is."""
    bound = binding(material="ceramic")
    rest, spacing = bound.matter.rest, bound.matter.spacing[0]
    points = moment(bound, halves(bound), apart(bound, 0.2))
    wanted = points.position.clone()
    right = (rest[:, 0] > 0.0).nonzero()[:, 0]
    some = len(right) // 12
    rim = right[rest[right, 0].argsort()[:some]]
    position = wanted.clone()
    position[rim, 1] += 20.0 * spacing
    cracks = Repair().begin(bound).step(points._replace(position=position))
    firm = right[rest[right, 0].argsort()[some:]]
    off = (cracks.points.position[firm] - wanted[firm]).norm(dim=1)
    assert float(off.max()) < 0.05 * spacing


@pytest.mark.parametrize("bent", [0.0, 0.3])
def test_a_split_alone_changes_no_picture(bound: Carry, bent: float) -> None:
    """The same motion, before and after what hung together is seen to be two pieces."""
    history = Repair().begin(bound)
    whole = torch.zeros(len(bound.matter.rest), dtype=torch.int64)
    before = drawn(bound, history, moment(bound, whole, bent=bent))
    after = drawn(bound, history, moment(bound, halves(bound), bent=bent))
    assert before.added == 0
    change = (picture(before.gaussians).image - picture(after.gaussians).image).abs()
    assert float(change.max()) < 1.0 / 255.0


def test_pores_are_pits(bound: Carry) -> None:
    """Lightness is height: faces lean away from what is lighter, on the way up to it."""
    history = Repair().begin(bound)
    history.step(moment(bound, halves(bound), apart(bound, 0.1)))
    assert bound.scene is not None
    (body,), (event,) = bound.scene.bodies, history.state()["splits"]
    solid, rest = body.solid, bound.matter.rest
    assert solid is not None
    partition = Partition(
        solid, body_frame(body, bound.scene), rest, bound.matter.spacing[0], 0, amplitude("apple")
    )
    split = partition.split(0, rest[event["rows"]], event["rank"].long(), [0, 1])
    z = solid.origin[2] + solid.voxel * (torch.arange(solid.depth.shape[2]) + 0.5)
    wave, white = 40.0, torch.ones(*solid.depth.shape, 3)
    striped = solid.replace(color=white * (0.5 + 0.3 * torch.sin(wave * z))[:, None])
    flat, plain, high = (
        find_faces(partition, Splits([split]), one, [0], relief)
        for one, relief in ((solid, 0.0), (striped, 0.0), (striped, 0.03))
    )
    assert torch.equal(flat.normals, plain.normals) and torch.equal(flat.quats, plain.quats)
    assert float((high.means - flat.means).norm(dim=1).max()) < 0.1 * partition.voxel
    # elements across the stripes, away from the rind
    inner = (partition.depth_at(high.means) > 3.0 * partition.voxel) & (high.key % 2 == 0)
    inner &= flat.normals[:, 0].abs() > 0.95
    place = partition.own(high.means[inner]).to(torch.float32)
    slope = 0.03 * 0.3 * wave * torch.cos(wave * place[:, 2])
    lean = high.normals[inner, 2] / high.normals[inner, 0].abs()
    lean = lean - flat.normals[inner, 2] / flat.normals[inner, 0].abs()
    assert int(inner.sum()) > 50
    assert float(torch.corrcoef(torch.stack([lean, -slope]))[0, 1]) > 0.95
    assert float((lean + slope).abs().mean()) < 0.3 * float(slope.abs().mean())
    torch.testing.assert_close(high.normals.norm(dim=1), torch.ones(high.count))


def test_what_does_not_split_costs_nothing(bound: Carry) -> None:
    history = Repair().begin(bound)
    whole = torch.zeros(len(bound.matter.rest), dtype=torch.int64)
    points = moment(bound, whole, bent=0.2)
    cracks = history.step(points)
    assert cracks.births is None and cracks.rest is bound.gaussians
    assert cracks.carry.links is bound.links and cracks.points.position is points.position
    assert history.state()["splits"] == []


def test_faces_are_flat_opaque_and_of_the_inside(bound: Carry) -> None:
    spacing = bound.matter.spacing[0]
    cracks = Repair().begin(bound).step(moment(bound, halves(bound), apart(bound, 0.3)))
    births = cracks.births
    g = births.gaussians
    left = bound.matter.rest[births.anchor, 0] < 0.0
    place = torch.where(left, g.means[:, 0], g.means[:, 0] - 0.3)
    assert float(place.abs().max()) < 1.2 * spacing
    assert float(place.square().mean().sqrt()) < 0.45 * spacing
    assert bool((g.labels == TRANSITION).all())
    assert torch.allclose(g.opacities, torch.full_like(g.opacities, OPACITY))
    assert len(births.ids.unique()) == len(births.ids)
    inner = (g.means[:, 1:].norm(dim=1) < 0.07) & left
    assert float(g.normals[inner, 0].mean()) > 0.8
    seen = picture(g.select(left), (0.3, 0.0, 0.0))
    y, x = torch.meshgrid(torch.arange(96) + 0.5, torch.arange(96) + 0.5, indexing="ij")
    disc = ((x - 48).square() + (y - 48).square()).sqrt() * 0.3 / 120 < 0.07
    assert float(seen.alpha[disc].min()) > 0.95
    red = seen.image[disc].mean(dim=0) / seen.alpha[disc].mean()
    assert float((red - torch.tensor([0.9, 0.2, 0.2])).abs().max()) < 0.05


def test_pieces_move_rigidly_and_splats_end_at_their_face(bound: Carry) -> None:
    spacing = bound.matter.spacing[0]
    history = Repair().begin(bound)
    done = drawn(bound, history, moment(bound, halves(bound), apart(bound, 0.3)))
    g, rest = done.gaussians, bound.gaussians
    right = g.means[: rest.count, 0] > 0.15
    moved = g.means[: rest.count] - 0.3 * right[:, None] * torch.eye(3)[0]
    far = rest.means[:, 0].abs() > 3.0 * spacing
    assert torch.allclose(moved[far], rest.means[far], atol=1e-5)
    assert bool((right == (rest.means[:, 0] > 0.0))[far].all())
    # what lay across is cut: no splat reaches far beyond the face
    from gsfluent.geometry import covariance

    sigma = covariance(g.quats, g.scales)[:, 0].sqrt()
    inner = torch.where(g.means[:, 0] > 0.15, 0.3 - g.means[:, 0], g.means[:, 0])
    assert float((inner + sigma).max()) < 1.2 * spacing
    before = covariance(rest.quats, rest.scales)[:, 0].sqrt()
    assert float((sigma[: rest.count] - before).min()) < -0.2 * spacing


def test_older_faces_do_not_change_and_a_run_can_be_taken_up(bound: Carry) -> None:
    unit = halves(bound)
    rest = bound.matter.rest
    top = (rest[:, 2] > 0.02) & (rest[:, 0] > 0.0)
    again = torch.where(top, int(top.nonzero()[0]), unit)
    left = torch.where(rest[:, 0] > 0.0, int(again[(rest[:, 0] > 0) & ~top][0]), unit)
    again = torch.where(top, again, left)
    move = apart(bound, 0.1)
    history = Repair().begin(bound)
    one = history.step(moment(bound, unit, move))
    state = history.state()
    two = history.step(moment(bound, again, move))
    # nothing has moved: the older faces are what they were; points carry them from either side
    common = torch.isin(two.births.ids, one.births.ids)
    assert int(common.sum()) == len(one.births.ids)
    for name in ("sh", "opacities"):
        now = getattr(two.births.gaussians, name)[common]
        assert torch.equal(now, getattr(one.births.gaussians, name))
    now = two.births.gaussians.means[common]
    assert torch.allclose(now, one.births.gaussians.means, rtol=0.0, atol=1e-6)
    other = Repair().begin(bound)
    other.restore(state)
    lift = 0.05 * top[:, None] * torch.eye(3)[2]
    got = other.step(moment(bound, again, move + lift))
    want = history.step(moment(bound, again, move + lift))
    assert torch.equal(got.births.ids, want.births.ids)
    assert torch.equal(got.births.gaussians.means, want.births.gaussians.means)
    assert torch.equal(got.rest.means, want.rest.means)
    assert torch.equal(got.carry.owner, want.carry.owner)


def test_regions_divided_at_once_are_as_if_divided_one_by_one(bound: Carry) -> None:
    rest, spacing = bound.matter.rest, bound.matter.spacing[0]
    first = halves(bound)
    quarter = 2 * first + (rest[:, 1] > 0.0)
    _, rank = torch.unique(quarter, return_inverse=True)
    names = torch.stack([(rank == n).nonzero()[0, 0] for n in range(4)])
    dust = (rest[:, 0].abs() < spacing) & (rest[:, 2] > 0.0)
    last = torch.where(dust, -1, names[rank])
    history = Repair().begin(bound)
    for unit in (first, last):
        drawn(bound, history, moment(bound, unit, apart(bound, 0.02)))
    state = history.state()
    events = state["splits"]
    assert [e["region"] for e in events] == [0, 0, 1]
    # nobody asks again what a split found in its voxels: a break of many pieces holds gigabytes
    assert all(s.face.numel() == 0 for s in history._gaps._partitions[0].splits)
    assert all(int(e["dust"]) >= 0 for e in events[1:])
    # with a frame for each, they are taken up one after another
    alone = Repair().begin(bound)
    alone.restore({**state, "splits": [{**e, "frame": n} for n, e in enumerate(events)]})
    points = moment(bound, last, apart(bound, 0.03))
    a, b = (drawn(bound, one, points) for one in (history, alone))
    assert torch.equal(a.ids, b.ids) and a.added > 100
    for name in ("means", "quats", "scales", "opacities", "sh"):
        assert torch.equal(getattr(a.gaussians, name), getattr(b.gaussians, name)), name


def test_crumbs_follow_what_is_firm(bound: Carry) -> None:
    """Points that fly off one by one take no splats with them; the body keeps its shape."""
    rest, spacing = bound.matter.rest, bound.matter.spacing[0]
    unit = torch.zeros(len(rest), dtype=torch.int64)
    cap = rest[:, 2] > 0.07
    draw = torch.Generator().manual_seed(4)
    noise = 6.0 * spacing * torch.rand(rest.shape, generator=draw) * cap[:, None]
    points = moment(bound, unit, noise)._replace(broken=cap)
    cracks = Repair().begin(bound).step(points)
    moved = cracks.carry.follow(cracks.points, cracks.rest).means
    assert float((moved - bound.gaussians.means).norm(dim=1).max()) < 0.5 * spacing
    raw = Repair("gap").begin(bound).step(points)
    thrown = raw.carry.follow(raw.points, raw.rest).means
    assert float((thrown - bound.gaussians.means).norm(dim=1).max()) > 2.0 * spacing


def test_matter_of_a_spike_is_where_it_is_drawn(bound: Carry) -> None:
    """A partition is smooth: voxels of a thin spike go with the piece around it, and so does what
    ought to be seen of its points. They would be looked for where nothing is drawn."""
    rest, spacing = bound.matter.rest, bound.matter.spacing[0]
    unit = halves(bound)
    away = rest - torch.tensor([3.5 * spacing, 0.0, 0.0])
    spike = (away[:, 1:].norm(dim=1) < spacing) & (away[:, 0].abs() < 3.5 * spacing)
    spike &= rest[:, 0] > 0.0
    unit[spike] = unit[rest[:, 0] < 0.0][0]
    gap = apart(bound, 0.1) * ~spike[:, None]
    history = Repair().begin(bound)
    history.step(moment(bound, unit))
    cracks = history.step(moment(bound, unit, gap))
    assert cracks is not None and cracks.lent is not None
    rows, there = cracks.lent
    tip = rows[(spike & (rest[:, 0] > 2.0 * spacing))[rows]]
    assert len(tip) > 4
    arrived = there[torch.isin(rows, tip)] - rest[tip]
    assert float((arrived - arrived.new_tensor([0.1, 0.0, 0.0])).norm(dim=1).max()) < 0.2 * spacing
    assert float((cracks.points.position - rest)[tip].norm(dim=1).max()) < 0.2 * spacing
    # what is not of a spike is drawn with its own
    assert float(spike[rows].float().mean()) > 0.6


@pytest.mark.parametrize(("far", "drawn_there"), [(0.8, True), (3.0, False)])
def test_a_crack_band_that_strays_stays_where_its_piece_is(
    bound: Carry, far: float, drawn_there: bool
) -> None:
    """A broken layer that hangs together slides off: a little is shown, more is no place of it."""
    rest, spacing = bound.matter.rest, bound.matter.spacing[0]
    cap = rest[:, 2] > 0.06
    assert int(cap.sum()) > 64
    slid = far * spacing * cap[:, None] * torch.eye(3)[0]
    unit = torch.zeros(len(rest), dtype=torch.int64)
    points = moment(bound, unit, slid)._replace(broken=cap)
    cracks = Repair().begin(bound).step(points)
    moved = (cracks.points.position - rest)[cap].norm(dim=1) / spacing
    assert (float(moved.median()) > 0.9 * far) == drawn_there
    assert drawn_there or float(moved.max()) < 0.1


def test_a_binding_without_a_scene_is_refused(bound: Carry) -> None:
    alone = Carry(bound.gaussians, bound.body, bound.matter)
    with pytest.raises(InputError, match="knows no scene"):
        Repair("chunks").begin(alone)


@pytest.mark.cuda
def test_the_same_chunks_on_a_gpu() -> None:
    found = []
    for device in ("cpu", "cuda"):
        bound = binding(device)
        cracks = Repair().begin(bound).step(moment(bound, halves(bound), apart(bound, 0.2)))
        found.append((cracks.births.ids.cpu().sort()[0], cracks.carry.owner.cpu()))
    assert torch.equal(found[0][0], found[1][0])
    assert torch.equal(found[0][1], found[1][1])


def test_a_splat_wider_than_its_points_is_cut_from_afar() -> None:
    """A flat patch of skin is one splat: it reaches a face that its centre is far from."""
    line = torch.linspace(-0.05, 0.05, 41)
    y, z = torch.meshgrid(line, line, indexing="ij")
    places = torch.stack([torch.zeros_like(y), y, z], dim=-1).reshape(-1, 3)
    count = len(places)
    whole = torch.arange(count)
    faces = ChunkFaces(
        whole, whole, torch.ones_like(whole), torch.full_like(whole, 2), places,
        torch.zeros(count, 4), torch.full((count, 3), 1e-3), places, places, whole, whole, whole,
    )  # fmt: skip
    means = torch.tensor([[-0.02, 0.0, 0.0], [-0.02, 0.01, 0.0], [-0.02, 0.0, 0.01], [0.02, 0, 0]])
    scales = torch.tensor([[0.015] * 3, [0.002] * 3, [0.002, 0.015, 0.015], [0.015] * 3])
    splats = Gaussians.from_colors(means, scales, torch.full((4, 3), 0.5))
    region = torch.tensor([1, 1, 1, 3])
    none = torch.zeros(0, dtype=torch.int64)
    before = ChunkCuts(none, none, torch.zeros(0, 3), torch.zeros(0), none)
    cuts = wide_cuts(splats, torch.arange(4), region, before, faces, 0.004)
    # not what is small, lies along the face, or belongs to another region
    assert cuts.splat.tolist() == [0] and cuts.beyond.tolist() == [2]
    assert torch.allclose(cuts.normal, torch.tensor([[1.0, 0.0, 0.0]]), atol=1e-5)
    assert float(cuts.distance) == pytest.approx(0.02, rel=1e-4)
    again = wide_cuts(splats, torch.arange(4), region, cuts, faces, 0.004)
    assert again.splat.tolist() == [0]
