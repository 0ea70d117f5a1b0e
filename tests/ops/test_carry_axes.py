"""Axes of Gaussians from covariances, and of Gaussians that ride on deforming matter."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from gsfluent import geometry
from gsfluent.ops import carry_axes, carry_place, covariance_axes, polar_clamped

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


def flock() -> dict[str, Tensor]:
    """Points with neighbours, some parted, and places beside them; float64."""
    generator = torch.Generator().manual_seed(4)
    rest = rand(60, 3, seed=5)
    distance = torch.cdist(rest, rest)
    near = distance.argsort(dim=1)[:, :7]
    parted = torch.rand(60, 7, generator=generator) < 0.3
    parted[:, 0] = False
    owner = torch.randint(0, 60, (300,), generator=generator)
    return {
        "places": rest[owner] + 0.2 * rand(300, 3, seed=6),
        "owner": owner,
        "near": near,
        "parted": parted,
        "rest": rest,
        "position": rest + rand(60, 3, seed=7),
        "map": torch.eye(3, dtype=torch.float64) + 0.2 * rand(60, 3, 3, seed=8),
        "width": 0.3 + 0.1 * rand(60, seed=9).abs(),
    }


def send(inputs: dict[str, Tensor], device: str, dtype: torch.dtype) -> dict[str, Tensor]:
    return {
        name: value.to(device, dtype) if value.is_floating_point() else value.to(device)
        for name, value in inputs.items()
    }


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(("dtype", "bar"), DTYPES)
def test_places_go_with_what_they_hang_together_with(
    device: str, dtype: torch.dtype, bar: float
) -> None:
    a = flock()
    index = a["near"][a["owner"]]
    arm = a["places"][:, None] - a["rest"][index]
    weight = torch.exp(-0.5 * arm.square().sum(2) / a["width"][a["owner"], None].square())
    weight = weight.clamp(min=1e-12) * ~a["parted"][a["owner"]]
    weight = weight / weight.sum(1, keepdim=True)
    moved = a["position"][index] + (a["map"][index] @ arm[..., None])[..., 0]
    means, blend = carry_place(**send(a, device, dtype))
    assert (means.cpu().double() - (weight[..., None] * moved).sum(1)).abs().max() < 10 * bar
    want = (weight[..., None, None] * a["map"][index]).sum(1)
    assert (blend.cpu().double() - want).abs().max() < 10 * bar


@pytest.mark.parametrize("device", DEVICES)
def test_places_without_a_point_stay(device: str) -> None:
    a = send(flock(), device, torch.float32)
    a["owner"][:3] = torch.tensor([-1, 60, 2**40])
    a["near"][5] = -7
    a["parted"][6] = True
    a["owner"][3:5] = torch.tensor([5, 6])
    means, blend = carry_place(**a)
    assert torch.equal(means[:5], a["places"][:5])
    assert torch.equal(blend[:5].cpu(), torch.eye(3).repeat(5, 1, 1))
    none = {**a, "places": a["places"][:0], "owner": a["owner"][:0]}
    assert carry_place(**none)[0].shape == (0, 3)
    with pytest.raises(ValueError, match="parted must have shape"):
        carry_place(**{**a, "parted": a["parted"][:, :3]})
    with pytest.raises(TypeError, match="owner"):
        carry_place(**{**a, "owner": a["owner"].int()})
    torch.library.opcheck(
        torch.ops.gsfluent.carry_place.default,
        tuple(a.values()),
        test_utils=("test_schema", "test_faketensor"),
    )
