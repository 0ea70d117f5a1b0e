"""Averages over a grid: what they keep, what they smooth, what they refuse."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.lab.problems.flow import liquid
from gsfluent.lab.world.shapes import box

F64 = torch.float64
LENGTH = 0.1


def cloud(count: int = 600, seed: int = 0) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    position = torch.rand(count, 3, generator=generator, dtype=F64)
    return position, 0.5 + torch.rand(count, generator=generator, dtype=F64)


def averaged(values: Tensor, position: Tensor, mass: Tensor) -> Tensor:
    return ops.kernel_average(values, position=position, mass=mass, length=LENGTH)


def test_constants_pass_and_the_mean_by_mass_stays() -> None:
    position, mass = cloud()
    level = averaged(torch.full_like(mass, 3.25), position, mass)
    assert torch.allclose(level, torch.full_like(mass, 3.25), rtol=1e-13)
    rough = torch.randn(len(mass), generator=torch.Generator().manual_seed(1), dtype=F64)
    smooth = averaged(rough, position, mass)
    assert float((mass * smooth).sum()) == pytest.approx(float((mass * rough).sum()), abs=1e-10)
    assert float(smooth.std()) < 0.8 * float(rough.std())


def test_a_linear_field_is_kept_inside_and_noise_is_not() -> None:
    step = 0.5 * LENGTH
    position = box([0.0, 0.0, 0.0], [60 * step, 4 * step, 4 * step], step)
    mass = torch.ones(len(position), dtype=F64)
    ramp = 3.0 * position[:, 0] - 1.0
    inside = (position[:, 0] > 20 * step) & (position[:, 0] < 40 * step)
    kept = averaged(ramp, position, mass)
    assert torch.allclose(kept[inside], ramp[inside], atol=1e-12)
    assert float((kept - ramp).abs().max()) < 0.3 * 3.0 * LENGTH  # at its ends
    checker = 1.0 - 2.0 * (((position / step).long().sum(dim=1)) % 2).to(F64)
    both = averaged(torch.stack([ramp, checker], dim=1), position, mass)
    assert torch.equal(both[:, 0], kept)
    assert float(both[inside, 1].abs().max()) < 1e-12


def test_gradients_are_those_of_the_average() -> None:
    position, mass = cloud(12)
    values = torch.randn(12, generator=torch.Generator().manual_seed(2), dtype=F64)
    inputs = tuple(x.requires_grad_() for x in (values, position, mass))
    assert torch.autograd.gradcheck(averaged, inputs, atol=1e-6)


def test_nothing_in_nothing_out_and_what_is_refused() -> None:
    position, mass = cloud(5)
    assert averaged(mass[:0], position[:0], mass[:0]).shape == (0,)
    with pytest.raises(ValueError, match="values must be"):
        averaged(torch.zeros(5, 4, dtype=F64), position, mass)
    with pytest.raises(ValueError, match="length must be positive"):
        ops.kernel_average(mass, position=position, mass=mass, length=0.0)
    with pytest.raises(ValueError, match="must be finite"):
        averaged(mass, position.where(position < 2.0, 0.0).index_fill(0, torch.tensor([1]),
                 float("nan")), mass)  # fmt: skip


def test_water_at_rest_has_a_pressure_without_point_noise() -> None:
    column = liquid.water_column(8)
    assert column.noise < 0.02 < column.own
    assert abs(column.slope) < 0.05
    assert 0.0 < column.off < 0.05


@pytest.mark.cuda
def test_the_gpu_averages_as_the_cpu_does() -> None:
    position, mass = cloud(5000)
    there = averaged(position.cuda(), position.cuda(), mass.cuda())
    assert torch.allclose(there.cpu(), averaged(position, position, mass), atol=1e-12)
