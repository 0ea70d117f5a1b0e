"""polar_clamped against LAPACK, its invariants, and its error messages."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from gsfluent.ops import polar_clamped
from gsfluent.ops.reference import deform as reference

TOLERANCE = {torch.float32: 2e-5, torch.float64: 1e-12}
EYE = torch.eye(3, dtype=torch.float64)


def random_rotations(count: int) -> Tensor:
    q, _ = torch.linalg.qr(torch.randn(count, 3, 3, dtype=torch.float64))
    return q * torch.linalg.det(q)[:, None, None]


@pytest.fixture
def mixed() -> Tensor:
    """Mild, strong, reflected and badly scaled deformation gradients with distinct stretches."""
    u, v = random_rotations(400), random_rotations(400)
    s = torch.exp(torch.randn(400, 3, dtype=torch.float64)).sort(dim=1, descending=True).values
    s = s * torch.tensor([1.2, 1.0, 0.8], dtype=torch.float64)
    s[100:200, 2] *= -1.0
    s[200:300] *= 1e4
    return (u * s[:, None, :]) @ v.transpose(1, 2)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_matches_lapack(mixed: Tensor, dtype: torch.dtype) -> None:
    rotation, clamped = polar_clamped(mixed.to(dtype), 0.3, 2.0)
    want_rotation, want_clamped = reference.polar_clamped(mixed.to(dtype).double(), 0.3, 2.0)
    # The rotation of a nearly reflective matrix is ill conditioned; leave those to float64.
    s = torch.linalg.svdvals(mixed)
    firm = (s[:, 1] - s[:, 2]) / s[:, 0] > (1e-2 if dtype == torch.float32 else 1e-6)
    assert int(firm.sum()) > 300
    assert (rotation.double() - want_rotation)[firm].abs().max() < 100 * TOLERANCE[dtype]
    assert (clamped.double() - want_clamped)[firm].abs().max() < 100 * TOLERANCE[dtype]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_rotation_is_proper_for_every_input(mixed: Tensor, dtype: torch.dtype) -> None:
    degenerate = torch.zeros(4, 3, 3, dtype=torch.float64)
    degenerate[1, 0, 0] = 1.0  # rank one
    degenerate[2] = torch.ones(3, 3)
    degenerate[3, :2, :2] = torch.eye(2)  # flat
    rotation, clamped = polar_clamped(torch.cat([mixed, degenerate]).to(dtype), 0.3, 2.0)
    rotation = rotation.double()
    assert (rotation @ rotation.transpose(1, 2) - EYE).abs().max() < TOLERANCE[dtype]
    assert (torch.linalg.det(rotation) - 1.0).abs().max() < TOLERANCE[dtype]
    stretches = torch.linalg.svdvals(clamped.double())
    assert stretches.min() > 0.3 - 1e-4
    assert stretches.max() < 2.0 + 1e-4
    assert (torch.linalg.det(clamped.double()) > 0).all()


def test_pure_rotation_and_small_strain_are_kept() -> None:
    r = random_rotations(50)
    strain = 1e-5 * torch.randn(50, 3, 3, dtype=torch.float64)
    f = r @ (EYE + strain + strain.transpose(1, 2))
    rotation, clamped = polar_clamped(f)
    assert (rotation - r).abs().max() < 1e-13
    assert (clamped - f).abs().max() < 1e-13


def test_non_finite_entries_yield_identity() -> None:
    f = torch.eye(3).repeat(3, 1, 1)
    f[0, 1, 2] = float("nan")
    f[1, 0, 0] = float("inf")
    rotation, clamped = polar_clamped(f)
    assert torch.equal(rotation, torch.eye(3).repeat(3, 1, 1))
    assert torch.equal(clamped, torch.eye(3).repeat(3, 1, 1))


def test_empty_batch() -> None:
    rotation, clamped = polar_clamped(torch.zeros(0, 3, 3))
    assert rotation.shape == clamped.shape == (0, 3, 3)


def test_registration() -> None:
    torch.library.opcheck(
        torch.ops.gsfluent.polar_clamped.default, (torch.randn(5, 3, 3), 0.3, 2.0)
    )
    compiled = torch.compile(polar_clamped, fullgraph=True, backend="aot_eager")
    f = torch.randn(5, 3, 3)
    for got, want in zip(compiled(f), polar_clamped(f), strict=True):
        assert torch.equal(got, want)


def test_errors_name_the_argument() -> None:
    with pytest.raises(TypeError, match="deformation must be float32 or float64"):
        polar_clamped(torch.zeros(2, 3, 3, dtype=torch.float16))
    with pytest.raises(ValueError, match=r"deformation must have shape"):
        polar_clamped(torch.zeros(2, 9))
    with pytest.raises(ValueError, match="0 < lo <= hi"):
        polar_clamped(torch.zeros(2, 3, 3), 2.0, 0.3)


@pytest.mark.cuda
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_cuda_matches_cpu(mixed: Tensor, dtype: torch.dtype) -> None:
    s = torch.linalg.svdvals(mixed)
    f = mixed[(s[:, 1] - s[:, 2]) / s[:, 0] > 1e-2].to(dtype)
    for got, want in zip(polar_clamped(f.cuda()), polar_clamped(f), strict=True):
        assert (got.cpu() - want).abs().max() < (2e-3 if dtype == torch.float32 else 1e-10)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_what_a_row_gives_does_not_depend_on_its_place(mixed: Tensor, dtype: torch.dtype) -> None:
    flat = torch.randn(9, 3, 1, dtype=torch.float64) @ torch.randn(9, 1, 3, dtype=torch.float64)
    odd = torch.stack([torch.zeros(3, 3), torch.full((3, 3), math.nan), torch.eye(3)]).double()
    given = torch.cat([mixed, flat, odd]).to(dtype)
    for got, again in zip(
        polar_clamped(given), polar_clamped(given.flip(0)[:-3].contiguous()), strict=True
    ):
        assert torch.equal(again, got.flip(0)[:-3])


@pytest.mark.parametrize("bounds", [(0.05, 20.0), (0.8, 1.3)])
def test_gradient_is_that_of_differences(bounds: tuple[float, float]) -> None:
    """Free and clamped stretches; of two and of three that are one only the free are smooth."""
    u, v = random_rotations(4), random_rotations(4)
    s = torch.tensor([[1.9, 1.1, 0.4], [1.25, 1.0, 0.9], [1.6, 1.5, 1.4], [0.7, 0.5, 0.3]])
    given = ((u * s.double()[:, None, :]) @ v.mT).requires_grad_()
    assert torch.autograd.gradcheck(lambda f: polar_clamped(f, *bounds), given)
    same = (random_rotations(3) * torch.tensor([1.1, 1.1, 1.1])).requires_grad_()
    assert torch.autograd.gradcheck(lambda f: polar_clamped(f, *bounds), same)


def test_gradient_of_a_turned_over_map_and_of_none() -> None:
    u, v = random_rotations(1), random_rotations(1)
    turned = ((u * torch.tensor([1.5, 1.0, -0.4])) @ v.mT).requires_grad_()
    assert torch.autograd.gradcheck(lambda f: polar_clamped(f, 0.2, 3.0), turned)
    broken = torch.eye(3, dtype=torch.float64)[None] * math.nan
    broken.requires_grad_()
    (slope,) = torch.autograd.grad(polar_clamped(broken)[0].sum(), broken)
    assert torch.equal(slope, torch.zeros(1, 3, 3, dtype=torch.float64))
