"""Fields that are parts of one body: one velocity at shared nodes, no contact between them."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.ops.reference import mpm as reference

DX = 0.1
DT = 1e-2


def parts(count: int = 700, fields: int = 4) -> tuple[dict[str, Any], Tensor]:
    """A cloud cut at random into fields, in random motion."""
    x = torch.rand(count, 3, dtype=torch.float64) * 0.5
    body = torch.randint(0, fields, (count,), dtype=torch.int32)
    particles = {
        "position": x,
        "velocity": torch.randn(count, 3, dtype=torch.float64),
        "affine": torch.randn(count, 3, 3, dtype=torch.float64),
        "mass": torch.rand(count, dtype=torch.float64) + 0.1,
        "dx": DX,
        "blocks": ops.build_blocks(x, DX),
    }
    return particles, body


def step(
    particles: dict[str, Any], body: Tensor | None, fields: int, **kw: Any
) -> tuple[Tensor, Tensor, int]:
    """Grid, velocity after the update and how many nodes touched."""
    grid, moments = ops.p2g(**particles, body=body, fields=fields, contact=fields > 1)
    v, _, touched = ops.grid_update(
        grid, dx=DX, dt=DT, blocks=particles["blocks"], moments=moments, **kw
    )
    return grid, v, int(touched)


def test_merged_fields_move_as_one_field() -> None:
    particles, body = parts()
    grid, v, touched = step(particles, body, 4, merged=torch.ones(4, 4, dtype=torch.bool))
    _, one, _ = step(particles, None, 1)
    heavy = grid[..., 3] > 0
    assert touched == 0 and int((heavy.sum(0) > 1).sum()) > 50
    assert (v - one.expand_as(v))[heavy].abs().max() < 1e-12
    _, apart, touched = step(particles, body, 4)  # without the flag the same fields collide
    assert touched > 50 and (apart - one.expand_as(v))[heavy].abs().max() > 0.1


def test_merging_is_symmetric_transitive_and_keeps_momentum() -> None:
    particles, body = parts()
    link = torch.zeros(4, 4, dtype=torch.bool)
    link[0, 1] = link[2, 1] = True  # 0 and 2 move as one through 1 where all three meet
    grid, v, touched = step(particles, body, 4, merged=link, gravity=(0.0, 0.0, 0.0))
    mass = grid[..., 3:]
    old = grid[..., :3].sum((0, 1, 2))
    assert touched > 0  # field 3 still collides with the others
    assert ((mass * v).sum((0, 1, 2)) - old).abs().max() <= 1e-12 * grid[..., :3].abs().sum()
    three = (grid[:3, ..., 3] > 0).all(0)
    assert int(three.sum()) > 20
    assert (v[0] - v[2])[three].abs().max() < 1e-13 and (v[0] - v[3])[three].abs().max() > 0.1
    without_1 = (grid[0, ..., 3] > 0) & (grid[1, ..., 3] == 0) & (grid[2, ..., 3] > 0)
    assert int(without_1.sum()) > 0  # nothing links 0 and 2 there: they are two bodies
    assert (v[0] - v[2])[without_1].abs().max() > 1e-6


def test_merged_fields_match_the_reference() -> None:
    particles, body = parts()
    link = torch.zeros(4, 4, dtype=torch.bool)
    link[0, 3] = True
    grid, moments = ops.p2g(**particles, body=body, fields=4, contact=True)
    kw: dict[str, Any] = {
        "dx": DX, "dt": DT, "blocks": particles["blocks"], "moments": moments, "merged": link
    }  # fmt: skip
    v, _, touched = ops.grid_update(grid, **kw)
    want, _, _, count = reference.grid_update(grid, **kw)
    assert touched == count > 0
    assert (v - want).abs().max() <= 1e-12 * want.abs().max()


def test_merged_pieces_fly_as_the_whole() -> None:
    # A block cut in two by fields spins freely: the cut must not show, step after step.
    axis = (torch.arange(8, dtype=torch.float64) + 0.5) * DX / 2
    x = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).reshape(-1, 3)
    body = (x[:, 0] > 0.2).int()
    v = torch.linalg.cross(torch.tensor([0.3, -0.2, 1.0]).double().expand_as(x), x - 0.2)
    mass = torch.full((len(x),), 1e-3, dtype=torch.float64)
    ends = []
    for fields in (1, 2):
        y, u, c = x, v, torch.zeros(len(x), 3, 3, dtype=torch.float64)
        split = body if fields == 2 else None
        merged = torch.ones(2, 2, dtype=torch.bool) if fields == 2 else None
        for _ in range(20):
            blocks = ops.build_blocks(y, DX)
            grid, moments = ops.p2g(
                y, u, c, mass, dx=DX, blocks=blocks, body=split, fields=fields, contact=fields > 1
            )
            field, _, _ = ops.grid_update(
                grid, dx=DX, dt=DT, blocks=blocks, moments=moments, merged=merged
            )
            y, u, c, _ = ops.g2p(field, y, dx=DX, dt=DT, blocks=blocks, body=split)
        ends.append((y, u))
    assert (ends[0][0] - ends[1][0]).abs().max() < 1e-12
    assert (ends[0][1] - ends[1][1]).abs().max() < 1e-11
