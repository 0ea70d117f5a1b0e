"""Rubber by Yeoh and Ogden, and von Mises flow with a viscosity or softening, by closed forms."""

from __future__ import annotations

import math

import pytest
import torch
from law_states import DT, KAPPA, MU, assert_cuda_matches_cpu, cast, states, table
from torch import Tensor

from gsfluent import materials, ops
from gsfluent.errors import InputError
from gsfluent.ops import return_mapping
from gsfluent.ops.reference import plasticity as reference

F64 = torch.float64
DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)]
TRELOAR = materials.natural_rubber
BAND = materials.rubber_band
STILL = torch.zeros(1, 3, 3, dtype=F64)


def stress(material: materials.Material, b: list[list[float]]) -> Tensor:
    """Kirchhoff stress of a left Cauchy-Green tensor [Pa], [3, 3]."""
    strain = torch.tensor(b, dtype=F64) - torch.eye(3, dtype=F64)
    sym = strain.reshape(1, 9)[:, [0, 4, 8, 1, 2, 5]].contiguous()
    law = torch.tensor([materials.LAWS[material.law]], dtype=torch.int32)
    row = material.parameters()[None]
    tau = return_mapping(sym, torch.zeros(1, dtype=F64), STILL, law=law, params=row)[2][0]
    return tau[[0, 3, 4, 3, 1, 5, 4, 5, 2]].reshape(3, 3)


def diagonal(*stretches: float) -> list[list[float]]:
    return torch.diag(torch.tensor(stretches, dtype=F64) ** 2).tolist()


def ogden(first: float, second: float) -> float:
    """Difference of the principal stresses of two stretches, by Treloar's rubber of Ogden 1972."""
    terms = ((0.63e6, 1.3), (1.2e3, 5.0), (-1e4, -2.0))
    return sum(mu * (first**a - second**a) for mu, a in terms)


def yeoh(first: float, second: float, x: float) -> float:
    c20, c30 = float(BAND.yeoh_c20 or 0.0), float(BAND.yeoh_c30 or 0.0)
    slope = 0.5 * float(BAND.parameters()[0]) + 2.0 * c20 * x + 3.0 * c30 * x * x
    return 2.0 * slope * (first**2 - second**2)


@pytest.mark.parametrize("stretch", [0.4, 0.95, 1.0, 1.3, 3.0, 6.0])
def test_tension_and_compression(stretch: float) -> None:
    """Uniaxial at constant volume: the difference to the free sides, which the pressure leaves."""
    side = stretch**-0.5
    x = stretch**2 + 2.0 / stretch - 3.0
    for material, want in ((TRELOAR, ogden(stretch, side)), (BAND, yeoh(stretch, side, x))):
        tau = stress(material, diagonal(stretch, side, side))
        assert float(tau[0, 0] - tau[1, 1]) == pytest.approx(want, rel=1e-9, abs=1e-4)
        assert float(tau.trace()) == pytest.approx(0.0, abs=1e-5 * max(1.0, abs(want)))


@pytest.mark.parametrize("stretch", [0.7, 1.2, 2.0, 4.0])
def test_equibiaxial_tension(stretch: float) -> None:
    thick = stretch**-2.0
    x = 2.0 * stretch**2 + stretch**-4.0 - 3.0
    for material, want in ((TRELOAR, ogden(stretch, thick)), (BAND, yeoh(stretch, thick, x))):
        tau = stress(material, diagonal(stretch, stretch, thick))
        assert float(tau[0, 0] - tau[2, 2]) == pytest.approx(want, rel=1e-9)


@pytest.mark.parametrize("shear", [0.01, 0.5, 2.0])
def test_simple_shear(shear: float) -> None:
    """b12 = gamma; principal stretches l and 1/l with l - 1/l = gamma."""
    long = 0.5 * shear + math.sqrt(1.0 + 0.25 * shear**2)
    b = [[1.0 + shear**2, shear, 0.0], [shear, 1.0, 0.0], [0.0, 0.0, 1.0]]
    wanted = (
        (TRELOAR, ogden(long, 1.0 / long) / (long**2 - long**-2)),
        (BAND, yeoh(1.0, 0.0, shear**2)),
    )
    for material, want in wanted:
        assert float(stress(material, b)[0, 1]) == pytest.approx(want * shear, rel=1e-9)


def test_pressure_is_that_of_the_neo_hookean_law() -> None:
    for material in (TRELOAR, BAND):
        j = 0.8
        tau = stress(material, diagonal(*[j ** (1.0 / 3.0)] * 3))
        assert float(tau[0, 0]) == pytest.approx(
            0.5 * float(material.parameters()[1]) * (j**2 - 1.0), rel=1e-12
        )


def test_waves_of_stretched_rubber_are_faster() -> None:
    """The time step takes part in the stiffening."""
    for material in (TRELOAR, BAND):
        law = torch.tensor([materials.LAWS[material.law]], dtype=torch.int32)
        row = material.parameters()[None]
        speeds = [
            float(ops.wave_speed(torch.tensor([[s**2 - 1, 1 / s - 1, 1 / s - 1, 0, 0, 0]]).double(),
                                 law=law, params=row))
            for s in (1.0, 4.0, 7.0)
        ]  # fmt: skip
        assert speeds[0] == pytest.approx(material.wave_speed, rel=1e-9)
        assert speeds[0] < speeds[1] < speeds[2]
        assert speeds[2] > 1.5 * speeds[0]


VISCOUS = {
    "viscous": table("von_mises", c5=80.0),
    "softening": table("von_mises", c4=-1e4),
    "both": table("von_mises", c4=-2e4, c5=20.0),
}


@pytest.mark.parametrize("name", VISCOUS)
@pytest.mark.parametrize("scale", [0.01, 0.05, 0.3])
def test_flow_matches_its_definition(name: str, scale: float) -> None:
    s, t = states("von_mises", 3000, scale), VISCOUS[name]
    got = return_mapping(*s, **t, dt=DT)
    want = reference.return_mapping(*s, **t, dt=DT)
    assert torch.equal(got[3], want[3])
    for g, w in zip(got[:3], want[:3], strict=True):
        assert (g - w).abs().max() <= 2e-12 * max(float(w.abs().max()), 1e-30)
    narrow = return_mapping(*cast(torch.float32, *s), law=t["law"], params=t["params"].float(),
                            dt=DT)  # fmt: skip
    assert (narrow[2].double() - got[2]).abs().max() <= 2e-5 * got[2].abs().max()


@pytest.mark.parametrize("name", VISCOUS)
def test_flow_has_a_gradient(name: str) -> None:
    strain, alpha, increment = states("von_mises", 6)
    t = VISCOUS[name]
    inputs = [a.clone().requires_grad_(True) for a in (strain, alpha, increment)]
    scale = torch.ones(1, 8, dtype=F64, requires_grad=True)

    def f(strain: Tensor, alpha: Tensor, increment: Tensor, scale: Tensor) -> tuple[Tensor, ...]:
        rows = t["params"] * scale
        out = return_mapping(strain, alpha, increment, law=t["law"], params=rows, dt=DT)
        return out[0], out[1], out[2] / 1e4

    assert torch.autograd.gradcheck(f, (*inputs, scale), fast_mode=True)


def test_overstress_relaxes_at_the_rate_of_the_viscosity() -> None:
    """Held shear: |s| - limit falls by 1 + 2 mu_hat dt / eta a step, exp(-2 mu t / eta) for small
    steps and strains."""
    eta, dt, steps = 100.0, 1e-5, 100
    row = table("von_mises", c2=0.0, c4=0.0, c5=eta)
    strain = torch.tensor([[0.0, 0.0, 0.0, 0.01, 0.0, 0.0]], dtype=F64)
    alpha = torch.zeros(1, dtype=F64)
    start = None
    for _ in range(steps):
        strain, alpha, tau, _ = return_mapping(strain, alpha, STILL, **row, dt=dt)
        start = float(tau[0, 3]) if start is None else start
    left = float(tau[0, 3]) / start
    assert left == pytest.approx((1.0 + 2.0 * MU * dt / eta) ** -(steps - 1), rel=1e-4)
    assert left == pytest.approx(math.exp(-2.0 * MU * dt * (steps - 1) / eta), rel=5e-3)


def test_viscosity_without_rate_is_the_plain_law_and_at_once_elastic() -> None:
    s = states("von_mises", 500)
    plain = return_mapping(*s, **table("von_mises"))
    slow = return_mapping(*s, **table("von_mises", c5=1.0), dt=1e9)
    assert (slow[2] - plain[2]).abs().max() < 1e-9 * KAPPA
    fast = return_mapping(*s, **table("von_mises", c5=1e9), dt=1e-9)
    elastic = return_mapping(*s, **table("von_mises", c2=1e9))
    assert (fast[2] - elastic[2]).abs().max() < 1e-9 * KAPPA
    with pytest.raises(ValueError, match="viscosity needs dt"):
        return_mapping(*s, **table("von_mises", c5=1.0))


def test_softening_ends_at_nothing() -> None:
    """The yield stress falls to zero; then the flow meets none, and is all of the shear."""
    row = table("von_mises", c2=1000.0, c4=-5e4)
    strain, alpha = torch.zeros(1, 6, dtype=F64), torch.zeros(1, dtype=F64)
    grow = torch.zeros(1, 3, 3, dtype=F64)
    grow[0, 0, 1] = 1e-4
    held = []
    for _ in range(2000):
        strain, alpha, tau, _ = return_mapping(strain, alpha, grow, **row)
        held.append(math.sqrt(3.0) * abs(float(tau[0, 3])))
    limit = 1000.0
    assert max(held) == pytest.approx(limit, rel=2e-2)
    assert held[-1] == pytest.approx(0.0, abs=1e-6 * limit)
    assert float(alpha) == pytest.approx(0.2 / math.sqrt(3.0), rel=5e-3)  # all of the shear
    falling = [h for h in held if 0.2 * limit < h < 0.8 * limit]
    assert len(falling) > 10


def test_refused_by_name() -> None:
    s = states("yeoh", 2)
    with pytest.raises(ValueError, match="yeoh_c20 is so far below 0"):
        return_mapping(*s, **table("yeoh", c2=-1e6))
    with pytest.raises(ValueError, match="must have one sign"):
        return_mapping(*s, **table("ogden", c5=1e3))
    with pytest.raises(InputError, match="leave some of the shear modulus"):
        materials.natural_rubber.override(ogden_mu2=1e6)
    with pytest.raises(InputError, match="hardening_modulus must be above"):
        materials.plasticine.override(hardening_modulus=-1e9)
    with pytest.raises(ValueError, match="cohesion must be finite and not negative"):
        return_mapping(*s, **table("nacc", c3=-1.0))


@pytest.mark.cuda
@pytest.mark.parametrize("dtype", [torch.float32, F64])
@pytest.mark.parametrize("name", VISCOUS)
def test_cuda_matches_cpu(name: str, dtype: torch.dtype) -> None:
    """Rubber: test_laws.py."""
    assert_cuda_matches_cpu(VISCOUS[name], dtype)


def block(count: int = 4) -> Tensor:
    side = (torch.arange(2 * count, dtype=F64) + 0.5) * 0.5
    return torch.stack(torch.meshgrid(side, side, side, indexing="ij"), dim=-1).reshape(-1, 3)


def solver(row: Tensor, name: str, velocity: Tensor, dt: float, flip: float = 0.0) -> ops.Solver:
    points = block()
    volume = velocity.new_full((len(points),), 0.125)
    return ops.Solver(
        points.to(velocity), velocity, volume * float(row[6]), volume, dx=1.0,
        law=velocity.new_tensor([materials.LAWS[name]], dtype=torch.int32),
        params=row[None].to(velocity), alpha=torch.zeros_like(volume), gravity=(0.0, 0.0, 0.0),
        dt=dt, flip=flip,
    )  # fmt: skip


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", [torch.float32, F64])
@pytest.mark.parametrize("name", ["yeoh", "ogden", "von_mises"])
def test_resident_solver_follows_the_composed_operators(
    name: str, dtype: torch.dtype, device: str
) -> None:
    """The same block, stretched and spun, by both engines; momentum is kept."""
    row = table(name, **({"c5": 30.0, "c2": 300.0} if name == "von_mises" else {}))["params"][0]
    points = block()
    centre = points - points.mean(0)
    velocity = centre @ torch.tensor([[1.5, 0.4, 0.0], [-0.8, -0.7, 0.0], [0.0, 0.3, -0.5]],
                                     dtype=F64)  # fmt: skip
    dt, steps = 0.02, 25
    s = solver(row, name, velocity.to(device, dtype), dt)
    s.advance(1e9, steps=steps)
    kw = {"law": torch.tensor([materials.LAWS[name]], dtype=torch.int32), "params": row[None]}
    volume = torch.full((len(points),), 0.125, dtype=F64)
    state = ops.mpm_state(points, velocity, alpha=torch.zeros(len(points), dtype=F64), **kw)
    state = ops.rollout(
        state, steps, mass=volume * float(row[6]), volume=volume, dx=1.0, dt=dt,
        gravity=(0.0, 0.0, 0.0), **kw,
    )  # fmt: skip
    bound = 2e-4 if dtype == torch.float32 else 1e-9
    assert (s.position.double().cpu() - state.position).abs().max() < bound
    assert (s.velocity.double().cpu() - state.velocity).abs().max() < bound
    assert (s.strain.double().cpu() - state.strain).abs().max() < bound
    if name == "von_mises":
        assert float(state.alpha.max()) > 1e-2  # it flows
    total = s.velocity.double().mean(0)
    assert total.abs().max() < 1e-5


@pytest.mark.cuda
@pytest.mark.parametrize("flip", [0.0, 0.5])
@pytest.mark.parametrize("name", ["yeoh", "ogden", "von_mises"])
def test_a_gpu_steps_as_the_cpu_does(name: str, flip: float) -> None:
    """By steps of its own length, beside APIC and with a share of the points' own motion."""
    row = table(name, **({"c5": 30.0, "c2": 300.0} if name == "von_mises" else {}))["params"][0]
    points = block()
    turn = torch.tensor([[1.5, 0.4, 0.0], [-0.8, -0.7, 0.0], [0.0, 0.3, -0.5]], dtype=F64)
    velocity = (points - points.mean(0)) @ turn
    both = [solver(row, name, velocity.to(device), 0.02, flip) for device in ("cpu", "cuda")]
    for s in both:
        s.advance(1e9, steps=25)
    for what in ("position", "velocity", "strain", "alpha"):
        want, got = (getattr(s, what).cpu() for s in both)
        assert (got - want).abs().max() < 1e-9, what
