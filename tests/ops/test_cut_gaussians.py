"""Gaussians cut at planes and at the borders of cells, against the definition in PyTorch."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from gsfluent import geometry
from gsfluent.ops import cut_at_cells, cut_by_planes
from gsfluent.ops.reference import deform as reference

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)]
DTYPES = [(torch.float32, 3e-5), (torch.float64, 1e-11)]


def rand(*shape: int, seed: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def splats(count: int) -> list[Tensor]:
    scales = 0.3 * torch.exp(0.5 * rand(count, 3, seed=2))
    return [rand(count, 3, seed=1), rand(count, 4, seed=3), scales]


def cells(count: int = 400) -> dict[str, Tensor]:
    rest = rand(80, 3, seed=5)
    near = torch.cdist(rest, rest).argsort(dim=1)[:, :9]
    opened = rand(80, 9, seed=6) < -0.3
    owner = torch.cdist(splats(count)[0], rest).argmin(dim=1)
    return {"owner": owner, "near": near, "opened": opened, "rest": rest}


def moved(values: dict[str, Tensor], device: str, dtype: torch.dtype) -> dict[str, Tensor]:
    return {
        name: value.to(device, dtype if value.is_floating_point() else value.dtype)
        for name, value in values.items()
    }


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(("dtype", "bar"), DTYPES)
def test_cells_cut_as_defined(device: str, dtype: torch.dtype, bar: float) -> None:
    means, quats, scales = splats(400)
    rows, mean, covariance = reference.cut_at_cells(means, quats, scales, **cells(), slack=0.2)
    given = [value.to(device, dtype) for value in (means, quats, scales)]
    cut, *now = cut_at_cells(*given, **moved(cells(), device, dtype), slack=0.2)
    assert 50 < len(rows) < 350
    # float32 may see a border otherwise that a splat just reaches
    sure = cut.cpu().nonzero()[:, 0]
    assert len(set(sure.tolist()) ^ set(rows.tolist())) <= (2 if dtype == torch.float32 else 0)
    want = torch.full((400, 9), math.nan, dtype=torch.float64)
    want[rows] = torch.cat([mean, geometry.pack_symmetric(covariance)], dim=1)
    got = torch.cat([now[0], geometry.covariance(now[1], now[2])], dim=1).cpu().double()
    both = cut.cpu() & ~want[:, 0].isnan()
    off = (got[both] - want[both]).abs().amax(dim=1)
    assert (off > bar).sum() <= (2 if dtype == torch.float32 else 0)
    for before, after in zip(given, now, strict=True):
        assert torch.equal(before[~cut], after[~cut])


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(("dtype", "bar"), DTYPES)
def test_planes_cut_one_after_another(device: str, dtype: torch.dtype, bar: float) -> None:
    """None, one or three planes each, by shares; distances count from the whole splat."""
    means, quats, scales = splats(60)
    counts = torch.arange(60) % 3 + (torch.arange(60) % 3 == 2)
    first = torch.nn.functional.pad(counts.cumsum(0), (1, 0))
    planes = int(first[-1])
    normal = torch.nn.functional.normalize(rand(planes, 3, seed=8), dim=1)
    distance, share = 0.4 * rand(planes, seed=9), torch.sigmoid(rand(planes, seed=10))
    distance[3] = math.inf
    whole = means + 0.05 * rand(60, 3, seed=11)
    covariance = geometry.covariance(quats, scales)
    want = []
    for i in range(60):
        mean, full = means[i : i + 1], geometry.unpack_symmetric(covariance[i : i + 1])
        for e in range(int(first[i]), int(first[i + 1])):
            gone = distance[e] - (mean - whole[i]) @ normal[e]
            cut, shrunk = reference.cut_at(mean, full, normal[e : e + 1], gone)
            mean, full = mean + share[e] * (cut - mean), full + share[e] * (shrunk - full)
        want.append(torch.cat([mean, geometry.pack_symmetric(full)], dim=1))
    values = {"normal": normal, "distance": distance, "share": share, "whole": whole}
    values = moved(values | {"first": first}, device, dtype)
    now = cut_by_planes(means.to(device, dtype), covariance.to(device, dtype), **values)
    got = torch.cat([now[0], geometry.covariance(now[1], now[2])], dim=1).cpu().double()
    assert (got - torch.cat(want)).abs().max() < bar
    assert torch.equal(now[0][::3].cpu(), means.to(dtype)[::3])  # no plane: as it was


@pytest.mark.parametrize("device", DEVICES)
def test_rows_that_are_none_are_passed_over(device: str) -> None:
    given = [value.to(device) for value in splats(400)]
    values = moved(cells(), device, torch.float64)
    values["owner"][::2] = torch.tensor([-1, 80, 1 << 40, -(1 << 40)], device=device).repeat(50)
    values["near"][::3] = 1 << 50
    cut, *now = cut_at_cells(*given, **values, slack=0.0)
    assert not cut[::2].any() and cut[1::2].any()
    assert torch.equal(now[0][::2], given[0][::2])
    first = torch.tensor([5, -3, 1 << 40, 2], device=device)
    out = cut_by_planes(
        given[0][:3], geometry.covariance(given[1], given[2])[:3], first=first,
        normal=given[0].new_tensor([[0.0, 0.0, 1.0]] * 4), distance=given[0].new_zeros(4),
    )  # fmt: skip
    assert all(bool(torch.isfinite(value).all()) for value in out)


def test_errors_empty_sets_and_registration() -> None:
    given, values = splats(5), cells(5)
    with pytest.raises(ValueError, match="owner"):
        cut_at_cells(*given, **values | {"owner": values["owner"][:3]}, slack=0.0)
    with pytest.raises(TypeError, match="opened"):
        cut_at_cells(*given, **values | {"opened": values["opened"].int()}, slack=0.0)
    none = [value[:0] for value in given]
    assert cut_at_cells(*none, **values | {"owner": values["owner"][:0]}, slack=0.0)[0].shape == (
        0,
    )
    packed = geometry.covariance(given[1], given[2])
    first, normal = torch.arange(6), given[0].new_tensor([[1.0, 0.0, 0.0]] * 5)
    with pytest.raises(ValueError, match="first"):
        cut_by_planes(given[0], packed, first=first[:5], normal=normal, distance=given[0][:, 0])
    names = ("test_schema", "test_faketensor")
    lib = torch.ops.gsfluent
    arguments = (*given, *values.values(), 0.1)
    torch.library.opcheck(lib.cut_at_cells.default, arguments, test_utils=names)
    flat = (given[0], given[0], packed, first, normal, given[0][:, 0], given[2][:, 0])
    torch.library.opcheck(lib.cut_by_planes.default, flat, test_utils=names)
