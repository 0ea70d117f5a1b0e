"""Splats on material points: carrying and repair."""

from __future__ import annotations

import pytest
import torch
from simulation_shapes import ellipsoid

from gsfluent import geometry, materials
from gsfluent.data import INTERIOR, TRANSITION, Frame
from gsfluent.pipeline.cracks.stage import Repair
from gsfluent.pipeline.matter.carry import STRETCH, Carry
from gsfluent.pipeline.matter.points import build_matter
from gsfluent.scene.scene import Scene


@pytest.fixture
def bound() -> Carry:
    scene = Scene(floor=None)
    solid = ellipsoid(splats=800)
    coefficients = 0.2 * torch.randn(800, 4, 3)
    solid = solid.replace(gaussians=solid.gaussians.replace(sh=coefficients))
    scene.add(solid, materials.glass)
    return Carry.bind(scene, build_matter(scene, 0.03))


def rotation(angle: float = 0.8) -> torch.Tensor:
    quat = torch.tensor([0.9, 0.2, -0.4, 0.3]) * angle
    return geometry.quaternion_to_matrix(quat)


def still(bound: Carry) -> dict[str, torch.Tensor]:
    count = bound.matter.particles.count
    return {
        "position": bound.matter.rest,
        "deformation": torch.eye(3).expand(count, 3, 3).contiguous(),
        "fragments": torch.zeros(count, dtype=torch.int32),
        "broken": torch.zeros(count, dtype=torch.bool),
    }


def split(bound: Carry, gap: float) -> dict[str, torch.Tensor]:
    """Break a slab at x = 0 and move the two halves apart by ``gap`` along x."""
    state = still(bound)
    x = bound.matter.rest[:, 0]
    state["broken"] = x.abs() < 0.008
    state["position"] = bound.matter.rest + 0.5 * gap * torch.sign(x)[:, None] * torch.eye(3)[0]
    left = int((x < -0.008).nonzero()[0])
    right = int((x > 0.008).nonzero()[0])
    state["fragments"] = torch.where(x < 0, left, right).to(torch.int32)
    state["fragments"][state["broken"]] = -1
    return state


def test_nothing_moves_at_rest(bound):
    moved = bound.apply(bound.motion(**still(bound)))
    assert torch.allclose(moved.means, bound.gaussians.means, atol=1e-6)
    assert torch.allclose(moved.covariances(), bound.gaussians.covariances(), atol=1e-8)
    assert torch.allclose(moved.sh, bound.gaussians.sh, atol=1e-5)


def test_rigid_motion_carries_splats_exactly(bound):
    turn, shift = rotation(), torch.tensor([0.3, -0.2, 0.5])
    state = still(bound)
    state["position"] = bound.matter.rest @ turn.T + shift
    state["deformation"] = turn.expand_as(state["deformation"]).contiguous()
    moved = bound.apply(bound.motion(**state))
    wanted = bound.gaussians.transformed(Frame(turn, shift, 1.0))
    assert torch.allclose(moved.means, wanted.means, atol=2e-6)
    assert torch.allclose(moved.covariances(), wanted.covariances(), atol=1e-8)
    assert torch.allclose(moved.sh, wanted.sh, atol=2e-5)
    assert torch.equal(moved.scales, bound.gaussians.scales)


def test_uniform_stretch_carries_centres_and_shapes(bound):
    stretch = torch.diag(torch.tensor([1.2, 0.9, 1.0]))
    state = still(bound)
    state["position"] = bound.matter.rest @ stretch.T
    state["deformation"] = stretch.expand_as(state["deformation"]).contiguous()
    moved = bound.apply(bound.motion(**state))
    assert torch.allclose(moved.means, bound.gaussians.means @ stretch.T, atol=2e-6)
    full = geometry.unpack_symmetric(bound.gaussians.covariances())
    wanted = geometry.pack_symmetric(stretch @ full @ stretch.T)
    assert torch.allclose(moved.covariances(), wanted, atol=1e-8)


def test_wild_deformation_makes_no_needles_and_no_balloons(bound):
    state = still(bound)
    state["deformation"] = 5.0 * torch.randn_like(state["deformation"])
    moved = bound.apply(bound.motion(**state))
    size = bound.gaussians.scales[0, 0]
    assert float(moved.scales.max()) <= float(size) * STRETCH[1] * 1.001
    assert float(moved.scales.min()) >= float(size) * STRETCH[0] * 0.999


def test_no_splat_is_strung_across_a_gap(bound):
    gap = 0.2
    motion = bound.motion(**split(bound, gap))
    travel = motion.means - bound.gaussians.means
    assert torch.allclose(travel[:, 0].abs(), torch.full((travel.shape[0],), 0.5 * gap), atol=1e-5)
    assert bool(motion.broken.any()) and not bool(motion.carried.all())


def test_repair_adds_splats_only_at_cracks(bound):
    state = split(bound, 0.1)
    motion = bound.motion(**state)
    result = Repair("mvee")(bound, motion)
    count = bound.gaussians.count
    assert result.added > 0 and result.gaussians.count == count + result.added
    labels = result.gaussians.labels
    assert bool((labels[count:] == TRANSITION).all())
    assert torch.equal(labels[:count], bound.gaussians.labels)
    parents = result.groups[count:].long()
    assert bool(motion.broken[parents].all())
    assert bool((bound.gaussians.labels[parents] == INTERIOR).all())
    assert bool((bound.gaussians.means[parents, 0].abs() < 0.03).all())
    assert torch.equal(result.gaussians.opacities[count:], bound.gaussians.opacities[parents])
    none = Repair("mvee")(bound, bound.motion(**still(bound)))
    assert none.added == 0 and none.gaussians.count == count
    assert bool((none.groups == -1).all())


def test_transition_splats_stay_on_the_edges_of_the_pieces(bound):
    repair = Repair("mvee")
    near = repair(bound, bound.motion(**split(bound, 0.05)))
    far = repair(bound, bound.motion(**split(bound, 0.30)))
    assert near.added == far.added
    count = bound.gaussians.count
    side = torch.sign(near.gaussians.means[count:, 0])
    assert bool((side == 1).any()) and bool((side == -1).any())
    travel = far.gaussians.means[count:, 0] - near.gaussians.means[count:, 0]
    assert torch.allclose(travel, 0.125 * side, atol=1e-5)
    assert torch.allclose(far.gaussians.scales[count:], near.gaussians.scales[count:])


def test_transition_splats_lie_inside_both_parents_overlap(bound):
    result = Repair("mvee")(bound, bound.motion(**split(bound, 0.0)))
    count = bound.gaussians.count
    parents = result.groups[count:].long()
    largest = bound.gaussians.scales[parents].amax(dim=1)
    assert bool((result.gaussians.scales[count:].amax(dim=1) <= 1.01 * largest).all())
    distance = (result.gaussians.means[count:] - bound.gaussians.means[parents]).norm(dim=1)
    assert bool((distance <= 2.0 * largest + 1e-6).all())
