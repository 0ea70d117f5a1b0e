"""Colliders and blades on CUDA against the CPU kernels."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from gsfluent import ops

pytestmark = pytest.mark.cuda

DX = 0.1
TOLERANCE = {torch.float64: 1e-12, torch.float32: 2e-5}


def grid_of_a_ball() -> tuple[Tensor, Tensor]:
    axis = torch.arange(-10, 11, dtype=torch.float64) * 0.05
    sdf = torch.cartesian_prod(axis, axis, axis).norm(dim=1) - 0.3
    row = ops.collider_row("sdf", normal=[-0.5] * 3, radius=0.05, extent=[21] * 3, friction=0.2)
    return sdf.float(), row


def rows() -> tuple[Tensor, Tensor]:
    sdf, ball = grid_of_a_ball()
    turned: dict[str, Any] = {
        "orientation": (0.9, 0.2, -0.3, 0.25),
        "velocity": (0.5, -1.0, 0.3),
        "angular_velocity": (1.0, 2.0, -3.0),
    }
    free = {"mass": 2.0, "inertia": (0.1, 0.2, 0.3)}
    return sdf, torch.stack(
        [
            ops.collider_row("plane", normal=(0.1, 0, 1), point=(0, 0, -0.3), friction=0.4),
            ops.collider_row("plane", normal=(1, 0, 1), radius=0.2, mode="slip"),
            ops.collider_row(
                "sphere", point=(0.2, 0, 0), radius=0.25, sweep=True, **turned, **free
            ),
            ops.collider_row("box", extent=(0.1, 0.2, 0.1), restitution=0.5, **turned, **free),
            ops.collider_row("capsule", radius=0.1, extent=(0, 0, 0.2), mode="sticky", **turned),
            ops.collider_row("cylinder", radius=0.1, extent=(0, 0, 0.2), **turned),
            ops.collider_row("face", extent=(0.3, 0.3, 0.2), only_cut=1, **turned),
            ball,
        ]
    )


def close(a: Tensor, b: Tensor, tolerance: float) -> None:
    b = b.cpu()
    assert torch.equal(a.isfinite(), b.isfinite())
    scale = float(a[a.isfinite()].abs().max())
    assert float((a - b)[a.isfinite()].abs().max()) <= tolerance * max(scale, 1.0)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_distance_and_motion(dtype: torch.dtype) -> None:
    sdf, table = rows()
    x = 1.6 * (torch.rand(3000, 3, dtype=torch.float64) - 0.5)
    for row in table:
        here = ops.collider_distance(x.to(dtype), row[None].to(dtype), sdf)
        there = ops.collider_distance(
            x.to("cuda", dtype), row[None].to("cuda", dtype), sdf.to("cuda")
        )
        close(here[0], there[0], TOLERANCE[dtype])
        if dtype == torch.float64:
            close(here[1], there[1], 1e-9)
    impulse, torque = torch.randn(2, 8, 3, dtype=torch.float64)
    kw: dict[str, Any] = {"gravity": (0.0, 0.0, -9.81)}
    here_rows = ops.advance_colliders(table, 1e-2, impulse=impulse, torque=torque, **kw)
    there_rows = ops.advance_colliders(
        table.to("cuda"), 1e-2, impulse=impulse.to("cuda"), torque=torque.to("cuda"), **kw
    )
    close(here_rows, there_rows, 1e-12)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_grid_update(dtype: torch.dtype) -> None:
    sdf, table = rows()
    n = 900
    x = 1.6 * (torch.rand(n, 3, dtype=torch.float64) - 0.5)
    body = torch.randint(0, 3, (n,), dtype=torch.int32)
    blocks = ops.build_blocks(x, DX)
    grid, _ = ops.p2g(
        x, torch.randn_like(x), torch.zeros(n, 3, 3, dtype=torch.float64), torch.rand_like(x[:, 0]),
        dx=DX, blocks=blocks, body=body, fields=3,
    )  # fmt: skip
    cut = torch.tensor([0, 1, 2], dtype=torch.int32)
    merged = ops.merged_fields(torch.zeros(3, dtype=torch.int32), cut)

    def update(device: str) -> tuple[Tensor, ...]:
        parts = {k: getattr(blocks, k).to(device) for k in ("table", "coords", "order", "start")}
        return ops.grid_update(
            grid.to(device, dtype), dx=DX, dt=1e-2, blocks=blocks._replace(**parts),
            colliders=table.to(device, dtype), sdf=sdf.to(device), cut=cut.to(device),
            merged=merged.to(device), return_torque=True,
        )  # fmt: skip

    here, there = update("cpu"), update("cuda")
    again = update("cuda")
    assert all(torch.equal(a, b) for a, b in zip(there, again, strict=True))
    if dtype == torch.float64:
        for a, b in zip(here[:3], there[:3], strict=True):
            close(a, b, 1e-10)
        return
    # A node within rounding of a surface may fall on either side.
    wrong = ((here[0] - there[0].cpu()).abs() > 1e-3).double().mean()
    assert wrong < 2e-3


def test_blade_sides() -> None:
    blades = torch.cat(
        [
            ops.blade_rows([[0, 0, 0], [0.4, 0, 0], [0.4, 0.4, 0]], (0, 0, 1), 1.0),
            ops.blade_rows([[0, 0, 1], [0, 0, -1]], (0, 1, 0), 0.5, swept=(0.5, 1.2), number=3),
        ]
    )
    x = torch.rand(5000, 3, dtype=torch.float64) - 0.5
    cut = torch.zeros(5000, dtype=torch.int32)
    here = ops.blade_sides(x, blades, cut, 0.3)
    there = ops.blade_sides(x.to("cuda"), blades.to("cuda"), cut.to("cuda"), 0.3)
    assert torch.equal(here, there.cpu()) and int((here != 0).sum()) > 500
