"""Metal that hardens by a power and by its rate, and softens by its own heat, by closed forms."""

from __future__ import annotations

import math

import pytest
import torch
from law_states import DT, KAPPA, assert_cuda_matches_cpu, cast, states, table
from torch import Tensor

from gsfluent import materials, ops
from gsfluent.errors import InputError
from gsfluent.lab.problems.flow import metal
from gsfluent.ops import return_mapping
from gsfluent.ops.reference import plasticity as reference

F64 = torch.float64
A, B, POWER, RATE, HEAT = 2000.0, 6e3, 0.4, 0.03, 3e3
ROWS = {
    "power": table("von_mises", c2=A, c4=B, c7=POWER),
    "rate": table("von_mises", c2=A, c4=B, c7=1.0, c3=RATE),
    "heat": table("von_mises", c2=A, c4=B, c7=POWER, c5=HEAT),
    "all": table("von_mises", c2=A, c4=B, c7=POWER, c3=RATE, c5=HEAT),
}


@pytest.mark.parametrize("name", ROWS)
@pytest.mark.parametrize("scale", [0.01, 0.05, 0.3])
def test_the_kernel_is_its_definition(name: str, scale: float) -> None:
    s, t = states("von_mises", 2000, scale), ROWS[name]
    got = return_mapping(*s, **t, dt=DT)
    want = reference.return_mapping(*s, **t, dt=DT)
    assert torch.equal(got[3], want[3])
    assert scale < 0.05 or int(got[3][0]) > 100
    for g, w in zip(got[:3], want[:3], strict=True):
        assert (g - w).abs().max() <= 1e-11 * max(float(w.abs().max()), 1e-30)
    narrow = return_mapping(*cast(torch.float32, *s), law=t["law"], params=t["params"].float(),
                            dt=DT)  # fmt: skip
    assert (narrow[2].double() - got[2]).abs().max() <= 3e-5 * got[2].abs().max()


@pytest.mark.parametrize("name", ROWS)
def test_it_has_a_gradient(name: str) -> None:
    strain, alpha, increment = states("von_mises", 6)
    t = ROWS[name]
    inputs = [a.clone().requires_grad_(True) for a in (strain, alpha + 0.01, increment)]
    scale = torch.ones(1, 8, dtype=F64, requires_grad=True)

    def f(strain: Tensor, alpha: Tensor, increment: Tensor, scale: Tensor) -> tuple[Tensor, ...]:
        rows = t["params"] * scale
        out = return_mapping(strain, alpha, increment, law=t["law"], params=rows, dt=DT)
        return out[0], out[1], out[2] / 1e4

    assert torch.autograd.gradcheck(f, (*inputs, scale), fast_mode=True, atol=1e-5)


def sheared(row: dict[str, Tensor], rate: float, most: float) -> list[tuple[float, float]]:
    """Plastic strain and equivalent stress [Pa] of a point that is sheared at a rate [1/s]."""
    step = 2e-4
    strain, alpha = torch.zeros(1, 6, dtype=F64), torch.zeros(1, dtype=F64)
    grow = torch.zeros(1, 3, 3, dtype=F64)
    grow[0, 0, 1] = grow[0, 1, 0] = 0.5 * step * math.sqrt(3.0)  # equivalent strain of a step
    held = []
    while float(alpha) < most:
        strain, alpha, tau, _ = return_mapping(strain, alpha, grow, **row, dt=step / rate)
        held.append((float(alpha), math.sqrt(3.0) * abs(float(tau[0, 3]))))
    return held


@pytest.mark.parametrize("rate", [0.1, 30.0, 1e4])
def test_a_point_that_is_sheared_at_a_rate_follows_johnson_and_cook(rate: float) -> None:
    """(A + B a^n) (1 + C ln rate), and with heat the solution of dT/da = sigma / Q."""
    faster = 1.0 + RATE * math.log(max(rate, 1.0))
    for name in ("rate", "all"):
        power = 1.0 if name == "rate" else POWER
        strain, stress = sheared(ROWS[name], rate, 0.3)[-1]
        cool, at, steps = 1.0, 0.0, 3000  # 1 - T*, by Heun's rule
        for _ in range(steps if name == "all" else 0):
            da = strain / steps
            slope = [-faster * (A + B * a**power) / HEAT for a in (at, at + da)]
            trial = cool * (1.0 + da * slope[0])
            cool += 0.5 * da * (slope[0] * cool + slope[1] * trial)
            at += da
        wanted = faster * (A + B * strain**power) * cool
        assert stress == pytest.approx(wanted, rel=2e-3)
        assert name == "rate" or cool < 0.8


def test_a_power_of_one_without_rate_and_heat_is_linear_hardening() -> None:
    s = states("von_mises", 500)
    plain = return_mapping(*s, **table("von_mises"))
    power = return_mapping(*s, **table("von_mises", c7=1.0))
    for a, b in zip(plain[:3], power[:3], strict=True):
        assert (a - b).abs().max() < 1e-12 * KAPPA
    at_rest = return_mapping(power[0], power[1], torch.zeros(500, 3, 3, dtype=F64),
                             **table("von_mises", c7=1.0))  # fmt: skip
    assert (at_rest[0] - power[0]).abs().max() < 1e-12


def test_stored_energy_never_rises() -> None:
    s = states("von_mises", 2000, 0.2)
    still = torch.zeros_like(s[2])
    for row in ROWS.values():
        before = ops.elastic_energy(s[0], **row)
        strain = return_mapping(s[0], s[1], still, **row, dt=DT)[0]
        assert bool((ops.elastic_energy(strain, **row) <= before * (1.0 + 1e-12)).all())


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
def test_the_solver_follows_the_composed_operators(device: str) -> None:
    side = (torch.arange(6, dtype=F64) + 0.5) * 0.5
    points = torch.stack(torch.meshgrid(side, side, side, indexing="ij"), dim=-1).reshape(-1, 3)
    turn = torch.tensor([[1.5, 0.4, 0.0], [-0.8, -0.7, 0.0], [0.0, 0.3, -0.5]], dtype=F64)
    velocity, volume = (points - points.mean(0)) @ turn, torch.full((216,), 0.125, dtype=F64)
    row = table("von_mises", c2=300.0, c4=2e3, c7=POWER, c3=RATE, c5=2e3)
    common = {"mass": volume * 1000.0, "volume": volume, "dx": 1.0, "gravity": (0.0, 0.0, 0.0)}
    there = {k: v.to(device) if isinstance(v, Tensor) else v for k, v in (common | row).items()}
    solver = ops.Solver(
        points.to(device), velocity.to(device), alpha=torch.zeros_like(volume).to(device), dt=0.01,
        **there,
    )  # fmt: skip
    solver.advance(1e9, steps=20)
    state = ops.mpm_state(points, velocity, alpha=torch.zeros_like(volume), **row)
    state = ops.rollout(state, 20, dt=0.01, **common, **row)
    assert float(state.alpha.max()) > 1e-2
    assert (solver.position.cpu() - state.position).abs().max() < 1e-9
    assert (solver.alpha.cpu() - state.alpha).abs().max() < 1e-9


def test_what_goes_together_and_what_does_not() -> None:
    copper = materials.copper.override(rate_sensitivity=0.02)
    row = copper.parameters()
    assert float(row[7]) == 1.0 and float(row[3]) == 0.02 and float(row[5]) == 0.0
    assert float(materials.copper.parameters()[7]) == 0.0
    with pytest.raises(InputError, match="two laws of rate"):
        copper.override(plastic_viscosity=10.0)
    with pytest.raises(InputError, match="must not be below 0 with an exponent"):
        copper.override(hardening_modulus=-1e3)
    with pytest.raises(ValueError, match="cohesion must be finite and not negative"):
        return_mapping(*states("von_mises", 2), **table("von_mises", c7=1.0, c3=-1.0), dt=DT)


def test_a_taylor_bar_is_as_long_as_the_recovered_one() -> None:
    """Fitted linear hardening, 4 cells across a radius."""
    bar = metal.impact(190.0, metal.ANNEALED, metal.fitted_copper())
    assert 1e3 * bar.length == pytest.approx(16.2, rel=0.05)
    assert 1e3 * bar.foot == pytest.approx(0.5 * 13.5, rel=0.05)


@pytest.mark.cuda
@pytest.mark.parametrize("dtype", [torch.float32, F64])
@pytest.mark.parametrize("name", ROWS)
def test_cuda_matches_cpu(name: str, dtype: torch.dtype) -> None:
    assert_cuda_matches_cpu(ROWS[name], dtype)
