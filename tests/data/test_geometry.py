"""Rotations, covariances, spherical harmonics."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gsfluent import geometry, ops

unit = st.floats(-1, 1, allow_nan=False)
quaternion = st.tuples(unit, unit, unit, unit).filter(lambda q: sum(x * x for x in q) > 1e-4)


def random_rotations(count: int) -> torch.Tensor:
    return geometry.quaternion_to_matrix(torch.randn(count, 4, dtype=torch.float64))


@settings(derandomize=True, max_examples=200, deadline=None)
@given(quaternion)
def test_quaternion_survives_matrix_and_back(numbers: tuple[float, ...]) -> None:
    quat = torch.tensor(numbers, dtype=torch.float64)
    back = geometry.matrix_to_quaternion(geometry.quaternion_to_matrix(quat))
    quat = geometry.normalize_quaternions(quat)
    assert abs(abs(float(back @ quat)) - 1) < 1e-12


@pytest.mark.parametrize("axis", [(0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1)])
def test_half_turns_are_well_conditioned(axis: tuple[int, ...]) -> None:
    quat = torch.tensor(axis, dtype=torch.float64)
    back = geometry.matrix_to_quaternion(geometry.quaternion_to_matrix(quat))
    torch.testing.assert_close(back.abs(), quat, atol=1e-15, rtol=0)


def test_matrix_is_a_proper_rotation() -> None:
    rotation = random_rotations(50)
    eye = torch.eye(3, dtype=torch.float64).expand(50, 3, 3)
    torch.testing.assert_close(rotation @ rotation.mT, eye)
    torch.testing.assert_close(torch.linalg.det(rotation), torch.ones(50, dtype=torch.float64))


def test_quaternion_product_is_matrix_product() -> None:
    left, right = torch.randn(2, 30, 4, dtype=torch.float64)
    product = geometry.quaternion_multiply(left, right)
    expected = geometry.quaternion_to_matrix(left) @ geometry.quaternion_to_matrix(right)
    torch.testing.assert_close(geometry.quaternion_to_matrix(product), expected)


def test_zero_quaternion_means_no_rotation() -> None:
    torch.testing.assert_close(geometry.quaternion_to_matrix(torch.zeros(1, 4))[0], torch.eye(3))


def test_quaternion_to_matrix_gradient() -> None:
    quats = torch.randn(3, 4, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(geometry.quaternion_to_matrix, quats)


@settings(derandomize=True, max_examples=50, deadline=None)
@given(quaternion, st.lists(st.floats(1e-3, 10), min_size=3, max_size=3))
def test_covariance_survives_decomposition(numbers: tuple[float, ...], sizes: list[float]) -> None:
    quats = torch.tensor([numbers], dtype=torch.float64)
    packed = geometry.covariance(quats, torch.tensor([sizes], dtype=torch.float64))
    again = geometry.covariance(*ops.covariance_axes(packed))
    assert float((again - packed).abs().max()) < 1e-10 * float(packed.abs().max())


def test_packing_order_is_diagonal_first() -> None:
    matrix = torch.tensor([[1.0, 4.0, 5.0], [4.0, 2.0, 6.0], [5.0, 6.0, 3.0]])
    assert geometry.pack_symmetric(matrix).tolist() == [1, 2, 3, 4, 5, 6]
    torch.testing.assert_close(geometry.unpack_symmetric(geometry.pack_symmetric(matrix)), matrix)


def test_basis_has_the_signs_of_3dgs() -> None:
    """The constants that the original 3DGS kernels write out (degree 0 to 3)."""
    x, y, z = torch.nn.functional.normalize(torch.randn(3, 7, dtype=torch.float64), dim=0)
    expected = [
        torch.full_like(x, 0.28209479177387814),
        -0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x,
        1.0925484305920792 * x * y, -1.0925484305920792 * y * z,
        0.31539156525252005 * (2 * z * z - x * x - y * y),
        -1.0925484305920792 * x * z, 0.5462742152960396 * (x * x - y * y),
        -0.5900435899266435 * y * (3 * x * x - y * y), 2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4 * z * z - x * x - y * y),
        0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
        -0.4570457994644658 * x * (4 * z * z - x * x - y * y),
        1.445305721320277 * z * (x * x - y * y), -0.5900435899266435 * x * (x * x - 3 * y * y),
    ]  # fmt: skip
    basis = geometry.sh_basis(torch.stack([x, y, z], dim=1), 3)
    torch.testing.assert_close(basis, torch.stack(expected, dim=1), atol=1e-14, rtol=1e-13)


def test_basis_is_orthonormal_on_the_sphere() -> None:
    nodes = 24  # Gauss-Legendre in z, uniform in angle: exact for polynomials of this degree
    height, weight = (
        torch.from_numpy(a) for a in __import__("numpy").polynomial.legendre.leggauss(nodes)
    )
    angle = torch.arange(2 * nodes, dtype=torch.float64) * math.pi / nodes
    z, phi = torch.meshgrid(height, angle, indexing="ij")
    ring = (1 - z * z).sqrt()
    directions = torch.stack([ring * phi.cos(), ring * phi.sin(), z], dim=-1).reshape(-1, 3)
    weights = (weight[:, None] * math.pi / nodes).expand(nodes, 2 * nodes).reshape(-1)
    basis = geometry.sh_basis(directions, 3)
    gram = basis.T @ (weights[:, None] * basis)
    torch.testing.assert_close(gram, torch.eye(16, dtype=torch.float64), atol=1e-12, rtol=0)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_rotated_sh_in_rotated_direction_is_the_same(degree: int) -> None:
    count = 40
    rotation = random_rotations(count)
    sh = torch.randn(count, (degree + 1) ** 2, 3, dtype=torch.float64)
    directions = torch.nn.functional.normalize(torch.randn(count, 3, dtype=torch.float64), dim=1)
    turned = (rotation @ directions[..., None])[..., 0]
    before = (geometry.sh_basis(directions, degree)[..., None] * sh).sum(dim=1)
    after = (geometry.sh_basis(turned, degree)[..., None] * geometry.rotate_sh(sh, rotation)).sum(
        dim=1
    )
    torch.testing.assert_close(after, before, atol=1e-12, rtol=0)


def test_one_rotation_for_all_equals_one_per_row() -> None:
    rotation, sh = random_rotations(1), torch.randn(5, 16, 3, dtype=torch.float64)
    per_row = geometry.rotate_sh(sh, rotation.expand(5, 3, 3))
    torch.testing.assert_close(geometry.rotate_sh(sh, rotation[0]), per_row)


def test_constant_color_round_trip_and_cut_at_zero() -> None:
    rgb = torch.rand(4, 3)
    torch.testing.assert_close(geometry.sh0_to_rgb(geometry.rgb_to_sh0(rgb)), rgb)
    assert float(geometry.sh0_to_rgb(torch.full((1, 3), -9.0)).min()) == 0.0


def test_sh_degree_refuses_odd_counts() -> None:
    with pytest.raises(ValueError, match="coefficient count must be 1, 4, 9 or 16"):
        geometry.sh_degree(5)


def test_look_at_sees_the_target_in_the_middle_upright() -> None:
    viewmat = geometry.look_at(
        torch.tensor([3.0, -2.0, 1.0]), torch.zeros(3), torch.tensor([0.0, 0.0, 1.0])
    )
    ahead = viewmat @ torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64)
    above = viewmat @ torch.tensor([0.0, 0.0, 0.5, 1.0], dtype=torch.float64)
    assert float(ahead[:2].abs().max()) < 1e-12
    assert float(ahead[2]) == pytest.approx(math.sqrt(14))
    assert float(above[1]) < 0  # +y is down


def test_look_at_along_up_still_gives_a_rotation() -> None:
    viewmat = geometry.look_at(
        torch.tensor([0.0, 0.0, 5.0]), torch.zeros(3), torch.tensor([0.0, 0.0, 1.0])
    )
    assert float(torch.linalg.det(viewmat[:3, :3])) == pytest.approx(1.0)


def test_look_at_refuses_equal_points() -> None:
    with pytest.raises(ValueError, match="eye and target must differ"):
        geometry.look_at(torch.ones(3), torch.ones(3), torch.tensor([0.0, 0.0, 1.0]))


@settings(derandomize=True, max_examples=50, deadline=None)
@given(st.tuples(unit, unit, unit), st.tuples(unit, unit, unit))
def test_rotation_between_carries_one_onto_the_other(
    a: tuple[float, ...], b: tuple[float, ...]
) -> None:
    source, target = torch.tensor(a, dtype=torch.float64), torch.tensor(b, dtype=torch.float64)
    if float(source.norm()) < 1e-2 or float(target.norm()) < 1e-2:
        return
    rotation = geometry.rotation_between(source, target)
    carried = rotation @ source / source.norm()
    assert float((carried - target / target.norm()).abs().max()) < 1e-6
    assert float(torch.linalg.det(rotation)) == pytest.approx(1.0, abs=1e-6)


def test_rotation_between_opposite_directions() -> None:
    up = torch.tensor([0.0, 0.0, 1.0])
    rotation = geometry.rotation_between(up, -up)
    assert float(torch.linalg.det(rotation)) == pytest.approx(1.0)
    torch.testing.assert_close(rotation @ up.double(), -up.double())
