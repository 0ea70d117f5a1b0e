"""Normals of contact between fields: balls, edges of a footprint, early contact."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.ops.reference import mpm as reference
from gsfluent.ops.reference.contact import contact_normal


def lattice(lower: tuple[float, ...], upper: tuple[float, ...]) -> Tensor:
    """A box given in cells, eight points per cell."""
    axes = [
        (torch.arange(2 * round(b - a), dtype=torch.float64) + 0.5) / 2 + a
        for a, b in zip(lower, upper, strict=True)
    ]
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).reshape(-1, 3)


def ball(radius: float) -> Tensor:
    points = lattice((-radius,) * 3, (radius,) * 3)
    return points[points.norm(dim=1) <= radius]


def turned(seed: int) -> tuple[Tensor, Tensor]:
    """A random rotation and a shift inside the cell; seed 0 is along the grid."""
    generator = torch.Generator().manual_seed(seed)
    q, _ = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=generator))
    shift = torch.rand(3, dtype=torch.float64, generator=generator)
    return (torch.eye(3, dtype=torch.float64) if seed == 0 else q), shift


def meet(first: Tensor, second: Tensor, dtype: torch.dtype = torch.float64) -> dict[str, Any]:
    """Grid and moments of two bodies of density 1, cells of 1."""
    x = torch.cat([first, second]).to(dtype)
    body = (torch.arange(len(x)) >= len(first)).int()
    blocks = ops.build_blocks(x, 1.0)
    zero = torch.zeros(len(x), 3, dtype=dtype)
    grid, moments = ops.p2g(
        x, zero, torch.zeros(len(x), 3, 3, dtype=dtype), torch.full_like(x[:, 0], 0.125),
        dx=1.0, blocks=blocks, body=body, fields=2, contact=True,
    )  # fmt: skip
    return {"grid": grid, "moments": moments, "blocks": blocks}


def tilts(at: dict[str, Any], want: Tensor) -> dict[str, Tensor]:
    """Weighted sums of squared tilts against `want` where the bodies touch, by kind of normal."""
    near = reference.neighbours(torch.cat([at["grid"][..., 3:], at["moments"]], -1), at["blocks"])
    mass, moment = (near[0, ..., 0], near[1, ..., 0]), (near[0, ..., 1:], near[1, ..., 1:])
    shared = (mass[0][..., 13] > 0) & (mass[1][..., 13] > 0)
    mass, moment = tuple(m[shared] for m in mass), tuple(m[shared] for m in moment)
    normal, known = contact_normal(mass, moment)  # type: ignore[arg-type]
    assert bool(known.all())
    ma, mb = mass[0][:, 13], mass[1][:, 13]
    center = moment[1][:, 13] / mb[:, None] - moment[0][:, 13] / ma[:, None]
    touch = (center * normal).sum(1) <= 1.05
    unit = torch.nn.functional.normalize
    single = unit(unit(moment[1][:, 13], dim=1) - unit(moment[0][:, 13], dim=1), dim=1)
    weight = (ma * mb / (ma + mb))[touch]
    out = {"weight": weight.sum()}
    for name, n in (("contact", normal), ("single", single)):
        side = n - (n @ want)[:, None] * want
        out[name] = (weight * side[touch].square().sum(1)).sum()
    return out


def rms(found: list[dict[str, Tensor]], name: str) -> float:
    total = sum(float(f["weight"]) for f in found)
    return float((sum(float(f[name]) for f in found) / total) ** 0.5)


def test_normal_of_two_balls_is_their_line_of_centres() -> None:
    found = []
    for seed in range(8):
        q, shift = turned(seed)
        line = q[:, 0]
        found.append(tilts(meet(ball(6.0) + shift, ball(6.0) + shift + 11.8 * line), line))
    assert rms(found, "contact") < 0.02  # 0.016 here
    assert rms(found, "single") > 0.045  # unit gradients of one node alone


def test_normal_stays_upright_at_the_edge_of_a_footprint() -> None:
    found = []
    for seed in range(8):
        q, shift = turned(seed)
        block, plate = lattice((-3, -3, 0), (3, 3, 4)), lattice((-7, -7, -3), (7, 7, 0))
        found.append(tilts(meet(block @ q.mT + shift, plate @ q.mT + shift), -q[:, 2]))
    assert rms(found, "contact") < 0.06  # 0.04 here
    assert rms(found, "single") > 0.2


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_edges_and_corners_match_the_reference(seed: int, dtype: torch.dtype) -> None:
    q, shift = turned(seed)
    block, plate = lattice((-2, -2, 0), (2, 2, 3)), lattice((-4, -4, -2), (4, 4, 0))
    at = meet(block @ q.mT + shift, plate @ q.mT + shift, dtype)
    push = torch.tensor([0.4, -0.3, -1.0], dtype=dtype) @ q.mT.to(dtype)
    at["grid"][0, ..., :3] = at["grid"][0, ..., 3:] * push
    kw: dict[str, Any] = {"dx": 1.0, "dt": 0.1, "blocks": at["blocks"], "gravity": (0, 0, 0)}
    v, _, touched = ops.grid_update(at["grid"], moments=at["moments"], **kw)
    want, _, _, count = reference.grid_update(
        at["grid"].double(), moments=at["moments"].double(), **kw
    )
    assert touched > 20
    off = (v.double() - want).abs().amax(-1) > (1e-12 if dtype == torch.float64 else 1e-4)
    assert int(off.sum()) <= (0 if dtype == torch.float64 else 2)  # a gate within rounding
    assert abs(int(touched) - int(count)) <= (0 if dtype == torch.float64 else 1)


@pytest.mark.parametrize("seed", range(4))
def test_no_contact_across_half_a_cell(seed: int) -> None:
    q, shift = turned(seed)
    for gap, touches in ((0.0, True), (0.5, False)):
        block, plate = lattice((-2, -2, 0), (2, 2, 3)), lattice((-4, -4, -2), (4, 4, 0))
        lifted = block + torch.tensor([0.0, 0.0, gap], dtype=torch.float64)
        at = meet(lifted @ q.mT + shift, plate @ q.mT + shift)
        at["grid"][0, ..., :3] = -at["grid"][0, ..., 3:] * q[:, 2]
        _, _, touched = ops.grid_update(
            at["grid"], moments=at["moments"], blocks=at["blocks"], dx=1.0, dt=0.1,
            gravity=(0, 0, 0),
        )  # fmt: skip
        assert (int(touched) > 0) == touches


def test_missing_neighbours_and_garbage_are_harmless() -> None:
    at = meet(lattice((0, 0, 0), (2, 2, 2)), lattice((0, 0, -2), (2, 2, 0)))
    blocks = at["blocks"]
    alone = blocks._replace(table=torch.full_like(blocks.table, -1))  # no neighbour is found
    at["grid"][0, ..., 2] = -at["grid"][0, ..., 3]
    kw: dict[str, Any] = {"dx": 1.0, "dt": 0.1, "gravity": (0, 0, 0)}
    total = at["grid"][..., :3].sum((0, 1, 2))
    nine, nan = (torch.full_like(at["moments"], value) for value in (9.0, float("nan")))
    for table, moments in (
        (blocks, at["moments"]),
        (alone, at["moments"]),
        (blocks, nine),
        (blocks, nan),
    ):
        v, _, _ = ops.grid_update(at["grid"], moments=moments, blocks=table, **kw)
        assert torch.isfinite(v).all()
        assert torch.allclose((at["grid"][..., 3:] * v).sum((0, 1, 2)), total, atol=1e-12)
