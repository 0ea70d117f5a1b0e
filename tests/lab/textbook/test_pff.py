"""PFF-MPM's field: closed forms, its own matrix, and a world that cracks by it."""

from __future__ import annotations

import pytest
import torch

from gsfluent.lab.textbook.pff import PffField, pff_solve
from gsfluent.lab.world.driver import World
from gsfluent.lab.world.shapes import ball
from gsfluent.ops.reference.mpm import stencil

DX, DT, M = 0.1, 1e-3, 15.0


def cloud(count: int = 300) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    x = torch.rand(count, 3, generator=generator, dtype=torch.float64) * 5 * DX
    return x, torch.full((count,), DX**3 / 8.0, dtype=torch.float64)


def test_an_even_field_relaxes_in_closed_form() -> None:
    x, volume = cloud()
    whole, factor = torch.full_like(volume, 0.8), torch.full_like(volume, 3.0)
    c, _ = pff_solve(
        whole, factor, volume, x, dx=DX, dt=DT, mobility=M, length=0.5 * DX, tolerance=1e-14
    )
    want = (M + 0.8 / DT) / (1.0 / DT + M * 3.0)
    assert (c - want).abs().max() < 1e-12


def test_the_field_is_that_of_its_matrix() -> None:
    x, volume = cloud(120)
    generator = torch.Generator().manual_seed(1)
    whole = 0.5 + 0.5 * torch.rand(120, generator=generator, dtype=torch.float64)
    factor = 1.0 + 5.0 * torch.rand(120, generator=generator, dtype=torch.float64)
    node, weight, gradient = stencil(x, DX)
    used, at = torch.unique(node.view(-1, 3), dim=0, return_inverse=True)
    at, n = at.view(120, 27), len(used)
    w = torch.zeros(120, n, dtype=torch.float64).scatter(1, at, weight)
    g = torch.zeros(120, n, 3, dtype=torch.float64)
    g = g.scatter(1, at[..., None].expand(-1, -1, 3), gradient)
    lumped = (volume * (1.0 / DT + M * factor)) @ w
    matrix = lumped.diag() + 4.0 * M * (0.5 * DX) ** 2 * torch.einsum("p,pid,pjd->ij", volume, g, g)
    before = ((volume * whole) @ w) / (volume @ w)
    solved = torch.linalg.solve(matrix, M * (volume @ w) + (volume * whole) @ w / DT)
    want = torch.minimum(whole, (whole + w @ (solved - before)).clamp(0.0, 1.0))
    c, turns = pff_solve(
        whole, factor, volume, x, dx=DX, dt=DT, mobility=M, length=0.5 * DX, tolerance=1e-13
    )
    assert (c - want).abs().max() < 1e-9 and turns > 1
    assert bool((c <= whole).all()) and bool((c < whole).any())


def flown(scale: float, seconds: float = 0.5) -> World:
    """A ball whose halves are pulled apart, with that field."""
    place = ball((0.0, 0.0, 0.0), 0.3, 0.0625)
    volume = torch.full((len(place),), 0.0625**3, dtype=torch.float64)
    v = torch.zeros_like(place)
    v[:, 0] = 0.3 * place[:, 0].sign()
    world = World(
        place, v, volume=volume, dx=0.125, law=torch.tensor([9], dtype=torch.int32),
        params=torch.tensor([[0.4, 0.6, 0.002, 0.0, 0.25, 0.0, 1.0, 0.0]], dtype=torch.float64),
        alpha=torch.full((len(place),), -1.0, dtype=torch.float64), dt=0.02, engine="ops",
        gravity=(0.0, 0.0, 0.0), dtype=torch.float64,
    )  # fmt: skip
    world.stepper.cracks = PffField(world.stepper.scene, mobility=M, scale=scale)
    if seconds:
        world.run(seconds=seconds)
    return world


def test_a_world_cracks_by_it_and_one_that_is_stronger_less() -> None:
    weak, strong = flown(1e-4), flown(1e-1)
    assert float(weak.peak.max()) > 0.0 > float(strong.peak.max())
    assert weak.stepper.cracks.turns > 0


def test_what_cannot_be_is_refused() -> None:
    world = flown(1e-2, 0.0)
    with pytest.raises(ValueError, match="must be positive"):
        PffField(world.stepper.scene, mobility=0.0, scale=1.0)
