"""MPM operators on CUDA against the CPU kernels."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.ops.blocks import Blocks

pytestmark = pytest.mark.cuda

DX = 0.0625
N = 3000


def scene(dtype: torch.dtype, fields: int) -> dict[str, Tensor]:
    c = {
        "position": torch.rand(N, 3, dtype=dtype) - 0.3,
        "velocity": torch.randn(N, 3, dtype=dtype),
        "affine": torch.randn(N, 3, 3, dtype=dtype),
        "mass": torch.rand(N, dtype=dtype) + 0.1,
        "stress": torch.randn(N, 6, dtype=dtype),
        "volume": torch.rand(N, dtype=dtype) * 1e-3,
    }
    c["body"] = torch.randint(0, fields, (N,), dtype=torch.int32)
    return c


def on(device: str, c: dict[str, Tensor]) -> dict[str, Tensor]:
    return {k: v.to(device) for k, v in c.items()}


def blocks_on(device: str, blocks: Blocks) -> Blocks:
    return blocks._replace(
        **{k: getattr(blocks, k).to(device) for k in ("table", "coords", "order", "start")}
    )


def step(c: dict[str, Tensor], blocks: Blocks, fields: int) -> tuple[Tensor, ...]:
    colliders = torch.zeros(2, 16, dtype=c["mass"].dtype)
    colliders[0, [1, 2, 8, 5, 13]] = torch.tensor([2, 0.4, 1, -0.1, 0.2], dtype=c["mass"].dtype)
    colliders[1, [0, 1, 3, 9, 10]] = torch.tensor([1, 1, 0.4, 0.23, 0.5], dtype=c["mass"].dtype)
    kw: dict[str, Any] = {"dx": DX, "blocks": blocks}
    grid, moments = ops.p2g(
        c["position"],
        c["velocity"],
        c["affine"],
        c["mass"],
        dt=1e-2,
        stress=c["stress"],
        volume=c["volume"],
        body=c["body"],
        fields=fields,
        contact=fields > 1,
        **kw,
    )
    v, impulse, touched = ops.grid_update(
        grid, dt=1e-2, colliders=colliders.to(grid.device), moments=moments, **kw
    )
    moved = ops.g2p(
        v,
        c["position"],
        dt=1e-2,
        body=c["body"],
        velocity=c["velocity"],
        deformation=c["affine"],
        return_skipped=True,
        **kw,
    )
    out = (grid, v, impulse, touched, *moved)
    return out if moments is None else (*out, moments)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("fields", [1, 3])
def test_step_matches_cpu(dtype: torch.dtype, fields: int) -> None:
    c = scene(dtype, fields)
    blocks = ops.build_blocks(c["position"], DX)
    c["position"] = c["position"] + (torch.rand(N, 3, dtype=dtype) - 0.5) * DX
    c["position"][5], c["position"][6] = float("nan"), 40.0
    cpu = step(c, blocks, fields)
    gpu = step(on("cuda", c), blocks_on("cuda", blocks), fields)
    assert cpu[8].item() == 2
    for a, b in zip(cpu, gpu, strict=True):
        b = b.cpu()
        assert a.dtype == b.dtype and a.shape == b.shape
        a, b = a.nan_to_num(), b.nan_to_num()
        # A node exactly between "touch" and "free" may go either way in float32: compare the bulk.
        error = (a.double() - b.double()).abs() / max(float(a.abs().double().max()), 1.0)
        share = (error > (2e-4 if dtype == torch.float32 else 1e-10)).double().mean()
        assert share <= (1e-3 if dtype == torch.float32 and fields > 1 else 0.0)


def test_build_blocks_matches_cpu() -> None:
    x = scene(torch.float64, 1)["position"]
    for margin in (0, 1, 2):
        a, b = ops.build_blocks(x, DX, margin=margin), ops.build_blocks(x.cuda(), DX, margin=margin)
        assert a.origin == b.origin
        for name in ("table", "coords", "order", "start"):
            assert torch.equal(getattr(a, name), getattr(b, name).cpu())
    with pytest.raises(ValueError, match="rows that are not"):
        ops.build_blocks(x.cuda() * float("nan"), DX)


def test_gradients_match_cpu() -> None:
    c = scene(torch.float64, 1)
    blocks = ops.build_blocks(c["position"], DX)
    grads = []
    for device in ("cpu", "cuda"):
        d, b = on(device, c), blocks_on(device, blocks)
        names = ("velocity", "affine", "mass", "stress", "volume")
        leaves = [d[k].detach().clone().requires_grad_() for k in names]
        grid, _ = ops.p2g(
            d["position"], *leaves[:3], dx=DX, blocks=b, dt=0.1, stress=leaves[3], volume=leaves[4]
        )
        v, _, _ = ops.grid_update(grid, dx=DX, dt=0.1, blocks=b)
        x, w, affine, _ = ops.g2p(v, d["position"], dx=DX, dt=0.1, blocks=b)
        (x.square().sum() + w.sin().sum() + affine.square().sum() * 1e-3).backward()
        grads.append([leaf.grad.cpu() for leaf in leaves if leaf.grad is not None])
    assert len(grads[0]) == len(grads[1]) == 5
    for a, b in zip(*grads, strict=True):
        assert (a - b).abs().max() <= 1e-10 * a.abs().max()


def test_garbage_in_block_tensors_never_leaves_the_arrays() -> None:
    c = on("cuda", scene(torch.float32, 1))
    good = ops.build_blocks(c["position"], DX)
    for name in ("table", "coords", "order", "start"):
        tensor = getattr(good, name)
        noise = torch.randint(-(2**31), 2**31 - 1, tensor.shape, device="cuda").to(torch.int32)
        out = step(c, good._replace(**{name: noise}), 1)
        torch.cuda.synchronize()
        assert out[0].isfinite().all()
