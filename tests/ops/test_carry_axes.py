"""Axes of Gaussians from covariances, and of Gaussians that ride on deforming matter."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from gsfluent import geometry
from gsfluent.ops import carry_axes, covariance_axes, polar_clamped

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)]
DTYPES = [(torch.float32, 2e-5), (torch.float64, 1e-12)]


def rand(*shape: int, seed: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def splats(count: int = 500) -> tuple[Tensor, Tensor]:
    """Quaternions of any length, axis ratios to 30."""
    return rand(count, 4, seed=1), 0.01 * torch.exp(0.8 * rand(count, 3, seed=2)).clamp(0.1, 3.0)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(("dtype", "bar"), DTYPES)
def test_covariances_come_back(device: str, dtype: torch.dtype, bar: float) -> None:
    packed = geometry.covariance(*splats()).to(device, dtype)
    quats, scales = covariance_axes(packed)
    again = geometry.covariance(quats, scales)
    size = packed.abs().amax(1, keepdim=True)
    assert ((again - packed) / size).abs().max() < bar
    assert (quats.norm(dim=1) - 1.0).abs().max() < bar
    assert (scales[:, :-1] >= scales[:, 1:]).all()


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(("dtype", "bar"), DTYPES)
def test_carried_covariance_is_that_of_the_map(device: str, dtype: torch.dtype, bar: float) -> None:
    quats, scales = splats()
    bend = torch.eye(3, dtype=torch.float64) + 0.3 * rand(500, 3, 3, seed=3)
    rotation, clamped = polar_clamped(bend, 0.6, 1.5)
    clamped[:100] = rotation[:100]  # these only turn
    moved = [t.to(device, dtype) for t in (quats, scales, clamped, rotation)]
    new_quats, new_scales = carry_axes(*moved, rigid=1e-3)
    full = geometry.unpack_symmetric(geometry.covariance(quats, scales))
    want = geometry.pack_symmetric(clamped @ full @ clamped.mT)
    got = geometry.covariance(new_quats.cpu().double(), new_scales.cpu().double())
    assert ((got - want) / want.abs().amax(1, keepdim=True)).abs().max() < bar
    assert torch.equal(new_scales[:100], moved[1][:100])
    stretch = new_scales.amax(1) / moved[1].amax(1)
    assert stretch.min() > 0.6 - 1e-4 and stretch.max() < 1.5 + 1e-4


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("bad", [float("nan"), float("inf"), 0.0, 1e30])
def test_bad_maps_leave_a_gaussian(device: str, bad: float) -> None:
    quats, scales = (t.float().to(device) for t in splats(8))
    eye = torch.eye(3, device=device).repeat(8, 1, 1)
    spoilt = eye.clone()
    spoilt[::2] = bad
    for name in ("map", "rotation"):
        maps = {"map": eye, "rotation": eye} | {name: spoilt}
        new_quats, new_scales = carry_axes(quats, scales, **maps, rigid=1e-3)
        assert torch.isfinite(new_quats).all() and torch.isfinite(new_scales).all()
        assert torch.equal(new_scales[1::2], scales[1::2])
    broken = torch.full((3, 6), bad, device=device)
    got_quats, got_scales = covariance_axes(broken)
    assert torch.isfinite(got_quats).all() and torch.isfinite(got_scales).all()
    zero = carry_axes(torch.zeros_like(quats), scales, eye, eye, rigid=1e-3)[0]
    assert torch.equal(zero, quats.new_tensor([1.0, 0, 0, 0]).expand(8, 4))


def test_errors_and_registration() -> None:
    quats, scales = splats(5)
    eye = torch.eye(3, dtype=torch.float64).repeat(5, 1, 1)
    with pytest.raises(ValueError, match="covariance must have shape"):
        covariance_axes(torch.zeros(3, 5))
    with pytest.raises(ValueError, match="rigid must not be negative"):
        carry_axes(quats, scales, eye, eye, rigid=float("nan"))
    with pytest.raises(TypeError, match="map"):
        carry_axes(quats, scales, eye.float(), eye, rigid=0.0)
    assert covariance_axes(torch.zeros(0, 6))[0].shape == (0, 4)
    names = ("test_schema", "test_faketensor")
    arguments = (quats, scales, eye, eye, 1e-3)
    torch.library.opcheck(torch.ops.gsfluent.carry_axes.default, arguments, test_utils=names)
    packed = geometry.covariance(quats, scales)
    torch.library.opcheck(torch.ops.gsfluent.covariance_axes.default, (packed,), test_utils=names)
