"""Scenes for the tests of the resident solver, and the same steps by the composed operators."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from gsfluent import ops

DX = 0.02
MASS, SPEED = 14, slice(10, 13)
"""Columns of a collider's row."""
FLOOR = [[0.0, 2.0, 0.3, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0] + [0.0] * 7]


def cube(cells: int, corner: tuple[float, float, float], seed: int = 0, dx: float = DX) -> Tensor:
    """Jittered points, eight per cell, float64 [8 cells^3, 3]."""
    axis = (torch.arange(2 * cells, dtype=torch.float64) + 0.5) * (0.5 * dx)
    points = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).reshape(-1, 3)
    noise = torch.rand(points.shape, generator=torch.Generator().manual_seed(seed)) - 0.5
    return points + torch.tensor(corner, dtype=torch.float64) + 0.3 * dx * noise.double()


def elastic_row(young: float = 1e5, nu: float = 0.3, density: float = 1000.0) -> list[float]:
    return [young / (2 * (1 + nu)), young / (3 * (1 - 2 * nu)), 0, 0, 0, 0, density, 0]


def nacc_row(young: float = 2e4, nu: float = 0.3, density: float = 1000.0) -> list[float]:
    mu, kappa = elastic_row(young, nu)[:2]
    return [mu, kappa, 1.85, 0.5, 3.0, 0.1, density, 0]


def scene(
    *,
    cells: int = 6,
    bodies: int = 1,
    laws: tuple[int, ...] = (0,),
    dtype: torch.dtype = torch.float64,
    device: str = "cpu",
    shift: float = 0.0,
    track: bool = False,
    speed: float = -3.0,
) -> dict[str, Any]:
    """Arguments of Solver: cubes above a floor, the second one just above the first."""
    parts, fields, rows = [], [], []
    for number in range(bodies):
        low = (shift + 0.1, 0.1, 0.005 + number * (cells * DX + 0.002))
        parts.append(cube(cells, low, seed=number))
        fields.append(torch.full((parts[-1].shape[0],), number, dtype=torch.int32))
        rows.append(torch.full((parts[-1].shape[0],), number % len(laws), dtype=torch.int32))
    position = torch.cat(parts)
    n = position.shape[0]
    generator = torch.Generator().manual_seed(7)
    velocity = 0.2 * (torch.rand(n, 3, generator=generator, dtype=torch.float64) - 0.5)
    velocity[:, 2] += speed
    table = [elastic_row() if law == 0 else nacc_row() for law in laws]
    volume = torch.full((n,), DX**3 / 8, dtype=torch.float64)
    floor = torch.tensor(FLOOR, dtype=dtype, device=device)
    eye = torch.eye(3, dtype=dtype, device=device).expand(n, 3, 3).contiguous()
    return {
        "position": position.to(device),
        "velocity": velocity.to(device, dtype),
        "mass": (1000.0 * volume).to(device, dtype),
        "volume": volume.to(device, dtype),
        "dx": DX,
        "law": torch.tensor(laws, dtype=torch.int32, device=device),
        "params": torch.tensor(table, dtype=dtype, device=device),
        "material": torch.cat(rows).to(device),
        "alpha": torch.full((n,), -0.02, dtype=dtype, device=device),
        "deformation": eye if track else None,
        "body": torch.cat(fields).to(device),
        "colliders": floor,
    }


def bullet(position: Tensor, dtype: torch.dtype) -> Tensor:
    """A free ball that flies into the points from the left at 60 m/s."""
    row = torch.zeros(1, 32, dtype=torch.float64)
    low, high = position.cpu().amin(dim=0), position.cpu().amax(dim=0)
    radius = 0.03
    row[0, 0], row[0, 1], row[0, 9] = 1.0, 2.0, radius
    row[0, 3:6] = 0.5 * (low + high)
    row[0, 3] = low[0] - radius + 0.002
    row[0, SPEED] = torch.tensor([60.0, 0.0, 0.0], dtype=torch.float64)
    row[0, MASS] = 0.2
    return row.to(position.device, dtype)


def composed(arguments: dict[str, Any], dt: float, steps: int) -> dict[str, Tensor]:
    """The same steps by the composed operators, in the dtype of the velocities."""
    a = arguments
    dx, body, law, params = a["dx"], a["body"], a["law"], a["params"]
    x, v = a["position"].to(a["velocity"]), a["velocity"]
    n, fields = x.shape[0], int(body.max()) + 1
    c, e, alpha = v.new_zeros(n, 3, 3), a.get("strain", v.new_zeros(n, 6)), a["alpha"]
    f, kind = a["deformation"], law[a["material"].long()]
    never = torch.full_like(alpha, -1.0)  # only NACC points break
    peak = torch.where(kind == 1, alpha, never)

    def rows() -> Tensor:
        table = params[a["material"].long()].clone()
        table[:, 3] *= 1.0 - (peak / 0.02).clamp(0.0, 1.0)
        return table

    _, _, stress, _ = ops.return_mapping(e, alpha, 0.0 * c, law=kind, params=rows())
    total = torch.zeros(3, dtype=torch.float64, device=v.device)
    for _ in range(steps):
        blocks = ops.build_blocks(x, dx)
        grid, moments = ops.p2g(
            x, v, c, a["mass"], dx=dx, blocks=blocks, dt=dt, stress=stress, volume=a["volume"],
            body=body if fields > 1 else None, fields=fields, contact=fields > 1,
        )  # fmt: skip
        nodes, impulse, _ = ops.grid_update(
            grid, dx=dx, dt=dt, blocks=blocks, colliders=a["colliders"], moments=moments
        )
        x, v, c, f = ops.g2p(
            nodes, x, dx=dx, dt=dt, blocks=blocks, body=body if fields > 1 else None, deformation=f
        )
        e, alpha, stress, _ = ops.return_mapping(e, alpha, dt * c, law=kind, params=rows())
        peak = torch.maximum(peak, torch.where(kind == 1, alpha, never))
        total += impulse.sum(dim=0)
    return {
        "position": x, "velocity": v, "affine": c, "strain": e, "alpha": alpha, "peak": peak,
        "deformation": f, "impulse": total,
    }  # fmt: skip


def resident(arguments: dict[str, Any], dt: float | None, steps: int) -> ops.Solver:
    """The solver after these steps."""
    solver = ops.Solver(**arguments, dt=dt)
    solver.advance(steps=steps)
    return solver
