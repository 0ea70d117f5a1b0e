"""Splats carried by others go where the closed form says, with their shapes and colours."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from gsfluent import geometry
from gsfluent.data import Gaussians
from gsfluent.errors import InputError
from gsfluent.io.sequences import Sequence
from gsfluent.pipeline import Carry
from gsfluent.pipeline.carrying.binding import bind, closest_on_triangle


def splats(means: Tensor, seed: int = 0) -> Gaussians:
    random = torch.Generator().manual_seed(seed)
    n = means.shape[0]
    quats = torch.nn.functional.normalize(torch.randn(n, 4, generator=random), dim=1)
    scales = 0.002 + 0.02 * torch.rand(n, 3, generator=random)
    sh = 0.3 * torch.randn(n, 9, 3, generator=random)
    return Gaussians(means.float(), quats, scales, torch.full((n,), 0.9), sh)


def cube(count: int, seed: int) -> Tensor:
    random = torch.Generator().manual_seed(seed)
    return torch.rand(count, 3, generator=random, dtype=torch.float64)


def rotation(x: float, y: float, z: float) -> Tensor:
    spin = torch.tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]], dtype=torch.float64)
    return torch.linalg.matrix_exp(spin)


def spread(model: Gaussians) -> Tensor:
    """Covariances, [M, 3, 3]."""
    return geometry.unpack_symmetric(
        geometry.covariance(model.quats.double(), model.scales.double())
    )


def sequence(*frames: Tensor, faces: Any = None) -> Sequence:
    times = np.arange(len(frames)) / 24.0
    return Sequence(np.stack([f.numpy() for f in frames]), times, faces)


def last(model: Gaussians, motion: Sequence, **options: Any) -> Any:
    return list(Carry(**options)(model, motion))[-1]


@settings(max_examples=6, deadline=None)
@given(st.lists(st.floats(-0.4, 0.4), min_size=9, max_size=9), st.integers(0, 5))
def test_points_of_a_solid_carry_every_affine_map(entries: list[float], seed: int) -> None:
    """x -> A x + b: centres, covariances and colours by PhysGaussian's formulas."""
    map = torch.linalg.matrix_exp(torch.tensor(entries, dtype=torch.float64).reshape(3, 3))
    points, shift = cube(700, seed), torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64)
    model = splats(cube(200, seed + 50))
    now = last(model, sequence(points, points @ map.T + shift)).gaussians
    assert float((now.means - (model.means.double() @ map.T + shift)).abs().max()) < 1e-5
    covariance = map @ spread(model) @ map.T
    found = spread(now)
    assert float((found - covariance).abs().max()) < 1e-5 * float(covariance.abs().max()) + 1e-9
    u, _, v = torch.linalg.svd(map)
    wanted = geometry.rotate_sh(model.sh, (u @ v).float().expand(200, 3, 3))
    torch.testing.assert_close(now.sh, wanted, atol=1e-4, rtol=0)


@pytest.mark.parametrize("subdivisions", [1, 3])
def test_a_mesh_carries_every_similarity(subdivisions: int) -> None:
    ball = trimesh.creation.icosphere(subdivisions)
    rest = torch.tensor(ball.vertices)
    map = 1.7 * rotation(0.5, -0.8, 0.3)
    random = torch.Generator().manual_seed(1)
    around = torch.nn.functional.normalize(torch.randn(200, 3, generator=random), dim=1)
    model = splats(around * (0.8 + 0.3 * torch.rand(200, 1, generator=random)))
    motion = sequence(rest, rest @ map.T + 0.4, faces=np.asarray(ball.faces))
    now = last(model, motion).gaussians
    assert float((now.means - (model.means.double() @ map.T + 0.4)).abs().max()) < 1e-5
    torch.testing.assert_close(now.scales.sort().values, 1.7 * model.scales.sort().values)


def test_points_of_a_surface_keep_their_normals() -> None:
    """A flat sheet that is turned upright and bent no further; across it nothing is known."""
    flat = torch.cat([cube(500, 3)[:, :2], torch.zeros(500, 1, dtype=torch.float64)], dim=1)
    map = rotation(1.2, 0.4, -0.3)
    model = splats(torch.cat([cube(100, 4)[:, :2], 0.01 + 0.0 * cube(100, 4)[:, :1]], dim=1))
    now = last(model, sequence(flat, flat @ map.T)).gaussians
    assert float((now.means - model.means.double() @ map.T).abs().max()) < 1e-5


def test_a_bend_is_followed_to_second_order() -> None:
    """x -> (sin(x c) / c, ...): half the spacing, a quarter of the error."""

    def bent(p: Tensor) -> Tensor:
        r, a = 1.0 / 0.8 + p[:, 2], 0.8 * p[:, 0]
        return torch.stack([r * a.sin(), p[:, 1], r * a.cos()], dim=1)

    inside = splats(0.2 + 0.6 * cube(300, 9))
    errors = []
    for n in (9, 18):
        axis = torch.linspace(0, 1, n, dtype=torch.float64)
        points = torch.cartesian_prod(axis, axis, axis)
        now = last(inside, sequence(points, bent(points))).gaussians.means.double()
        errors.append(float((now - bent(inside.means.double())).norm(dim=1).max()))
    assert errors[1] < 0.35 * errors[0] and errors[1] < 2e-3


def test_what_parts_is_reported_and_what_is_gone_is_unseen() -> None:
    points = cube(600, 2)
    right = points[:, 0] > 0.5
    apart = points + 3.0 * right[:, None] * torch.tensor([1.0, 0.0, 0.0])
    without = points.clone()
    without[points[:, 2] > 0.7] = math.nan
    model, stage = splats(cube(400, 8)), Carry()
    _, torn, gone = list(stage(model, sequence(points, apart, without)))
    away = (model.means[:, 0] - 0.5).abs()
    assert bool(torn.torn.any()) and float(away[torn.torn].max()) < 0.25
    assert not bool(torn.gone.any()) and not bool(gone.torn.all())
    assert bool((gone.gaussians.opacities[gone.gone] == 0).all())
    assert bool(gone.gone[model.means[:, 2] > 0.97].all())
    facts = stage.report["per_frame"]
    assert facts["torn"][1] == pytest.approx(float(torn.torn.double().mean()))
    assert facts["torn"][0] == 0.0 and facts["gone"] == [
        0.0,
        0.0,
        pytest.approx(float(gone.gone.double().mean())),
    ]


def test_another_frame_may_be_the_rest() -> None:
    points = cube(300, 0)
    model = splats(points[:50] + 2.0)
    frames = list(Carry(rest=-1)(model, sequence(points, points + 2.0)))
    torch.testing.assert_close(frames[0].gaussians.means, model.means - 2.0, atol=1e-6, rtol=0)
    assert torch.equal(frames[1].gaussians.scales, model.scales)


def test_the_same_bits_twice() -> None:
    points, model = cube(300, 0), splats(cube(100, 1))
    motion = sequence(points, points @ rotation(0.1, 0.2, 0.3).T)
    one, two = (last(model, motion).gaussians for _ in range(2))
    assert torch.equal(one.means, two.means) and torch.equal(one.sh, two.sh)


def test_barycentric_places_are_nearest() -> None:
    random = torch.Generator().manual_seed(5)
    triangle = torch.randn(400, 3, 3, generator=random, dtype=torch.float64)
    places = 2.0 * torch.randn(400, 3, generator=random, dtype=torch.float64)
    share = closest_on_triangle(places, triangle)
    found = (share[..., None] * triangle).sum(dim=1)
    wanted = trimesh.triangles.closest_point(triangle.numpy(), places.numpy())
    np.testing.assert_allclose(found.numpy(), wanted, atol=1e-9)


def test_splats_elsewhere_are_refused_with_both_places() -> None:
    points = cube(100, 0)
    with pytest.raises(InputError, match=r"from \(10, 10, 10\)|splats from"):
        Carry()(splats(points[:20] + 10.0), sequence(points))
    with pytest.raises(InputError, match="frames 0 to 0"):
        Carry(rest=3)(splats(points), sequence(points))
    with pytest.raises(InputError, match="stretch"):
        Carry(stretch=(2.0, 1.0))


def test_one_carrier_moves_all() -> None:
    here = torch.zeros(1, 3, dtype=torch.float64)
    binding = bind(here + 0.1, here)
    assert torch.allclose(binding.move(here + 1.0).means, here + 1.1)
