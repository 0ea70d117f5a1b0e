"""adam_step on CUDA against the CPU kernel and torch."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from gsfluent import ops

pytestmark = pytest.mark.cuda

BAR = {torch.float32: 1e-6, torch.float64: 1e-14}
N = 5003
# rows longer than a CTA's share, rows of one value, rows that do not divide it
TAILS: tuple[tuple[int, ...], ...] = ((3,), (), (15, 3), (1, 3), (3001,), (2048,), (2047,))


def state(dtype: torch.dtype, rows: int) -> list[list[Tensor]]:
    shapes = [(rows, *tail) for tail in TAILS]
    make = [[torch.randn(s, dtype=dtype) for s in shapes] for _ in range(3)]
    return [*make, [torch.rand(s, dtype=dtype) for s in shapes]]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("mark", ["all", "bool", "radii"])
@pytest.mark.parametrize("rows", [N, 1])
def test_step_matches_cpu(dtype: torch.dtype, mark: str, rows: int) -> None:
    groups = state(dtype, rows)
    for gradient in groups[1]:
        flat = gradient.reshape(rows, -1)
        flat[torch.randperm(rows)[: rows // 10], -1] = float("nan")
        flat[torch.randperm(rows)[: rows // 10], 0] = float("-inf")
    visible = None
    if mark != "all":
        visible = torch.rand(rows) > 0.3
    if mark == "radii" and visible is not None:
        visible = torch.where(visible, 3, -1).int()
    there = [[t.cuda() for t in group] for group in groups]
    arguments: dict[str, Any] = {"lr": [0.1 * (i + 1) for i in range(len(TAILS))], "step": 5}
    ops.adam_step(*groups, visible=visible, **arguments)
    ops.adam_step(*there, visible=None if visible is None else visible.cuda(), **arguments)
    for k in (0, 2, 3):
        for a, b in zip(groups[k], there[k], strict=True):
            assert float((a - b.cpu()).abs().max()) < BAR[dtype] * max(1.0, float(a.abs().max()))


def test_equals_torch_over_many_steps() -> None:
    ours = [torch.randn(s, device="cuda") for s in ((N, 3), (N, 15, 3))]
    theirs = [p.clone().requires_grad_() for p in ours]
    optimizer = torch.optim.Adam(theirs, lr=1e-2, betas=(0.9, 0.99), eps=1e-15)
    first, second = ([torch.zeros_like(p) for p in ours] for _ in range(2))
    for step in range(1, 31):
        gradients = [torch.randn_like(p) for p in ours]
        for p, g in zip(theirs, gradients, strict=True):
            p.grad = g
        optimizer.step()
        ops.adam_step(
            ours, gradients, first, second, lr=1e-2, step=step, betas=(0.9, 0.99), eps=1e-15
        )
    for p, q in zip(ours, theirs, strict=True):
        assert float((p - q.detach()).abs().max()) < 1e-5


def test_nothing_waits_for_the_device() -> None:
    groups = [[t.cuda() for t in group] for group in state(torch.float32, 100)]
    visible = torch.ones(100, dtype=torch.int32, device="cuda")
    x = torch.rand(40, 40, 3, device="cuda", requires_grad=True)
    y = torch.rand(40, 40, 3, device="cuda")
    torch.cuda.synchronize()
    torch.cuda.set_sync_debug_mode("error")
    try:
        ops.adam_step(*groups, lr=0.1, step=1, visible=visible)
        ops.photometric_loss(x, y).loss.backward()
        ops.ssim(x, y, reduction="none")
    finally:
        torch.cuda.set_sync_debug_mode("default")


def test_no_rows() -> None:
    empty = [[torch.zeros(0, 3, device="cuda")] for _ in range(4)]
    ops.adam_step(*empty, lr=0.1, step=1)
    torch.cuda.synchronize()
