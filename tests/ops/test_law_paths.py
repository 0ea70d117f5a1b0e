"""One particle led along paths with a known answer: metal, sand, liquid, rigid."""

from __future__ import annotations

import math

import pytest
import torch
from law_states import DT, EYE, KAPPA, MU, table
from torch import Tensor

from gsfluent.ops import elastic_energy, return_mapping

YOUNG = 9.0 * KAPPA * MU / (3.0 * KAPPA + MU)
DTYPES = [torch.float32, torch.float64]


def lead(
    t: dict[str, Tensor], steps: list[Tensor], alpha: float = 0.0, dt: float = DT
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Apply increments one after the other; the last strain, alpha, stress and summed info."""
    dtype = t["params"].dtype
    strain, state = torch.zeros(1, 6, dtype=dtype), torch.full((1,), alpha, dtype=dtype)
    info = torch.zeros(4, dtype=torch.int32)
    stress = strain
    for step in steps:
        strain, state, stress, counts = return_mapping(
            strain, state, step.to(dtype)[None], **t, dt=dt
        )
        info += counts
    return strain, state, stress, info


def scale_by(factor: float, count: int = 20) -> list[Tensor]:
    """Steps that multiply every length, evenly, so that the volume grows by ``factor``."""
    return [(factor ** (1.0 / (3.0 * count)) - 1.0) * EYE] * count


def same(e: Tensor) -> list[float]:
    return e[0].tolist()


@pytest.mark.parametrize("hardening", [0.0, 2e4])
def test_metal_follows_its_yield_stress_in_tension(hardening: float) -> None:
    """Uniaxial stress: sides are let in until they carry nothing; the bar carries sigma_y + H p."""
    sigma = 2000.0
    t = table("von_mises", c2=sigma, c4=hardening)
    strain, alpha = torch.zeros(1, 6).double(), torch.zeros(1).double()
    for _ in range(60):
        low, high = -0.02, 0.02
        for _ in range(60):
            side = 0.5 * (low + high)
            step = torch.diag(torch.tensor([0.005, side, side]).double())[None]
            trial = return_mapping(strain, alpha, step, **t)
            low, high = (side, high) if float(trial[2][0, 1]) < 0.0 else (low, side)
        strain, alpha, stress, _ = trial
    assert abs(float(stress[0, 1])) < 1.0
    assert float(alpha[0]) > 0.2
    assert float(stress[0, 0]) == pytest.approx(sigma + hardening * float(alpha[0]), rel=1e-3)
    # Plastic strain is what the elastic strain sigma / E leaves over of the total.
    total = 60 * math.log(1.005)
    assert float(alpha[0]) == pytest.approx(total - float(stress[0, 0]) / YOUNG, rel=2e-3)


def test_metal_does_not_yield_under_pressure() -> None:
    strain, alpha, stress, info = lead(table("von_mises", c2=100.0), scale_by(0.5))
    assert info.tolist() == [0, 0, 0, 0]
    assert float(alpha[0]) == 0.0
    assert float(stress[0, 0]) == pytest.approx(KAPPA * math.log(0.5), rel=1e-6)
    assert strain[0, 0] == strain[0, 1]


def test_sand_rests_on_its_friction_cone() -> None:
    """Press, then shear far: |dev tau| ends at 3 alpha_DP p (isochoric: p stays)."""
    t = table("drucker_prager", c2=0.2, c3=0.0)
    shear = torch.zeros(3, 3).double()
    shear[0, 1] = 2e-3
    _, alpha, stress, _ = lead(t, scale_by(0.98) + [shear] * 100)
    p = -float(stress[0, :3].mean())
    dev = stress[0].clone()
    dev[:3] += p
    norm = math.sqrt(float((dev[:3] ** 2).sum() + 2.0 * (dev[3:] ** 2).sum()))
    assert p == pytest.approx(-KAPPA * math.log(0.98), rel=1e-2)
    assert norm == pytest.approx(3.0 * 0.2 * p, rel=1e-9)
    assert float(alpha[0]) == 0.0


@pytest.mark.parametrize("dtype", DTYPES)
def test_sand_that_parted_presses_only_when_its_gap_has_closed(dtype: torch.dtype) -> None:
    """Volume correction of Tampubolon et al. 2017: 1 -> 1.2 -> 1 leaves nothing."""
    t = table("drucker_prager", dtype, c3=0.0)
    apart = lead(t, scale_by(1.2))
    assert same(apart[0]) == [0.0] * 6 and same(apart[2]) == [0.0] * 6
    assert float(apart[1][0]) == pytest.approx(math.log(1.2), rel=1e-4)
    back = lead(t, scale_by(1.2) + scale_by(1.0 / 1.2))
    assert abs(float(back[2][0, 0])) < 1e-5 * KAPPA
    assert abs(float(back[1][0])) < 1e-5
    pressed = lead(t, scale_by(1.2) + scale_by(1.0 / 1.2) + scale_by(0.99))
    assert float(pressed[2][0, 0]) == pytest.approx(KAPPA * math.log(0.99), rel=1e-2)


def test_moist_sand_holds_its_tensile_pressure_and_no_more() -> None:
    cohesive = table("drucker_prager", c3=500.0)
    held = lead(cohesive, scale_by(math.exp(400.0 / KAPPA)))
    assert float(held[2][0, 0]) == pytest.approx(400.0, rel=1e-6)
    parted = lead(cohesive, scale_by(1.1))
    assert float(parted[2][0, 0]) == pytest.approx(500.0, rel=1e-6)
    assert float(parted[1][0]) == pytest.approx(math.log(1.1) - 500.0 / KAPPA, rel=1e-6)


@pytest.mark.parametrize("dtype", DTYPES)
def test_liquid_stretched_and_let_back_holds_no_pressure(dtype: torch.dtype) -> None:
    """J 1 -> 1.2 -> 1 within its memory; NACC with xi ~ 0 keeps about 0.01 kappa here."""
    t = table("fluid", dtype, c2=0.0)
    out = lead(t, scale_by(1.199) + scale_by(1.0 / 1.199))
    bound = 1e-12 if dtype == torch.float64 else 3e-6
    assert float(out[0].abs().max()) < bound
    assert float(out[2].abs().max()) < 3.0 * bound * KAPPA
    milk = table("nacc", c2=0.0, c3=0.0, c4=0.05, c5=0.0)
    fluffed = lead(milk, scale_by(1.199) + scale_by(1.0 / 1.199), alpha=-0.2)
    assert float(fluffed[2][0, 0]) < -0.005 * KAPPA


@pytest.mark.parametrize("dtype", DTYPES)
def test_liquid_volume_does_not_drift_in_ten_thousand_steps(dtype: torch.dtype) -> None:
    """1000 closed paths of five random steps and their inverses: J comes back."""
    t = table("fluid", dtype, c2=0.0)
    generator = torch.Generator().manual_seed(4)
    there = 0.02 * torch.randn(5, 3, 3, generator=generator, dtype=torch.float64)
    back = torch.linalg.inv(EYE + there.flip(0)) - EYE
    period = [*there, *back]
    strain, state = torch.zeros(1, 6, dtype=dtype), torch.zeros(1, dtype=dtype)
    for _ in range(1000):
        for step in period:
            strain, state, _, _ = return_mapping(strain, state, step.to(dtype)[None], **t)
    assert abs(float(strain[0, 0])) < (1e-12 if dtype == torch.float64 else 2e-5)


def test_liquid_pressure_is_taits_and_viscosity_is_newtons() -> None:
    t = table("fluid", c2=3.0)
    j, rate = 0.95, 40.0
    shear = torch.zeros(3, 3).double()
    shear[0, 1] = rate * DT
    _, _, stress, _ = lead(t, [*scale_by(j, 1), shear])
    p = KAPPA / 7.0 * (j**-7.0 - 1.0)
    assert float(stress[0, 0]) == pytest.approx(-j * p, rel=1e-9)
    assert float(stress[0, 3]) == pytest.approx(j * 3.0 * rate, rel=1e-9)
    turn = torch.tensor([[0.6, -0.8, 0.0], [0.8, 0.6, 0.0], [0.0, 0.0, 1.0]]).double() - EYE
    spin = 0.5 * (turn - turn.T)
    assert float(lead(t, [spin])[2].abs().max()) == 0.0


def test_liquid_does_not_pull() -> None:
    out = lead(table("fluid", c2=0.0), scale_by(1.1))
    assert same(out[2]) == [0.0] * 6
    assert float(elastic_energy(out[0], **table("fluid"))) == 0.0


def test_rigid_matter_has_no_strain_and_no_stress() -> None:
    out = lead(table("rigid"), scale_by(0.5))
    assert same(out[0]) == [0.0] * 6 and same(out[2]) == [0.0] * 6
    assert out[3].tolist() == [0, 0, 0, 0]


@pytest.mark.parametrize("name", ["von_mises", "corotated"])
def test_small_strain_is_hookes_law_in_float32(name: str) -> None:
    """1e-6 of strain: F = I + grad u in float32 would have lost nine tenths of it."""
    t = table(name, torch.float32, c2=1e9 if name == "von_mises" else 0.0)
    strain = 1e-6 * torch.tensor([[3.0, -1.0, 0.5, 0.2, -0.4, 0.7]])
    stress = return_mapping(strain, torch.zeros(1), torch.zeros(1, 3, 3), **t)[2].double()
    half = 0.5 * strain.double()
    mean = half[:, :3].mean()
    want = 2.0 * MU * half
    want[:, :3] += 3.0 * KAPPA * mean - 2.0 * MU * mean
    assert (stress - want).abs().max() < 1e-5 * want.abs().max()
