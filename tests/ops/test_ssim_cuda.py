"""ssim and photometric_loss on CUDA against the CPU kernels."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from gsfluent import ops

pytestmark = pytest.mark.cuda

DTYPES = (torch.float32, torch.float64)
BAR = {torch.float32: 2e-6, torch.float64: 1e-12}
# one window; odd sizes around the 128 values of a CTA; channels with and without a kernel of their
# own, up to the most; tall enough for many CTAs in a column
SIZES = ((11, 11, 1), (43, 43, 3), (64, 129, 1), (37, 52, 4), (13, 17, 32), (700, 401, 3))


def images(size: tuple[int, int, int], dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    a, b = torch.rand(2, *size, dtype=torch.float64)
    return a.to(dtype), (0.7 * a + 0.3 * b).to(dtype)


def run(device: str, x: Tensor, y: Tensor, padding: str, given: dict[str, Any]) -> list[Tensor]:
    there = {k: v.to(device) if isinstance(v, Tensor) else v for k, v in given.items()}
    image = x.to(device).requires_grad_()
    leaves = [image]
    if "alpha" in there:
        there["alpha"].requires_grad_()
        leaves.append(there["alpha"])
    out = ops.photometric_loss(image, y.to(device), padding=padding, **there)
    quiet = {k: v.detach() if isinstance(v, Tensor) else v for k, v in there.items()}
    alone = ops.photometric_loss(image.detach(), y.to(device), padding=padding, **quiet)
    grads = torch.autograd.grad(2.0 * out.loss, leaves)
    return [t.detach().cpu() for t in (*out, *alone, *grads)]


def far(a: Tensor, b: Tensor) -> float:
    return float((a - b).abs().max() / b.abs().max().clamp_min(1e-30))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("padding", ["valid", "same"])
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("full", [False, True])
def test_loss_matches_cpu(
    dtype: torch.dtype, padding: str, size: tuple[int, int, int], full: bool
) -> None:
    x, y = images(size, dtype)
    given: dict[str, Any] = {"ssim_weight": 0.3}
    if full:
        names = ("valid", "alpha", "mask")
        given |= {name: torch.rand(size[:2], dtype=dtype) for name in names}
        given |= {"backdrop": torch.rand(size[2], dtype=dtype), "mask_weight": 1.5}
    for a, b in zip(
        run("cuda", x, y, padding, given), run("cpu", x, y, padding, given), strict=True
    ):
        assert a.shape == b.shape and a.dtype == b.dtype
        assert far(a, b) < BAR[dtype] if float(b.abs().max()) > 0 else bool((a == 0).all())


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("padding", ["valid", "same"])
@pytest.mark.parametrize("size", SIZES)
def test_map_and_its_gradients_match_cpu(
    dtype: torch.dtype, padding: str, size: tuple[int, int, int]
) -> None:
    x, y = images(size, dtype)
    results = []
    weight: Tensor | None = None
    for device in ("cpu", "cuda"):
        a, b = (t.to(device).requires_grad_() for t in (x, y))
        value = ops.ssim(a, b, padding=padding, reduction="none")
        weight = torch.randn_like(value) if weight is None else weight
        grads = torch.autograd.grad((value * weight.to(device)).sum(), (a, b))
        results.append([t.detach().cpu() for t in (value, *grads)])
    for a, b in zip(*results, strict=True):
        assert far(b, a) < BAR[dtype]


def test_two_runs_give_the_same_bits() -> None:
    x, y = images((301, 203, 3), torch.float32)
    assert all(
        torch.equal(a, b)
        for a, b in zip(run("cuda", x, y, "valid", {}), run("cuda", x, y, "valid", {}), strict=True)
    )


def test_small_images_and_nan() -> None:
    x, y = images((3, 2, 2), torch.float64)
    got = ops.ssim(x.cuda(), y.cuda(), padding="same").cpu()
    assert float((got - ops.ssim(x, y, padding="same")).abs()) < 1e-12
    x, y = images((90, 70, 3), torch.float32)
    x[40, 30, 1] = float("nan")
    cpu, gpu = (ops.ssim(x.to(d), y.to(d), reduction="none").cpu() for d in ("cpu", "cuda"))
    assert torch.equal(cpu.isnan(), gpu.isnan()) and int(gpu.isnan().sum()) == 121
    equal = ops.ssim(y.cuda(), y.cuda())
    assert equal.item() == 1.0


def test_on_a_stream_of_its_own() -> None:
    x, y = (t.cuda() for t in images((200, 150, 3), torch.float32))
    want = ops.ssim(x, y)
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        got = [ops.ssim(x, y) for _ in range(20)]
    stream.synchronize()
    assert all(torch.equal(g, want) for g in got)


def test_memory_is_what_the_documents_say() -> None:
    x = torch.rand(540, 960, 3, device="cuda", requires_grad=True)
    y = torch.rand_like(x.detach())
    size = x.numel() * x.element_size()
    ops.photometric_loss(x, y)
    torch.cuda.synchronize()
    before = torch.cuda.memory_allocated()
    torch.cuda.reset_peak_memory_stats()
    out = ops.photometric_loss(x, y)
    # held: the gradient; for a moment three planes of slopes; sums and rounding of the allocator
    assert torch.cuda.memory_allocated() - before < 1.1 * size + 2**21
    assert torch.cuda.max_memory_allocated() - before < 4.1 * size + 2**23
    assert out.loss.requires_grad
