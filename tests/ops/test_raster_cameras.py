"""Several cameras in one call, median depth, optional depth, absolute gradients."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
import torch
from raster_scene import HEIGHT, WIDTH, cameras, relative_error, scene
from torch import Tensor

from gsfluent.ops import Rendered, rasterize
from gsfluent.ops.reference import raster as reference

CAMERAS = 3
DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)]
# Largest error of a value and of a gradient (see test_raster.py).
BARS = {
    ("cpu", torch.float64): (1e-12, 1e-11),
    ("cpu", torch.float32): (2e-5, 1e-4),
    ("cuda", torch.float64): (1e-10, 1e-9),
    ("cuda", torch.float32): (2e-4, 1e-3),
}


@pytest.fixture
def threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def batch(
    count: int, dtype: torch.dtype, own_background: bool = True, device: str = "cpu"
) -> dict[str, Tensor]:
    """A scene with the inputs that every camera has for itself."""
    g = torch.Generator().manual_seed(11)
    inputs = scene(count)
    shape = (CAMERAS, 3) if own_background else (3,)
    inputs["background"] = torch.rand(shape, generator=g, dtype=torch.float64)
    offset = torch.randn(CAMERAS, count, 2, generator=g, dtype=torch.float64)
    inputs["means2d_offset"] = 0.5 * offset
    inputs["means2d_absgrad"] = torch.zeros(CAMERAS, count, 2, dtype=torch.float64)
    return {k: v.to(device, dtype).requires_grad_() for k, v in inputs.items()}


def view(op: Any, inputs: dict[str, Tensor], viewmat: Tensor, K: Tensor, **options: Any) -> Any:
    rest = {k: v for k, v in inputs.items() if k not in ("means", "opacities")}
    dtype = inputs["means"].dtype
    args = (inputs["means"], inputs["opacities"], viewmat.to(dtype), K.to(dtype), WIDTH, HEIGHT)
    return op(*args, **rest, **options)


def loss(outputs: tuple[Tensor, ...]) -> Tensor:
    """A weighted sum of image, alpha, depth and normal, the same for every dtype."""
    g = torch.Generator().manual_seed(3)
    total = outputs[0].new_zeros(())
    for value in outputs[:4]:
        weight = torch.randn(value.shape, generator=g, dtype=torch.float64)
        total = total + (value * weight.to(value.device, value.dtype)).sum()
    return total


@pytest.mark.parametrize("grouped", [False, True])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=str)
@pytest.mark.parametrize("device", DEVICES)
def test_cameras_median_and_absolute_gradients_equal_reference(
    device: str, dtype: torch.dtype, grouped: bool
) -> None:
    viewmat, K = cameras(CAMERAS)
    ours, theirs = batch(40, dtype, device=device), batch(40, torch.float64)
    groups = torch.arange(40, dtype=torch.int32) % 9 - 1 if grouped else None
    moved = None if groups is None else groups.to(device)
    options = {"contribution": True, "median_depth": True, "antialiased": True}
    got = view(rasterize, ours, viewmat, K, groups=moved, **options)
    want = view(reference.rasterize, theirs, viewmat, K, groups=groups, antialiased=True)
    value_bar, gradient_bar = BARS[device, dtype]
    for value, expected in zip(got[:5], want[:5], strict=True):
        assert relative_error(value.detach().cpu(), expected.detach()) < value_bar
    assert want[5].max() > 0
    # A pixel that is within rounding of transmittance 1/2 may take the next splat.
    off = (got.median_depth.double().cpu() - want[5]).abs() > value_bar
    assert off.double().mean() <= (0.0 if dtype == torch.float64 else 1e-3)
    loss(got).backward()
    loss(want).backward()
    for key, leaf in ours.items():
        assert relative_error(leaf.grad.cpu(), theirs[key].grad) < gradient_bar, key


def test_cameras_together_equal_cameras_one_by_one() -> None:
    viewmat, K = cameras(CAMERAS)
    together = batch(300, torch.float32, own_background=False)
    alone = {k: v.detach().clone().requires_grad_() for k, v in together.items()}
    options = {"contribution": True, "median_depth": True}
    got = view(rasterize, together, viewmat, K, **options)
    loss(got).backward()
    singles = []
    for c in range(CAMERAS):
        own = dict(alone)
        for key in ("means2d_offset", "means2d_absgrad"):
            own[key] = alone[key][c]
        singles.append(view(rasterize, own, viewmat[c], K[c], **options))
    for name in ("image", "alpha", "depth", "normal", "radii", "median_depth"):
        expected = torch.stack([getattr(s, name) for s in singles])
        assert torch.equal(getattr(got, name), expected), name
    contribution = sum(s.contribution for s in singles)
    torch.testing.assert_close(got.contribution, contribution, rtol=1e-6, atol=0)
    loss(tuple(torch.stack([s[k] for s in singles]) for k in range(4))).backward()
    for key, value in together.items():
        assert relative_error(value.grad, alone[key].grad) < 1e-5, key


def test_cameras_give_the_same_bits_for_any_number_of_threads(threads: None) -> None:
    viewmat, K = cameras(CAMERAS)
    results = []
    for count in (1, 3, 4):  # fewer, as many and more threads than cameras
        torch.set_num_threads(count)
        inputs = batch(3000, torch.float32)
        out = view(rasterize, inputs, viewmat, K, contribution=True, median_depth=True)
        loss(out).backward()
        results.append([*out, *(v.grad for v in inputs.values())])
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_depth_can_be_left_out() -> None:
    viewmat, K = cameras(1)
    inputs = {k: v.float() for k, v in scene(100).items()}

    def render(**options: Any) -> tuple[Rendered, dict[str, Tensor]]:
        leaves = {k: v.clone().requires_grad_() for k, v in inputs.items()}
        out = view(rasterize, leaves, viewmat[0], K[0], median_depth=True, **options)
        (out.image.sum() + out.normal.square().sum()).backward()
        return out, {k: v.grad for k, v in leaves.items()}

    (full, full_grad), (bare, bare_grad) = render(), render(depth=False)
    assert bare.depth is None
    for name in ("image", "alpha", "normal", "median_depth", "radii"):
        assert torch.equal(getattr(full, name), getattr(bare, name)), name
    for key, value in full_grad.items():
        assert torch.equal(value, bare_grad[key]), key


def stack(opacities: list[float]) -> Rendered:
    """Screen-filling splats on the axis at z = 2, 3, ..."""
    count = len(opacities)
    means = torch.zeros(count, 3)
    means[:, 2] = torch.arange(count) + 2.0
    return rasterize(
        means,
        torch.tensor(opacities),
        torch.eye(4),
        torch.tensor([[32.0, 0, 16], [0, 32.0, 16], [0, 0, 1]]),
        32,
        32,
        quats=torch.tensor([[1.0, 0, 0, 0]]).expand(count, 4),
        scales=torch.full((count, 3), 1000.0),
        colors=torch.ones(count, 1),
        median_depth=True,
    )


@pytest.mark.parametrize(
    ("opacities", "depth"),
    [([0.4], 0.0), ([0.6, 0.9], 2.0), ([0.3, 0.2, 0.3, 0.9], 4.0), ([0.2] * 12, 5.0)],
)
def test_median_depth_is_where_half_the_light_is_gone(opacities: list[float], depth: float) -> None:
    median = stack(opacities).median_depth
    assert median is not None and (median == depth).all()


def test_absolute_gradients_do_not_cancel() -> None:
    """A symmetric splat under a uniform loss: the gradient of its centre cancels, this one not."""
    offset = torch.zeros(1, 2, requires_grad=True)
    absolute = torch.zeros(1, 2, requires_grad=True)
    out = rasterize(
        torch.tensor([[0.0, 0.0, 1.0]]),
        torch.tensor([0.5]),
        torch.eye(4),
        torch.tensor([[32.0, 0, 16], [0, 32.0, 16], [0, 0, 1]]),
        32,
        32,
        quats=torch.tensor([[1.0, 0, 0, 0]]),
        scales=torch.full((1, 3), 0.1),
        colors=torch.ones(1, 1),
        means2d_offset=offset,
        means2d_absgrad=absolute,
        depth=False,
    )
    out.image.sum().backward()
    assert offset.grad.abs().max() < 1e-5
    # sum of |dx| / sigma^2 alpha over the plane; the cut at alpha = 1/255 takes 2 % of it
    variance = 3.2**2 + 0.3
    exact = 0.5 * 2 * torch.pi * variance * (2 / torch.pi) ** 0.5 / variance**0.5
    assert torch.allclose(absolute.grad, torch.full((1, 2), exact), rtol=0.03)


ERRORS: dict[str, tuple[dict[str, Any], str]] = {
    "one K": ({"K": torch.eye(3)}, "K must have shape [3, 3, 3], got [3, 3]"),
    "offset": ({"means2d_offset": torch.zeros(5, 2)}, "means2d_offset must have shape [3, 5, 2]"),
    "absolute": ({"means2d_absgrad": torch.zeros(3, 4, 2)}, "means2d_absgrad must have shape"),
    "background": ({"background": torch.zeros(2, 3)}, "background must have shape [3, 3]"),
    "no camera": (
        {"viewmat": torch.zeros(0, 4, 4), "K": torch.zeros(0, 3, 3)},
        "viewmat must hold at least one camera",
    ),
}


@pytest.mark.parametrize("name", ERRORS)
def test_wrong_batches_are_named(name: str) -> None:
    changes, message = ERRORS[name]
    viewmat, K = cameras(CAMERAS)
    tensors = {k: v.float() for k, v in scene(5).items() if k != "means2d_offset"}
    call = tensors | {"viewmat": viewmat, "K": K, "width": WIDTH, "height": HEIGHT} | changes
    with pytest.raises(ValueError, match="rasterize: ") as error:
        rasterize(**call)
    assert message in str(error.value)
