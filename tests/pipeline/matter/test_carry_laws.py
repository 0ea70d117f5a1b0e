"""Laws of carried splats: rigid motion, turned colours, bounded shapes, and cuts."""

from __future__ import annotations

import math

import pytest
import torch
from simulation_shapes import ellipsoid

from gsfluent import geometry, materials, ops
from gsfluent.data import Frame
from gsfluent.ops.reference.deform import cut_at
from gsfluent.pipeline.matter.carry import STRETCH, Carry, Points
from gsfluent.pipeline.matter.points import build_matter
from gsfluent.scene.scene import Scene

TURN = geometry.quaternion_to_matrix(torch.tensor([0.72, 0.16, -0.32, 0.24]))


def bound(round_: bool) -> Carry:
    draw = torch.Generator().manual_seed(3)
    solid = ellipsoid(splats=300)
    g = solid.gaussians
    if not round_:
        stretch = 0.3 + torch.rand(g.count, 3, generator=draw)
        g = g.replace(scales=g.scales * stretch, quats=torch.randn(g.count, 4, generator=draw))
    g = g.replace(sh=0.3 * torch.randn(g.count, 16, 3, generator=draw))
    scene = Scene(floor=None)
    scene.add(solid.replace(gaussians=g), materials.glass)
    return Carry.bind(scene, build_matter(scene, 0.04))


def moved(carry: Carry, position: torch.Tensor, deformation: torch.Tensor, piece: int = 0):
    count = position.shape[0]
    pieces = torch.full((count,), piece, dtype=torch.int32)
    broken = torch.full((count,), piece < 0)
    return carry.apply(carry.follow(Points.of(position, deformation, pieces, broken)))


@pytest.mark.parametrize("round_", [True, False])
@pytest.mark.parametrize("piece", [0, -1])
def test_a_turned_object_looks_the_same_to_a_turned_camera(round_: bool, piece: int) -> None:
    """Splats, SH of degree 3 included, ride rigidly, as a piece and as debris: same picture."""
    carry = bound(round_)
    shift = torch.tensor([0.3, -0.2, 0.5])
    rest = carry.matter.rest
    turned = moved(
        carry, rest @ TURN.T + shift, TURN.expand(rest.shape[0], 3, 3).contiguous(), piece
    )
    wanted = carry.gaussians.transformed(Frame(TURN, shift, 1.0))
    assert torch.allclose(turned.means, wanted.means, atol=2e-6)
    assert torch.allclose(turned.covariances(), wanted.covariances(), atol=1e-8)
    view = geometry.look_at(torch.tensor([0.4, 0.3, 0.2]), torch.zeros(3), torch.eye(3)[2]).float()
    other = view.clone()
    other[:3, :3] = view[:3, :3] @ TURN.T
    other[:3, 3] = view[:3, 3] - other[:3, :3] @ shift
    K = torch.tensor([[90.0, 0, 32], [0, 90.0, 32], [0, 0, 1]])
    one, two = (
        ops.rasterize(
            g.means, g.opacities, camera, K, 64, 64, quats=g.quats, scales=g.scales, sh=g.sh
        ).image
        for g, camera in ((carry.gaussians, view), (turned, other))
    )
    assert float(one.max()) > 0.2
    assert torch.allclose(one, two, atol=2e-3)


@pytest.mark.parametrize("round_", [True, False])
@pytest.mark.parametrize("kind", ["huge", "singular", "inverted", "nan", "line"])
def test_no_deformation_makes_needles_balloons_or_nans(round_: bool, kind: str) -> None:
    """Whatever F is, sizes stay within the bounds of the stretch and every number is finite."""
    carry = bound(round_)
    rest = carry.matter.rest
    draw = torch.Generator().manual_seed(1)
    F = torch.randn(rest.shape[0], 3, 3, generator=draw)
    if kind == "huge":
        F = 1e4 * F
    elif kind == "singular":
        F = torch.zeros_like(F)
    elif kind == "inverted":
        F = -torch.eye(3).expand_as(F).contiguous()
    elif kind == "nan":
        F[::2, 0, 0] = math.nan
    else:
        F[:, 1:] = 0.0
    splats = moved(carry, rest, F)
    low, high = carry.gaussians.scales.aminmax(dim=1)
    assert bool(torch.isfinite(splats.means).all() and torch.isfinite(splats.quats).all())
    assert bool(torch.isfinite(splats.sh).all())
    assert bool((splats.scales.amax(dim=1) <= high * STRETCH[1] * 1.001).all())
    assert bool((splats.scales.amin(dim=1) >= low * STRETCH[0] * 0.999).all())


def test_a_cut_has_the_moments_of_what_is_left() -> None:
    """Mean and covariance of a Gaussian below a plane, against a million samples of it."""
    draw = torch.Generator().manual_seed(0)
    root = torch.tensor([[1.0, 0.0, 0.0], [0.5, 0.8, 0.0], [-0.3, 0.2, 0.4]], dtype=torch.float64)
    mean = torch.tensor([0.2, -0.1, 0.3], dtype=torch.float64)
    normal = torch.nn.functional.normalize(torch.tensor([1.0, 2.0, -0.5]).double(), dim=0)
    cloud = torch.randn(1_000_000, 3, generator=draw, dtype=torch.float64) @ root.T + mean
    for distance in (-0.3, 0.0, 0.7, 2.5):
        left = cloud[(cloud - mean) @ normal < distance]
        m, S = cut_at(
            mean[None], (root @ root.T)[None], normal[None], torch.tensor([distance]).double()
        )
        assert torch.allclose(m[0], left.mean(dim=0), atol=4e-3)
        assert torch.allclose(S[0], left.T.cov(), atol=8e-3)
    m, S = cut_at(
        mean[None], (root @ root.T)[None], normal[None], torch.tensor([math.inf]).double()
    )
    assert torch.equal(m[0], mean) and torch.allclose(S[0], root @ root.T)
