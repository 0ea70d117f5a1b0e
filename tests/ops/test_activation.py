"""Activations against autograd of their definition, rules of shape, and what is refused."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.ops.reference import activation as reference
from gsfluent.pipeline.capture.hull import Hull, lattice

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)]
BAR = {torch.float32: 2e-5, torch.float64: 1e-13}
N, REST = 257, 15
WEIGHTS = {"size": 0.3, "needle": 0.07, "aspect": 2.0, "opacity": 0.11}


def raw(dtype: torch.dtype, device: str, columns: int = 3) -> list[Tensor]:
    """Raw scales, opacities and both parts of the harmonics."""
    shapes = ((N, columns), (N,), (N, 1, 3), (N, REST, 3))
    return [torch.randn(s, dtype=dtype).to(device) for s in shapes]


def near(got: Tensor, want: Tensor) -> None:
    assert got.shape == want.shape
    scale = max(1.0, float(want.abs().max()))
    assert float((got.double() - want.double()).abs().max()) < BAR[got.dtype] * scale


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("columns", [1, 3])
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_there_and_back_is_autograd(
    device: str, dtype: torch.dtype, columns: int, degree: int
) -> None:
    given = [x.double().requires_grad_() for x in raw(dtype, device, columns)]
    splats = ops.activate(*[x.detach().to(dtype) for x in given], degree)
    want = reference.activate(*given, degree)
    for got, expected in zip(splats, want, strict=True):
        near(got, expected.detach())
    slopes = [torch.randn_like(x) for x in splats]
    weights = WEIGHTS | ({} if columns == 3 else {"needle": 0.0})
    loss = reference.penalty(want[0], want[1], **weights)
    loss = loss + sum((x * g.double()).sum() for x, g in zip(want, slopes, strict=True))
    expected = torch.autograd.grad(loss, given)
    mark = torch.full((), 2.0, dtype=dtype, device=device)
    found = ops.activate_backward(splats, *slopes, columns=columns, rest=REST, **WEIGHTS, mark=mark)
    for got, slope in zip(found, expected, strict=True):
        near(got, slope)
    assert float(mark) == 2.0


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("where", ["scales", "opacities"])
@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_a_splat_without_finite_shape_marks(device: str, where: str, bad: float) -> None:
    splats = ops.activate(*raw(torch.float32, device), 0)
    getattr(splats, where).reshape(-1)[-1] = bad
    mark = torch.zeros((), device=device)
    found = ops.activate_backward(splats, *splats, rest=REST, mark=mark)
    assert bool(mark.isnan())
    assert all(bool(x[:-1].isfinite().all()) for x in found)


@pytest.mark.parametrize("device", DEVICES)
def test_longest_axis_is_clamped_and_nothing_else(device: str) -> None:
    scales = torch.randn(N, 3, device=device)
    before = scales.clone()
    ops.clamp_aspect(scales, 4.0)
    axes, was = (x.sort(dim=1).values for x in (scales, before))
    assert torch.equal(axes[:, :2], was[:, :2])
    limit = was[:, 1] + torch.tensor(4.0).log().to(device)
    assert torch.allclose(axes[:, 2], torch.minimum(was[:, 2], limit), atol=1e-6)
    assert 0 < int((axes[:, 2] < was[:, 2]).sum()) < N
    again = scales.clone()
    ops.clamp_aspect(again, 4.0)
    assert torch.equal(again, scales)


def ball(device: str) -> Hull:
    side = 32
    points = lattice((side,) * 3) / side - 0.5
    inside = (points.norm(dim=1) < 0.4).reshape((side,) * 3)
    return Hull(inside.to(device), torch.full((3,), -0.5, device=device), 1.0 / side)


@pytest.mark.parametrize("device", DEVICES)
def test_axes_end_at_the_body(device: str) -> None:
    hull, overhang = ball(device), 0.02
    means = 0.25 * torch.randn(N, 3)
    shape = [means, torch.randn(N, 4), 0.01 * 30.0 ** torch.rand(N, 3), torch.rand(N)]
    shape = [x.to(device) for x in shape]
    away, origin = hull.distances()
    arguments = {"origin": origin, "voxel": hull.voxel, "overhang": overhang}
    share = ops.shorten_axes(*shape, away, **arguments)
    want = reference.shorten_axes(*shape, hull.beyond, overhang)
    # a halving on the edge may fall either way
    step = 1.0 / 256
    assert float((share - want).abs().max()) <= 1.01 * step
    assert float(((share - want).abs() > 1e-6).float().mean()) < 0.01
    assert 0 < int((share < 1).sum()) < share.numel()
    assert float(share.min()) == pytest.approx(0.02)
    # what was cut once fits, unless too little of it would be left
    cut = [shape[0], shape[1], shape[2] * share, shape[3]]
    again = ops.shorten_axes(*cut, away, **arguments)
    assert bool((again[share > 0.02] == 1).all())


@pytest.mark.parametrize("device", DEVICES)
def test_places_off_the_grid_or_not_finite_are_safe(device: str) -> None:
    hull = ball(device)
    means = torch.tensor([[1e30, 0, 0], [float("nan"), 0, 0], [float("inf"), 0, 0], [0.0, 0, 0]])
    shape = [means, torch.zeros(4, 4), torch.full((4, 3), 0.01), torch.ones(4)]
    away, origin = hull.distances()
    share = ops.shorten_axes(
        *[x.to(device) for x in shape], away, origin=origin, voxel=hull.voxel, overhang=0.01
    )
    assert torch.equal(share[:3].cpu(), torch.full((3, 3), 0.02))
    assert torch.equal(share[3].cpu(), torch.ones(3))


def test_nothing_is_nothing() -> None:
    empty = [torch.zeros(0, 3), torch.zeros(0), torch.zeros(0, 1, 3), torch.zeros(0, 15, 3)]
    splats = ops.activate(*empty, 3)
    found = ops.activate_backward(splats, *splats, rest=15)
    assert [list(x.shape) for x in found] == [list(x.shape) for x in empty]
    ops.clamp_aspect(empty[0], 4.0)


def _activate(**changes: object) -> Callable[[], object]:
    names = ("scales", "opacities", "sh0", "sh_rest")
    given = dict(zip(names, raw(torch.float32, "cpu"), strict=True)) | {"degree": 1} | changes
    return lambda: ops.activate(**given)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (_activate(scales=torch.zeros(N, 2)), "1 or 3 columns"),
        (_activate(opacities=torch.zeros(3)), "opacities"),
        (_activate(sh_rest=torch.zeros(N, 2, 3)), r"degree must lie in 0\.\.0"),
        (_activate(degree=4), "degree"),
        (lambda: ops.clamp_aspect(torch.zeros(3, 4)[:, :3], 2.0), "contiguous"),
        (lambda: ops.clamp_aspect(torch.zeros(3, 3), 0.5), "at least 1"),
    ],
)
def test_what_does_not_fit_is_named(call: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call()
