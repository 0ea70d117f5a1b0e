"""Scenes of phase-field matter for the tests of its solver, and the same by composed operators."""

from __future__ import annotations

import itertools
from typing import Any

import torch
from law_states import KAPPA, MU
from torch import Tensor

from gsfluent import ops
from gsfluent.materials.phase_field import MODELS, SPLITS
from gsfluent.ops.damage import DamageField
from gsfluent.ops.plasticity import weakened

DX = 0.01


def row(
    damage: float = 0.0, split: str = "volumetric", model: str = "at1", threshold: float = 500.0
) -> Tensor:
    code = float(SPLITS[split] + MODELS[model])
    line = [MU, KAPPA, threshold, damage, 0.04, code, 1000.0, 0.1]
    return torch.tensor([line], dtype=torch.float64)


def plates(dtype: torch.dtype, model: str = "at1", split: str = "none", more: bool = False) -> Any:
    """Arguments of Solver: a block pulled apart fast enough to crack, in float64 positions."""
    generator = torch.Generator().manual_seed(4)
    x, y, z = (torch.arange(2 * n, dtype=torch.float64) + 0.5 for n in (14, 5, 5))
    position = torch.stack(torch.meshgrid(x, y, z, indexing="ij"), dim=-1).reshape(-1, 3)
    noise = torch.rand(position.shape, generator=generator, dtype=torch.float64) - 0.5
    position = 0.5 * DX * (position + 0.5 * noise)
    count = position.shape[0]
    volume = torch.full((count,), DX**3 / 8.0, dtype=dtype)
    velocity = torch.zeros(count, 3, dtype=dtype)
    velocity[:, 0] = (8.0 * (position[:, 0] / DX - 7.0)).sign() * 1.5
    rows = row(0.0, split, model, 30.0)
    rows[0, 4], rows[0, 7] = 2.0 * DX, 0.0
    law, material = [9], torch.zeros(count, dtype=torch.int32)
    if more:
        rows = torch.cat([rows, rows.clone()])
        rows[1, 2:6], law = 0.0, [9, 0]
        material = (position[:, 1] > 3.0 * DX).int()
    return {
        "position": position, "velocity": velocity, "mass": 1000.0 * volume, "volume": volume,
        "dx": DX, "law": torch.tensor(law, dtype=torch.int32), "params": rows.to(dtype),
        "material": material, "alpha": torch.full((count,), -1.0, dtype=dtype),
        "gravity": (0.0, 0.0, 0.0),
    }  # fmt: skip


def meeting(dtype: torch.dtype) -> dict[str, Any]:
    """Two plates that crack, one above the other, each a field of its own, falling on a floor."""
    one = plates(dtype, split="volumetric")
    gap = torch.tensor([0.3 * DX, 0.0, 5.2 * DX], dtype=torch.float64)
    place = one["position"] + torch.tensor([0.0, 0.0, 0.3 * DX], dtype=torch.float64)
    upper = one["velocity"].clone()
    upper[:, 2] -= 3.0
    count = len(place)
    twice = {name: torch.cat([one[name]] * 2) for name in ("mass", "volume", "material", "alpha")}
    body = torch.arange(2, dtype=torch.int32).repeat_interleave(count)
    floor = torch.zeros(1, 16, dtype=dtype)
    floor[0, :3] = torch.tensor([0.0, 2.0, 0.3])
    floor[0, 8] = 1.0
    return one | twice | {
        "position": torch.cat([place, place + gap]),
        "velocity": torch.cat([one["velocity"], upper]),
        "body": body, "colliders": floor, "gravity": (0.0, 0.0, -9.81),
    }  # fmt: skip


def on(device: str, given: dict[str, Any]) -> dict[str, Any]:
    """The same arguments on a device."""
    return {k: v.to(device) if isinstance(v, Tensor) else v for k, v in given.items()}


def shuffled(given: dict[str, Any], order: Tensor) -> dict[str, Any]:
    """The same points in another order."""
    count = len(order)
    return {
        name: value[order.to(value.device)].contiguous()
        if isinstance(value, Tensor) and value.shape[:1] == (count,)
        else value
        for name, value in given.items()
    }


def energy_and_momentum(solver: ops.Solver, given: dict[str, Any]) -> tuple[float, float]:
    """Kinetic and elastic energy [J]; momentum over what it would be if all flew one way."""
    v, c, mass = solver.velocity.double(), solver.affine.double(), given["mass"].double()
    kinetic = 0.5 * (mass * ((v**2).sum(1) + 0.25 * DX**2 * (c**2).sum((1, 2)))).sum()
    law, rows = weakened(given["law"], given["params"], given["material"], solver.peak)
    stored = ops.elastic_energy(solver.strain, law=law, params=rows).double()
    momentum = (mass[:, None] * v).sum(0).abs().max() / (mass[:, None] * v.abs()).sum()
    return float(kinetic + (stored * given["volume"].double()).sum()), float(momentum)


def stepped(given: dict[str, Any], dt: float, steps: int) -> dict[str, Tensor]:
    """The same by the composed operators."""
    cracks = DamageField(given["law"], given["params"], given["material"])
    x, v, dx, volume = given["position"], given["velocity"], given["dx"], given["volume"]
    n = x.shape[0]
    c, e, alpha = v.new_zeros(n, 3, 3), v.new_zeros(n, 6), given["alpha"]
    peak, stress = torch.full_like(alpha, -1.0), v.new_zeros(n, 6)
    for _ in range(steps):
        blocks = ops.build_blocks(x, dx)
        grid, _ = ops.p2g(
            x, v, c, given["mass"], dx=dx, blocks=blocks, dt=dt, stress=stress, volume=volume
        )
        nodes, _, _ = ops.grid_update(grid, dx=dx, dt=dt, blocks=blocks, gravity=(0.0, 0.0, 0.0))
        peak = cracks.step(alpha, peak, x, volume, dx=dx, blocks=blocks)
        x, v, c, _ = ops.g2p(nodes, x, dx=dx, dt=dt, blocks=blocks)
        law, params = weakened(given["law"], given["params"], given["material"], peak)
        e, alpha, stress, _ = ops.return_mapping(e, alpha, dt * c, law=law, params=params)
        peak = cracks.grown(peak, alpha) if cracks.points is None else peak
    return {"position": x, "velocity": v, "strain": e, "alpha": alpha, "peak": peak}


def assert_kept(given: Any) -> None:
    """A break of 150 steps keeps momentum and makes no energy; looked at every 25."""
    solver = ops.Solver(**given)
    energies = []
    for _ in range(6):
        energy, momentum = energy_and_momentum(solver, given)
        energies.append(energy)
        assert momentum < 1e-6
        solver.advance(steps=25)
    assert float(solver.peak.max()) > 0.0
    assert all(b <= a * (1.0 + 1e-6) for a, b in itertools.pairwise(energies))
