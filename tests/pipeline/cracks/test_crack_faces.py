"""Crack faces: where they are, which way they look, when they come and go, and that they resume."""

from __future__ import annotations

import pytest
import torch
from simulation_shapes import ellipsoid

from gsfluent import materials
from gsfluent.data import TRANSITION
from gsfluent.errors import InputError
from gsfluent.pipeline.cracks.gaps import OPACITY
from gsfluent.pipeline.cracks.stage import Repair
from gsfluent.pipeline.matter.carry import Carry, Points
from gsfluent.pipeline.matter.points import build_matter
from gsfluent.pipeline.simulate.stage import Simulate
from gsfluent.scene.scene import Scene


@pytest.fixture(scope="module")
def bound() -> Carry:
    scene = Scene(floor=None)
    scene.add(ellipsoid(splats=400), materials.glass)
    return Carry.bind(scene, build_matter(scene, 0.03))


def parted(bound: Carry, gap: float, *, broken: bool = False, tilt: float = 0.0) -> Points:
    """The half at x > 0 moved by ``gap`` along x and turned by ``tilt`` about x."""
    rest = bound.matter.rest
    right = rest[:, 0] > 0.0
    cos, sin = torch.cos(torch.tensor(tilt)), torch.sin(torch.tensor(tilt))
    turn = torch.tensor([[1.0, 0.0, 0.0], [0.0, cos, -sin], [0.0, sin, cos]])
    rotation = torch.eye(3).expand(rest.shape[0], 3, 3).clone()
    rotation[right] = turn
    moved = torch.where(right[:, None], rest @ turn.T, rest)
    moved = moved + gap * right[:, None] * torch.eye(3)[0]
    break_ = (rest[:, 0].abs() < 0.01) & broken
    piece = torch.where(right, 1, 0).to(torch.int32)
    return Points(moved, rotation, rotation, piece, break_)


def test_nothing_is_born_while_nothing_parts(bound):
    repair = Repair("gap")
    history = repair.begin(bound)
    turned = parted(bound, 0.0)
    assert history.step(turned).births is None
    result = repair(bound, bound.follow(turned), history=history)
    assert result.report == {"splats": bound.gaussians.count, "transition_splats": 0}
    assert result.added == 0 and result.gaussians.count == bound.gaussians.count
    assert bool((result.groups == -1).all())


def test_faces_lie_where_the_halves_part_and_look_into_the_gap(bound):
    gap = 0.05
    births = Repair("gap").begin(bound).step(parted(bound, gap)).births
    assert births is not None
    g, spacing = births.gaussians, bound.matter.spacing[0]
    left = bound.matter.rest[births.anchor, 0] < 0.0
    assert 0.3 < float(left.float().mean()) < 0.7
    face = g.scales[:, 2] < 0.5 * g.scales[:, 1]
    rest_x = torch.where(left, g.means[:, 0], g.means[:, 0] - gap)
    # the points that decide where the halves part are jittered by a quarter spacing
    assert float(rest_x.abs().max()) < 1.5 * spacing
    assert torch.allclose(g.normals.norm(dim=1), torch.ones(len(left)), atol=1e-5)
    inner = face & (g.means[:, 1:].norm(dim=1) < 0.07)
    outward = torch.where(left, 1.0, -1.0) * g.normals[:, 0]
    assert float(outward[inner].min()) > 0.0 and float(outward[inner].mean()) > 0.7
    assert bool((g.labels == TRANSITION).all())
    assert torch.allclose(g.opacities, torch.full_like(g.opacities, OPACITY))


def test_faces_are_opaque_from_the_gap(bound):
    """Seen through the gap the elements alone cover nine tenths, in the colour of the inside."""
    from gsfluent import geometry, ops

    cracks = Repair("gap").begin(bound).step(parted(bound, 0.3))
    left = bound.matter.rest[cracks.births.anchor, 0] < 0.0
    g = cracks.births.gaussians.select(left)
    view = geometry.look_at(torch.tensor([0.3, 0, 0]), torch.zeros(3), torch.eye(3)[2]).float()
    K = torch.tensor([[200.0, 0, 50], [0, 200.0, 50], [0, 0, 1]])
    seen = ops.rasterize(
        g.means, g.opacities, view, K, 100, 100, quats=g.quats, scales=g.scales, sh=g.sh
    )
    y, x = torch.meshgrid(torch.arange(100) + 0.5, torch.arange(100) + 0.5, indexing="ij")
    disc = ((x - 50).square() + (y - 50).square()).sqrt() * 0.3 / 200 < 0.06
    assert float(seen.alpha[disc].mean()) > 0.85
    # the inside of the ellipsoid is red
    red = seen.image[disc].mean(dim=0) / seen.alpha[disc].mean()
    assert float((red - torch.tensor([0.9, 0.2, 0.2])).abs().max()) < 0.05


def test_faces_ride_rigidly_with_their_piece(bound):
    history = Repair("gap").begin(bound)
    one = history.step(parted(bound, 0.2)).births
    two = history.step(parted(bound, 0.4, tilt=0.5)).births
    assert torch.equal(one.ids, two.ids)
    right = bound.matter.rest[one.anchor, 0] > 0.0
    cos, sin = torch.cos(torch.tensor(0.5)), torch.sin(torch.tensor(0.5))
    turn = torch.tensor([[1.0, 0.0, 0.0], [0.0, cos, -sin], [0.0, sin, cos]])
    away = torch.tensor([0.2, 0.0, 0.0])
    wanted = (one.gaussians.means - away) @ turn.T + 2.0 * away
    assert torch.allclose(two.gaussians.means[right], wanted[right], atol=1e-5)
    assert torch.allclose(two.gaussians.means[~right], one.gaussians.means[~right], atol=1e-6)
    assert torch.equal(one.gaussians.scales, two.gaussians.scales)
    normals = one.gaussians.normals @ turn.T
    assert torch.allclose(two.gaussians.normals[right], normals[right], atol=1e-5)


def test_a_gap_between_the_two_widths_keeps_what_it_had(bound):
    """Hysteresis: a gap on its way shut shows what one as wide on its way open does not."""
    spacing, history = bound.matter.spacing[0], Repair("gap").begin(bound)
    history.step(parted(bound, 0.2))
    shut = [history.step(parted(bound, g * spacing)).births for g in (0.1, 0.05, 0.0)]
    fresh = [
        Repair("gap").begin(bound).step(parted(bound, g * spacing)).births for g in (0.1, 0.05)
    ]
    was, soon, none, new, never = (0 if b is None else b.ids.numel() for b in (*shut, *fresh))
    assert was > 2 * new > 0 and soon > 0 and never == none == 0
    # what leaves soon is faint already
    assert float(shut[1].gaussians.opacities.mean()) < 0.3 * OPACITY


def test_frames_in_between_change_nothing(bound):
    """A run at twice the frame rate shows the same faces in the frames that both have."""
    coarse, fine = Repair("gap").begin(bound), Repair("gap").begin(bound)
    for gap in (0.001, 0.002, 0.004):
        one = coarse.step(parted(bound, gap, broken=True)).births
        fine.step(parted(bound, 0.75 * gap, broken=True))
        two = fine.step(parted(bound, gap, broken=True)).births
        assert (one is None) == (two is None)
        if one is not None:
            assert torch.equal(one.ids, two.ids)
            assert torch.equal(one.gaussians.means, two.gaussians.means)


def test_a_broken_layer_leaves_one_face_on_either_side(bound):
    births = Repair("gap").begin(bound).step(parted(bound, 0.05, broken=True)).births
    assert births is not None
    inner = births.gaussians.means[:, 1:].norm(dim=1) < 0.06
    assert bool((births.gaussians.means[inner, 0] < 0.02).any())
    assert bool((births.gaussians.means[inner, 0] > 0.03).any())


def test_methods_are_checked_and_none_adds_nothing(bound):
    with pytest.raises(InputError, match="gap, mvee, none"):
        Repair("glue")
    motion = bound.follow(parted(bound, 0.2))
    assert Repair("none")(bound, motion).added == 0
    alone = Carry(bound.gaussians, bound.body, bound.matter)
    with pytest.raises(InputError, match=r"Carry\.bind"):
        Repair("gap")(alone, alone.follow(parted(bound, 0.2)))


def _dropped() -> Scene:
    scene = Scene()
    scene.add(ellipsoid((0.06, 0.05, 0.05), splats=300), materials.get("fruit.watermelon"))
    scene.add_event({"type": "drop", "height": 1.5})
    return scene


def test_an_interrupted_run_shows_the_same_faces(tmp_path):
    """Ids, places and opacities of every born splat are those of the run in one go."""
    saved = tmp_path / "state.pt"
    wanted = []
    whole = Simulate(dx=0.012)(_dropped(), fps=60, seconds=0.62)
    for frame in whole:
        wanted.append(frame.repaired)
        if frame.index == 35:
            whole.save(saved)
    assert wanted[35].added > 0 and wanted[-1].added > 0
    again = Simulate(dx=0.012)
    for frame in again(_dropped(), fps=60, seconds=0.62, resume=saved):
        want = wanted[frame.index]
        assert torch.equal(frame.repaired.ids, want.ids)
        assert torch.equal(frame.gaussians.means, want.gaussians.means)
        assert torch.equal(frame.gaussians.opacities, want.gaussians.opacities)
        assert int(want.ids.unique().numel()) == want.gaussians.count
