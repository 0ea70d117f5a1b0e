"""``rasterize(deterministic=True)``: gradients without an order, on a GPU as on the CPU."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from raster_scene import camera, cameras
from torch import Tensor

from gsfluent.ops import rasterize

CUDA = pytest.param("cuda", marks=pytest.mark.cuda)
WIDTH, HEIGHT, COUNT = 200, 152, 6000
REPEATS = 5
KINDS = ("sh", "features", "normals", "groups", "absolute", "covars", "cameras")
"""Each takes another way through the kernels: words in one array or three, rounds of eight."""


def crowd(kind: str, device: str, dtype: torch.dtype) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Options, and leaves that require grad: thousands of splats, many warps to each."""
    g = torch.Generator().manual_seed(4)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=g, dtype=torch.float64)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=g, dtype=torch.float64)

    means = normal(COUNT, 3) * 0.6
    means[:, 2] += 3.0
    leaves = {"means": means, "opacities": 0.02 + 0.5 * uniform(COUNT)}
    if kind == "covars":
        spread = 0.05 * normal(COUNT, 3, 3)
        full = spread @ spread.mT + 1e-4 * torch.eye(3, dtype=torch.float64)
        pick = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
        leaves["covars"] = torch.stack([full[:, i, j] for i, j in pick], -1)
    else:
        leaves |= {"quats": normal(COUNT, 4), "scales": 0.01 + 0.15 * uniform(COUNT, 3)}
    options: dict[str, Any] = {"depth": kind != "sh"}
    if kind == "features":
        leaves |= {"colors": uniform(COUNT, 16), "background": uniform(16)}
    else:
        leaves |= {"sh": 0.3 * normal(COUNT, 9, 3), "background": uniform(3)}
    if kind == "normals":
        leaves["normals"] = normal(COUNT, 3)
    if kind == "groups":
        options["groups"] = torch.randint(-1, 900, (COUNT,), generator=g, dtype=torch.int32)
    if kind == "absolute":
        leaves["means2d_absgrad"] = torch.zeros(COUNT, 2, dtype=torch.float64)
    viewmat, K = cameras(3) if kind == "cameras" else camera()
    K = K.clone()
    K[..., :2, :] *= 4.0
    options |= {"viewmat": viewmat.to(dtype), "K": K.to(dtype)}
    options = {k: v.to(device) if isinstance(v, Tensor) else v for k, v in options.items()}
    return options, {k: v.to(device, dtype).requires_grad_() for k, v in leaves.items()}


def pulls(outputs: Any) -> list[tuple[Tensor, Tensor]]:
    """Outputs and the gradients that are sent back through them, the same for every dtype."""
    g = torch.Generator().manual_seed(5)
    found = []
    for value in (outputs.image, outputs.alpha, outputs.depth, outputs.normal):
        if value is not None:
            pull = torch.randn(value.shape, generator=g, dtype=torch.float64)
            found.append((value, pull.to(value)))
    return found


def gradients(
    options: dict[str, Any], leaves: dict[str, Tensor], deterministic: bool, pull: Any = pulls
) -> dict[str, Tensor]:
    rest = {k: v for k, v in (options | leaves).items() if k not in ("means", "opacities")}
    viewmat, K = rest.pop("viewmat"), rest.pop("K")
    outputs = rasterize(
        leaves["means"], leaves["opacities"], viewmat, K, WIDTH, HEIGHT, **rest,
        deterministic=deterministic,
    )  # fmt: skip
    pairs = pull(outputs)
    found = torch.autograd.grad([p[0] for p in pairs], list(leaves.values()), [p[1] for p in pairs])
    return dict(zip(leaves, found, strict=True))


@pytest.mark.parametrize("device", ["cpu", CUDA])
@pytest.mark.parametrize("kind", KINDS)
def test_the_same_bits_in_every_run(kind: str, device: str) -> None:
    options, leaves = crowd(kind, device, torch.float32)
    first = gradients(options, leaves, True)
    for _ in range(REPEATS - 1):
        again = gradients(options, leaves, True)
        for name, value in first.items():
            assert torch.equal(value, again[name]), name


@pytest.mark.parametrize("device", ["cpu", CUDA])
@pytest.mark.parametrize("kind", KINDS)
def test_agrees_with_the_fast_mode(kind: str, device: str) -> None:
    for dtype, bar in ((torch.float32, 1e-5), (torch.float64, 1e-13)):
        options, leaves = crowd(kind, device, dtype)
        fast, ordered = gradients(options, leaves, False), gradients(options, leaves, True)
        for name, value in fast.items():
            assert float(value.norm()) > 0
            assert float((ordered[name] - value).norm()) <= bar * float(value.norm()), name


@pytest.mark.cuda
def test_a_bright_pixel_does_not_coarsen_the_rest() -> None:
    """Gradients of 1e9 in one corner, of 1e-9 elsewhere: what the corner does not touch stays."""
    options, leaves = crowd("sh", "cuda", torch.float32)

    def dim(outputs: Any) -> list[tuple[Tensor, Tensor]]:
        g = torch.Generator().manual_seed(6)
        pull = 1e-9 * torch.randn(outputs.image.shape, generator=g)
        pull[:8, :8] = 0.0
        return [(outputs.image, pull.cuda())]

    def mixed(outputs: Any) -> list[tuple[Tensor, Tensor]]:
        (value, pull), *_ = dim(outputs)
        pull[:8, :8] = 1e9
        return [(value, pull)]

    alone, both = gradients(options, leaves, True, dim), gradients(options, leaves, True, mixed)
    untouched = both["sh"].abs().flatten(1).amax(1) < 1.0
    seen = alone["sh"].abs().flatten(1).amax(1) > 0
    assert int((untouched & seen).sum()) > COUNT // 4
    for name in ("sh", "opacities", "means"):
        want, have = alone[name][untouched & seen], both[name][untouched & seen]
        assert float((have - want).norm()) <= 1e-6 * float(want.norm()), name


@pytest.mark.cuda
@pytest.mark.parametrize("wrong", [float("nan"), float("inf")])
def test_what_is_not_finite_spoils_the_same_splats(wrong: float) -> None:
    options, leaves = crowd("sh", "cuda", torch.float32)

    def broken(outputs: Any) -> list[tuple[Tensor, Tensor]]:
        (value, pull), *_ = pulls(outputs)
        pull[40, 50, 1] = wrong
        return [(value, pull)]

    fast = gradients(options, leaves, False, broken)
    ordered = gradients(options, leaves, True, broken)
    spoilt = ~torch.isfinite(fast["sh"]).flatten(1).all(1)
    assert 0 < int(spoilt.sum()) < COUNT
    assert torch.equal(spoilt, ~torch.isfinite(ordered["sh"]).flatten(1).all(1))


@pytest.mark.cuda
def test_blend_weights_have_no_order() -> None:
    options, leaves = crowd("sh", "cuda", torch.float32)
    plain = {k: v.detach() for k, v in leaves.items()}
    rest = {k: v for k, v in (options | plain).items() if k not in ("means", "opacities")}
    viewmat, K = rest.pop("viewmat"), rest.pop("K")
    runs = [
        rasterize(plain["means"], plain["opacities"], viewmat, K, WIDTH, HEIGHT, **rest,
                  contribution=True)
        for _ in range(REPEATS)
    ]  # fmt: skip
    for run in runs[1:]:
        assert torch.equal(run.contribution, runs[0].contribution)
        assert torch.equal(run.image, runs[0].image)
    total, alpha = runs[0].contribution.double().sum(), runs[0].alpha.double().sum()
    torch.testing.assert_close(total, alpha, rtol=1e-6, atol=0)


@pytest.mark.cuda
def test_follows_the_switch_of_torch() -> None:
    options, leaves = crowd("sh", "cuda", torch.float32)
    want = gradients(options, leaves, True)
    torch.use_deterministic_algorithms(True)
    try:
        have = gradients(options, leaves, False)
    finally:
        torch.use_deterministic_algorithms(False)
    assert all(torch.equal(have[name], want[name]) for name in want)
