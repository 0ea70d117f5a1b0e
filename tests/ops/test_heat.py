"""Heat along a lattice of points: what is kept, what melts, where heat comes from."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.errors import InputError
from gsfluent.materials.heat import THERMAL, thermal

F64 = torch.float64
H = 0.01


def block(jitter: float = 0.2, seed: int = 1) -> Tensor:
    axis = (torch.arange(4, dtype=F64) + 0.3) * H
    points = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).reshape(-1, 3)
    generator = torch.Generator().manual_seed(seed)
    shift = torch.rand(points.shape, generator=generator, dtype=F64) - 0.5
    return points + 2.0 * jitter * H * shift


def rows(*names: str) -> Tensor:
    return torch.stack([thermal(name).row() for name in names])


def test_neighbours_share_faces_whatever_the_jitter() -> None:
    points = block()
    links, faces = ops.lattice_links(points, H)
    assert links.shape == (3 * 3 * 16, 2)
    assert int(faces.sum()) == 6 * 16
    shuffled = torch.randperm(64, generator=torch.Generator().manual_seed(2))
    again, other = ops.lattice_links(points[shuffled], H)
    pairs = {tuple(sorted(pair)) for pair in links.tolist()}
    assert {tuple(sorted(pair)) for pair in shuffled[again].tolist()} == pairs
    assert torch.equal(other, faces[shuffled])
    with pytest.raises(ValueError, match="two points lie in one cell"):
        ops.lattice_links(torch.cat([points, points[:1]]), H)


@pytest.mark.parametrize("name", THERMAL)
def test_temperature_and_enthalpy_are_inverse(name: str) -> None:
    row = rows(name)
    heat = torch.linspace(-2e5, 8e5, 401, dtype=F64)
    warm, share = ops.temperature(heat, rows=row)
    assert (warm.diff() >= -1e-9).all() and (share.diff() >= 0).all()
    assert float(share[0]) == 0.0 and float(share[-1]) == 1.0
    sharp = row[0, 5] == 0
    firm = ((share == 0) | (share == 1)) if sharp else torch.ones_like(share, dtype=torch.bool)
    back = ops.enthalpy(warm, rows=row)
    assert torch.allclose(back[firm], heat[firm], rtol=1e-9, atol=1e-6)
    if sharp:
        half = ops.enthalpy(row[:, 4], rows=row, share=0.5)
        assert float(half[0]) == 0.5 * float(row[0, 6])


def test_heat_is_kept_and_flows_from_warm_to_cold() -> None:
    """Ice beside wax beside chocolate, none of it open to anything."""
    points = block()
    links, _ = ops.lattice_links(points, H)
    material = torch.arange(64, dtype=torch.int32) % 3
    table = rows("ice", "wax", "chocolate")
    generator = torch.Generator().manual_seed(3)
    mass = 1e-3 * (1.0 + torch.rand(64, generator=generator, dtype=F64))
    start = ops.enthalpy(
        -20.0 + 90.0 * torch.rand(64, generator=generator, dtype=F64), rows=table, material=material
    )
    before = ops.temperature(start, rows=table, material=material)[0]
    after = ops.conduct(
        start, mass=mass, links=links, spacing=H, rows=table, material=material, dt=500.0
    )
    warm = ops.temperature(after, rows=table, material=material)[0]
    assert float((mass * after).sum()) == pytest.approx(float((mass * start).sum()), rel=1e-12)
    assert before.min() - 1e-9 <= warm.min() and warm.max() <= before.max() + 1e-9
    assert float(warm.std()) < 0.7 * float(before.std())


def test_a_closed_lump_takes_the_air_s_temperature_at_its_rate() -> None:
    """Biot number small: exp(-h A t / (m c))."""
    points = block(0.0)
    links, faces = ops.lattice_links(points, H)
    ice = rows("ice")
    ice[0, :2] = 50.0  # what conducts that well is one lump
    mass = torch.full((64,), 920.0 * H**3, dtype=F64)
    start = ops.enthalpy(torch.full((64,), -30.0, dtype=F64), rows=ice)
    rate = 25.0 * 96 * H**2 / (64 * 920.0 * H**3 * 2050.0)
    after = ops.conduct(
        start, mass=mass, links=links, spacing=H, rows=ice, dt=0.5 / rate, air=(faces, -10.0, 25.0)
    )
    warm = ops.temperature(after, rows=ice)[0]
    assert float(warm.mean()) == pytest.approx(-10.0 - 20.0 * math.exp(-0.5), abs=0.02)


def test_what_melts_stays_at_its_melting_point_and_freezes_again() -> None:
    points = block()
    links, _ = ops.lattice_links(points, H)
    ice = rows("ice")
    mass = torch.full((64,), 920.0 * H**3, dtype=F64)
    bottom = (points[:, 2] < H).nonzero()[:, 0]
    heat = ops.enthalpy(torch.full((64,), -5.0, dtype=F64), rows=ice)

    def on_plate(heat: Tensor, warm: float, seconds: float) -> Tensor:
        wall = bottom, torch.full((16,), warm, dtype=F64)
        return ops.conduct(heat, mass=mass, links=links, spacing=H, rows=ice, dt=seconds, wall=wall)

    warm, share = ops.temperature(on_plate(heat, 80.0, 700.0), rows=ice)
    melting = (share > 0) & (share < 1)
    assert bool(melting.any()) and bool((share == 1).any()) and bool((share == 0).any())
    assert warm[melting].abs().max() < 1e-9
    molten = on_plate(heat, 80.0, 20000.0)
    assert float(ops.temperature(molten, rows=ice)[1].min()) == 1.0
    frozen = ops.temperature(on_plate(molten, -40.0, 20000.0), rows=ice)
    assert float(frozen[1].max()) == 0.0 and float(frozen[0].max()) < 0.0


def test_the_gradient_is_that_of_differences() -> None:
    points = block()
    links, faces = ops.lattice_links(points, H)
    table = rows("wax").requires_grad_()
    mass = torch.full((64,), 900.0 * H**3, dtype=F64)
    generator = torch.Generator().manual_seed(4)
    warm = 20.0 + 80.0 * torch.rand(64, generator=generator, dtype=F64)
    heat = ops.enthalpy(warm, rows=table.detach()).requires_grad_()

    def f(heat: Tensor, scale: Tensor) -> Tensor:
        return ops.conduct(
            heat, mass=mass, links=links, spacing=H, rows=table * scale, dt=1.0,
            air=(faces, 10.0, 20.0),
        ) / 1e5  # fmt: skip

    scale = torch.ones(1, 7, dtype=F64, requires_grad=True)
    assert torch.autograd.gradcheck(f, (heat, scale), fast_mode=True)


def test_wrong_input_is_named() -> None:
    heat = torch.zeros(2, dtype=F64)
    bad = rows("ice")
    bad[0, 0] = 0.0
    with pytest.raises(ValueError, match="conductivity must be finite and positive"):
        ops.temperature(heat, rows=bad)
    with pytest.raises(ValueError, match="material must hold rows 0 to 0"):
        ops.temperature(heat, rows=rows("ice"), material=torch.ones(2, dtype=torch.int32))
    with pytest.raises(ValueError, match="spacing must be positive"):
        ops.lattice_links(block(), 0.0)
    with pytest.raises(InputError, match="unknown thermal material 'iec'") as caught:
        thermal("iec")
    assert "ice" in caught.value.hint


@pytest.mark.cuda
def test_a_gpu_gives_the_same_heat() -> None:
    points = block()
    links, _ = ops.lattice_links(points, H)
    mass = torch.full((64,), 920.0 * H**3, dtype=F64)
    heat = ops.enthalpy(torch.linspace(-20.0, 40.0, 64, dtype=F64), rows=rows("ice"))
    kw = {"spacing": H, "dt": 50.0}
    want = ops.conduct(heat, mass=mass, links=links, rows=rows("ice"), **kw)
    got = ops.conduct(
        heat.cuda(), mass=mass.cuda(), links=links.cuda(), rows=rows("ice").cuda(), **kw
    )
    assert torch.allclose(got.cpu(), want, rtol=1e-9)
