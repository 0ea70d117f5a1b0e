"""Stiffness that relaxes and yields that take time: one point, the books, both engines."""

from __future__ import annotations

import cmath
import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from gsfluent import ops
from gsfluent.errors import InputError
from gsfluent.ops.plasticity import LAWS

YOUNG, NU, DENSITY = 1e6, 0.3, 1000.0
MU, KAPPA = YOUNG / (2.0 * (1.0 + NU)), YOUNG / (3.0 * (1.0 - 2.0 * NU))
ELASTIC, NACC = LAWS["elastic"], LAWS["nacc"]


def rows(law: int = ELASTIC, dtype: torch.dtype = torch.float64) -> dict[str, Tensor]:
    values = [MU, KAPPA, 1.5, 0.6, 3.0, 0.0, DENSITY, 0.0]
    return {
        "law": torch.tensor([law], dtype=torch.int32),
        "params": torch.tensor([values], dtype=dtype),
    }


def branch(share: float, rate: float, count: int = 1) -> Tensor:
    found = torch.zeros(count, 9, dtype=torch.float64)
    found[:, 6], found[:, 7] = share, rate
    return found


def step(
    strain: Tensor, viscous: Tensor, increment: Tensor, dt: float, law: int = ELASTIC,
    alpha: float = -0.05,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Strain, branch and stress after a step of one point."""
    table = rows(law)
    start = torch.full((strain.shape[0],), alpha, dtype=torch.float64)
    returned = ops.return_mapping(strain, start, increment, dt=dt, **table)[:3]
    after, e, _, stress = ops.viscous_step(
        viscous, strain, start, increment, returned, dt=dt, **table
    )
    return e, after, stress


def test_the_loss_factor_is_that_of_a_standard_linear_solid() -> None:
    """Cyclic shear of a point: its complex modulus is 1 - g + g i w tau / (1 + i w tau)."""
    share = torch.tensor([0.2, 0.5, 0.9, 0.9, 0.9], dtype=torch.float64)
    speed = torch.tensor([3.0, 1.0, 2.0, 1.0, 3.0], dtype=torch.float64)  # w tau
    steps, amplitude = 3000, 1e-7
    omega = 2.0 * math.pi
    dt = 1.0 / steps
    part = 1j * speed / (1.0 + 1j * speed)
    wanted = 1.0 - share + share * part
    viscous = branch(0.0, 0.0, 5)
    viscous[:, 6], viscous[:, 7] = share, omega / speed
    viscous[:, 3] = amplitude * part.imag  # where the spring is when the cycle has gone on for long
    strain, found = torch.zeros(5, 6, dtype=torch.float64), torch.zeros(5, dtype=torch.complex128)
    for i in range(steps):
        grown = amplitude * (math.sin(omega * (i + 1) * dt) - math.sin(omega * i * dt))
        increment = torch.zeros(5, 3, 3, dtype=torch.float64)
        increment[:, 0, 1] = increment[:, 1, 0] = 0.5 * grown
        strain, viscous, stress = step(strain, viscous, increment, dt)
        found += stress[:, 3] * cmath.exp(-1j * omega * (i + 1) * dt)
    modulus = found * 2j / (steps * amplitude * MU)
    loss = modulus.imag / modulus.real - wanted.imag / wanted.real
    assert float(loss.abs().max()) < 1e-6
    assert float((modulus - wanted).abs().max()) < 1e-6


def test_what_is_held_relaxes_to_the_rest_of_its_stiffness() -> None:
    rate, dt = 10.0, 2e-4
    viscous = branch(0.6, rate)
    pull = torch.zeros(1, 3, 3, dtype=torch.float64)
    pull[0] = 1e-6 * torch.eye(3, dtype=torch.float64)
    strain, viscous, first = step(torch.zeros(1, 6, dtype=torch.float64), viscous, pull, 1e-12)
    stress = first
    for _ in range(1000):
        strain, viscous, stress = step(strain, viscous, torch.zeros_like(pull), dt)
    left = 0.4 + 0.6 * math.exp(-1000 * dt * rate)
    assert float(stress[0, 0] / first[0, 0]) == pytest.approx(left, rel=1e-6)
    # any step is stable: a very long one leaves the law's share
    _, viscous, stress = step(strain, viscous, torch.zeros_like(pull), 1e9)
    assert float(stress[0, 0] / first[0, 0]) == pytest.approx(0.4, rel=1e-6)


def some(seed: int, count: int, size: float) -> tuple[Tensor, Tensor, Tensor]:
    """Strains, springs and increments at random, of what can be: b is positive."""
    generator = torch.Generator().manual_seed(seed)

    def strains() -> Tensor:
        f = torch.randn(count, 3, 3, generator=generator, dtype=torch.float64)
        f = torch.eye(3, dtype=torch.float64) + 0.2 * f
        b = f @ f.transpose(1, 2) - torch.eye(3, dtype=torch.float64)
        return torch.stack(
            [b[:, i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))], 1
        )

    move = size * torch.randn(count, 3, 3, generator=generator, dtype=torch.float64)
    return strains(), strains(), move


@given(st.integers(0, 10**6), st.floats(0.0, 1.0), st.floats(0.0, 1e6))
def test_relaxing_never_stores_energy(seed: int, share: float, rate: float) -> None:
    strain, spring, _ = some(seed, 16, 0.0)
    viscous = branch(share, rate, 16)
    viscous[:, :6] = spring
    still = torch.zeros(16, 3, 3, dtype=torch.float64)
    table = rows()

    def stored(m: Tensor, e: Tensor) -> Tensor:
        return ops.viscous_energy(m, ops.elastic_energy(e, **table), **table)

    after, relaxed, _ = step(strain, viscous, still, 1e-3)
    before = stored(viscous, strain)
    assert bool((stored(relaxed, after) <= before * (1.0 + 1e-12) + 1e-9).all())


@given(st.integers(0, 10**6))
def test_a_turned_point_answers_as_a_turned_one(seed: int) -> None:
    strain, spring, move = some(seed, 8, 0.02)
    viscous = branch(0.7, 50.0, 8)
    viscous[:, :6] = spring
    turn, _ = torch.linalg.qr(
        torch.randn(3, 3, generator=torch.Generator().manual_seed(seed + 1), dtype=torch.float64)
    )

    def turned(e: Tensor) -> Tensor:
        full = e[:, [0, 3, 4, 3, 1, 5, 4, 5, 2]].view(-1, 3, 3)
        full = turn @ full @ turn.T
        return full.reshape(-1, 9)[:, [0, 4, 8, 1, 2, 5]]

    other = viscous.clone()
    other[:, :6] = turned(spring)
    _, _, stress = step(strain, viscous, move, 1e-3)
    _, _, again = step(turned(strain), other, turn @ move @ turn.T, 1e-3)
    assert torch.allclose(turned(stress), again, rtol=1e-10, atol=1e-6)


def test_what_breaks_lets_go_of_its_spring() -> None:
    viscous = branch(0.8, 1.0)
    strain = torch.zeros(1, 6, dtype=torch.float64)
    pull = torch.zeros(1, 3, 3, dtype=torch.float64)
    pull[0, 0, 0] = 2e-3
    for _ in range(50):
        strain, viscous, stress = step(strain, viscous, pull, 1e-6, NACC, alpha=0.1)
    assert float(viscous[0, :6].abs().max()) < 1e-3
    assert float(stress.abs().max()) < 1e-3 * YOUNG
    # without a yield the branch of brittle matter is that of elastic matter
    small = torch.zeros(1, 3, 3, dtype=torch.float64)
    small[0, 0, 0] = 1e-4
    none = torch.zeros(1, 6, dtype=torch.float64)
    one, two = (step(none, branch(0.8, 10.0), small, 1e-3, law) for law in (ELASTIC, NACC))
    assert all(torch.equal(a, b) for a, b in zip(one, two, strict=True))


@given(st.integers(0, 10**6))
def test_a_spring_that_never_relaxes_is_not_there(seed: int) -> None:
    """Whatever yields, pulled, pressed or sheared: stress and spring are those of the law."""
    _, _, move = some(seed, 16, 4e-3)
    none = torch.zeros(16, 6, dtype=torch.float64)
    strain, viscous, table = none, branch(0.8, 0.0, 16), rows(NACC)
    alpha = torch.linspace(-0.05, 0.1, 16, dtype=torch.float64)
    for turn in (1.0, 1.0, -1.0, -1.0, -1.0, 1.0):
        returned = ops.return_mapping(strain, alpha, turn * move, dt=1e-3, **table)[:3]
        viscous, strain, alpha, stress = ops.viscous_step(
            viscous, strain, alpha, turn * move, returned, dt=1e-3, **table
        )
        assert torch.allclose(stress, returned[2], rtol=1e-9, atol=1e-9 * YOUNG)
        assert torch.allclose(viscous[:, :6], strain, rtol=1e-9, atol=1e-12)


def test_a_spring_that_relaxed_while_it_was_pressed_pulls_with_no_more_than_the_strength() -> None:
    share, beta = 0.95, 0.6
    strength = beta * KAPPA * (1e-5 + math.sinh(3.0 * 0.05))  # rows, alpha of -0.05
    viscous, table = branch(share, 1e4), rows(NACC)
    strain = torch.zeros(1, 6, dtype=torch.float64)
    alpha = torch.full((1,), -0.05, dtype=torch.float64)
    squeeze = -1e-3 * torch.eye(3, dtype=torch.float64)[None]
    stresses = []
    for i in range(120):  # 40 steps to press it, 40 to hold it, 40 to let it go at once
        moved = (0.0 if 40 <= i < 80 else 1.0 if i < 40 else -1.0) * squeeze
        dt = 1e-4 if i < 80 else 1e-9
        returned = ops.return_mapping(strain, alpha, moved, dt=dt, **table)[:3]
        viscous, strain, alpha, stress = ops.viscous_step(
            viscous, strain, alpha, moved, returned, dt=dt, **table
        )
        stresses.append(float(stress[0, :3].mean()))
    assert float(alpha) == -0.05  # nothing broke
    assert max(stresses) == pytest.approx(share * strength, rel=1e-3)


def sheared(rate: float, time: float, dt: float, steps: int) -> tuple[Tensor, Tensor, Tensor]:
    """Shear stress over the steps of perfectly plastic matter, then strain and alpha.

    NACC whose surface is symmetric in pressure (beta = 1) without shear damage: in pure shear its
    pressure is and stays none, and its alpha what it was.
    """
    table = rows(NACC)
    table["params"][0, 3] = 1.0
    viscous = branch(0.0, 0.0)
    viscous[0, 8] = time
    strain, alpha = torch.zeros(1, 6, dtype=torch.float64), torch.full((1,), 0.0).double()
    increment = torch.zeros(1, 3, 3, dtype=torch.float64)
    increment[0, 0, 1] = increment[0, 1, 0] = 0.5 * rate * dt
    stress = []
    for _ in range(steps):
        returned = ops.return_mapping(strain, alpha, increment, dt=dt, epsilon=0.0, **table)[:3]
        viscous, strain, alpha, now = ops.viscous_step(
            viscous, strain, alpha, increment, returned, dt=dt, **table
        )
        stress.append(now[0, 3])
    return torch.stack(stress), strain, alpha


def test_strength_rises_with_the_rate_by_stiffness_times_rate_times_the_time_of_a_yield() -> None:
    """Steady flow: the law's own strength and mu rate T, closed form of Duvaut and Lions."""
    time, dt = 1e-3, 1e-4
    slow = sheared(1e-3, 0.0, dt, 200)[0]
    own = float(slow[-1])  # yields at once
    # the surface says it: q = M a / sqrt(1 + 2 beta), q = sqrt(3) tau_xy
    assert own == pytest.approx(1.5 * 1e-5 * KAPPA / 3.0, rel=1e-4)
    assert float(sheared(1e-2, 0.0, dt, 200)[0][-1]) == pytest.approx(own, rel=5e-5)
    for rate in (1e-3, 1e-2, 3e-2):
        stress, _, alpha = sheared(rate, time, dt, 400)
        assert float(stress[-1]) == pytest.approx(own + MU * rate * time, rel=2e-5)
        assert float(alpha) == pytest.approx(0.0, abs=1e-7)
    # on the way there, and at a tenth of the step: the exponential, to first order in dt / T
    rate = 3e-2
    for dt, close in ((1e-4, 0.06), (1e-5, 0.006)):
        stress = sheared(rate, time, dt, round(3.0 * time / dt))[0]
        begins = own / (MU * rate)  # when it begins to yield
        wanted = own + MU * rate * time * (1.0 - math.exp(-(3.0 * time - begins) / time))
        assert float(stress[-1]) == pytest.approx(wanted, rel=close)
        assert float(stress.max()) <= own + MU * rate * time


def test_what_is_strained_beyond_its_surface_decays_to_it() -> None:
    time, dt = 1e-3, 1e-5
    table = rows(NACC)
    table["params"][0, 3] = 1.0
    viscous, still = branch(0.0, 0.0), torch.zeros(1, 3, 3, dtype=torch.float64)
    viscous[0, 8] = time
    strain = torch.zeros(1, 6, dtype=torch.float64)
    strain[0, 3] = 3e-5
    alpha = torch.zeros(1, dtype=torch.float64)
    own = 1.5 * 1e-5 * KAPPA / 3.0
    first = ops.viscous_step(
        viscous, strain, alpha, still,
        ops.return_mapping(strain, alpha, still, dt=dt, epsilon=0.0, **table)[:3], dt=0.0, **table,
    )[3]  # fmt: skip
    assert float(first[0, 3]) == pytest.approx(3e-5 * MU, rel=1e-6)  # nothing has yielded yet
    for _ in range(100):
        returned = ops.return_mapping(strain, alpha, still, dt=dt, epsilon=0.0, **table)[:3]
        viscous, strain, alpha, stress = ops.viscous_step(
            viscous, strain, alpha, still, returned, dt=dt, **table
        )
    left = (1.0 + dt / time) ** -100
    assert float(stress[0, 3]) == pytest.approx(own + (3e-5 * MU - own) * left, rel=1e-4)


def test_what_springs_back_fast_returns_the_rest_of_its_energy() -> None:
    """A cycle of shear: loaded with the whole stiffness, unloaded with 1 - g of it if fast."""
    share = torch.tensor([0.0, 0.3, 0.75, 1.0], dtype=torch.float64).repeat(2)
    steps, amplitude = 500, 1e-4
    viscous = branch(0.0, 0.0, 8)
    viscous[:, 6] = share
    viscous[:4, 7], viscous[4:, 7] = -1.0, -1e6  # unloaded faster, and slower, than that
    strain = torch.zeros(8, 6, dtype=torch.float64)
    taken, back, before = (torch.zeros(8, dtype=torch.float64) for _ in range(3))
    turn = math.pi / steps
    for i in range(steps):
        grown = amplitude * (math.sin((i + 1) * turn) - math.sin(i * turn))
        pull = torch.zeros(8, 3, 3, dtype=torch.float64)
        pull[:, 0, 1] = grown
        strain, viscous, stress = step(strain, viscous, pull, 1e-3 / steps)
        work = 0.5 * (before + stress[:, 3]) * grown
        taken, back = taken + work.clamp(min=0.0), back - work.clamp(max=0.0)
        before = stress[:, 3]
    assert float(before.abs().max()) < 1e-6 * MU  # no set is left
    given = torch.where(torch.arange(8) < 4, 1.0 - share, 1.0)
    assert torch.allclose(taken, torch.full_like(taken, 0.5 * MU * amplitude**2), rtol=1e-3)
    assert float((back / taken - given).abs().max()) < 5e-3


# --- the resident solver ---

DX = 0.1


def ball(dtype: torch.dtype, law: int, count: int = 8) -> dict[str, Tensor]:
    """A jittered cube of points that is squeezed along x."""
    generator = torch.Generator().manual_seed(3)
    axis = (torch.arange(count, dtype=torch.float64) + 0.5) * 0.5 * DX
    position = torch.cartesian_prod(axis, axis, axis)
    position = position + 0.1 * DX * (torch.rand(position.shape, generator=generator) - 0.5)
    n = position.shape[0]
    velocity = torch.zeros(n, 3, dtype=dtype)
    velocity[:, 0] = (-2.0 * (position[:, 0] - position[:, 0].mean()) / (count * DX)).to(dtype)
    volume = torch.full((n,), (0.5 * DX) ** 3, dtype=dtype)
    return {
        "position": position, "velocity": velocity, "volume": volume, "mass": DENSITY * volume,
        "alpha": torch.full((n,), -0.05, dtype=dtype), **rows(law, dtype),
    }  # fmt: skip


DT, STEPS = 5e-4, 60
DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)]


def relaxing_cube(law: int, dtype: torch.dtype, device: str) -> tuple[dict[str, Tensor], Tensor]:
    """The cube with its branches: a third does not relax, a sixth lets go, half yields late.

    Of brittle matter two fifths have no strength.
    """
    cube = ball(dtype, law)
    n = cube["position"].shape[0]
    start = branch(0.7, 100.0, n).to(dtype)
    start[: n // 3, 6:] = 0.0
    start[::2, 8] = 2e-3
    start[n // 2 : 2 * n // 3, 7] = -5.0  # what springs back lets go
    if law == NACC:
        strong, weak, gone = torch.tensor([-0.05, -0.002, 0.02], dtype=dtype)
        turn = torch.arange(n) % 5
        cube["alpha"] = torch.where(turn < 2, gone, torch.where(turn < 4, weak, strong))
    return {name: value.to(device) for name, value in cube.items()}, start.to(device)


def stepped(cube: dict[str, Tensor], start: Tensor) -> ops.Solver:
    none = (0.0, 0.0, 0.0)
    solver = ops.Solver(
        **cube, dx=DX, dt=DT, gravity=none, frame=none, viscous=start, irreversible=False
    )
    solver.advance(STEPS * DT)
    return solver


@pytest.mark.parametrize("law", [ELASTIC, NACC])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("device", DEVICES)
def test_the_resident_solver_does_what_the_operators_do(
    device: str, law: int, dtype: torch.dtype
) -> None:
    cube, start = relaxing_cube(law, dtype, device)
    dt, steps, n = DT, STEPS, start.shape[0]
    solver = stepped(cube, start)
    table = {"law": cube["law"], "params": cube["params"]}
    x, v, alpha = cube["position"].clone(), cube["velocity"], cube["alpha"]
    affine, strain = v.new_zeros(n, 3, 3), v.new_zeros(n, 6)
    stress, viscous, row = torch.zeros_like(strain), start, cube["law"].new_zeros(n)
    x = x.to(dtype)
    for _ in range(steps):
        blocks = ops.build_blocks(x, DX)
        grid, _ = ops.p2g(
            x,
            v,
            affine,
            cube["mass"],
            dx=DX,
            blocks=blocks,
            dt=dt,
            stress=stress,
            volume=cube["volume"],
        )
        nodes = ops.grid_update(grid, dx=DX, dt=dt, blocks=blocks, gravity=(0.0, 0.0, 0.0))[0]
        x, v, affine, _ = ops.g2p(nodes, x, dx=DX, dt=dt, blocks=blocks, velocity=v)[:4]
        moved = dt * affine
        returned = ops.return_mapping(strain, alpha, moved, material=row, dt=dt, **table)[:3]
        viscous, strain, alpha, stress = ops.viscous_step(
            viscous, strain, alpha, moved, returned, material=row, dt=dt, **table
        )
    assert solver.steps == steps and solver.viscous is not None
    assert (solver.counters()["plastic"] > 100) == (law == NACC)
    close = 1e-3 if dtype == torch.float32 else 1e-9
    scale = float(viscous[:, :6].abs().max())
    assert scale > 1e-3
    assert float((solver.viscous - viscous)[:, :6].abs().max()) < close * scale
    assert torch.equal(solver.viscous[:, 6:], start[:, 6:])
    assert float((solver.position - x).abs().max()) < close * DX
    assert float((solver.alpha - alpha).abs().max()) < close * 0.05
    assert float((solver.stress - stress).abs().max()) < close * float(stress.abs().max())
    # what relaxes shows: the part without keeps its own strain to itself
    assert float(viscous[: n // 3, :6].abs().max()) == 0.0


@pytest.mark.cuda
@pytest.mark.parametrize("law", [ELASTIC, NACC])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_gpu_does_what_the_cpu_does(law: int, dtype: torch.dtype) -> None:
    here, there = (stepped(*relaxing_cube(law, dtype, device)) for device in ("cpu", "cuda"))
    assert here.viscous is not None and there.viscous is not None
    close = 1e-3 if dtype == torch.float32 else 1e-9
    apart = (there.position.cpu() - here.position).abs().max()
    assert float(apart) < close * DX
    spring = here.viscous[:, :6].abs().max()
    assert float((there.viscous.cpu() - here.viscous).abs().max()) < close * float(spring)
    assert float((there.stress.cpu() - here.stress).abs().max()) < close * float(
        here.stress.abs().max()
    )
    assert there.counters()["plastic"] == pytest.approx(here.counters()["plastic"], rel=0.01)


@pytest.mark.parametrize("track", [False, True])
@pytest.mark.parametrize("device", DEVICES)
def test_the_solver_keeps_order_and_goes_back(device: str, track: bool) -> None:
    cube, start = relaxing_cube(NACC, torch.float32, device)
    n = start.shape[0]
    if track:
        cube["deformation"] = torch.eye(3, device=device).expand(n, 3, 3).contiguous()
    settings = {"dx": DX, "gravity": (0.0, 0.0, 0.0)}
    solver = ops.Solver(**cube, **settings, viscous=start)
    saved = solver.snapshot()
    solver.advance(0.02)
    found, where = solver.viscous, solver.position
    solver.restore(saved)
    solver.advance(0.02)
    assert found is not None and torch.equal(found, solver.viscous)
    order = torch.randperm(n, generator=torch.Generator().manual_seed(1)).to(device)
    mixed = {k: v[order] if k not in ("law", "params") else v for k, v in cube.items()}
    other = ops.Solver(**mixed, **settings, viscous=start[order])
    other.advance(0.02)
    assert torch.equal(other.position, where[order])
    assert torch.equal(other.viscous, found[order])
    if not track:
        assert solver.deformation is None
    else:
        assert torch.equal(other.deformation, solver.deformation[order])
    without = ops.Solver(**cube, **settings)
    assert without.viscous is None
    idle = ops.Solver(**cube, **settings, viscous=torch.zeros_like(start))
    without.advance(0.02), idle.advance(0.02)
    close = 1e-6 if device == "cpu" else 1e-4  # another kernel there, and other roundings
    assert float((without.position - idle.position).abs().max()) < close * DX


@pytest.mark.parametrize("device", DEVICES)
def test_beside_other_laws_a_spring_does_the_same(device: str) -> None:
    cube, start = relaxing_cube(NACC, torch.float64, device)
    alone = stepped(cube, start)
    n, sand = start.shape[0], LAWS["drucker_prager"]
    table = {
        "law": torch.cat([cube["law"], cube["law"].new_tensor([sand])]),
        "params": cube["params"].repeat(2, 1),
    }
    beside = stepped(cube | table, start)  # no point is of sand
    assert float((alone.position - beside.position).abs().max()) < 1e-12
    assert alone.viscous is not None and beside.viscous is not None
    assert float((alone.viscous - beside.viscous).abs().max()) < 1e-12
    row = (torch.arange(n, device=device) < n // 4).to(torch.int32)
    mixed = stepped(cube | table | {"material": row}, start)
    assert mixed.viscous is not None
    assert torch.equal(mixed.viscous[row == 1], start[row == 1])  # sand has no spring
    away = (mixed.viscous - start)[n // 2 :, :6].abs()
    assert float(away.max()) > 1e-4


def test_branches_that_are_none_are_refused() -> None:
    cube = ball(torch.float32, ELASTIC)
    n = cube["position"].shape[0]
    good = branch(0.5, 1.0, n).float()
    for column, value in ((6, -0.1), (6, 1.1), (8, -1.0), (0, math.nan)):
        bad = good.clone()
        bad[3, column] = value
        with pytest.raises(ValueError, match="row 3"):
            ops.Solver(**cube, dx=DX, viscous=bad)
    with pytest.raises(ValueError, match="viscous"):
        ops.Solver(**cube, dx=DX, viscous=good[:5])
    rubber = cube | rows(LAWS["yeoh"], torch.float32)
    with pytest.raises(InputError, match="laws 0 to 4"):
        ops.Solver(**rubber, dx=DX, viscous=good)


@pytest.mark.cuda
def test_a_gpu_steps_by_the_operators() -> None:
    strain, spring, move = some(5, 64, 0.02)
    viscous = branch(0.7, 50.0, 64)
    viscous[:, :6] = spring
    viscous[::2, 8] = 1e-3
    alpha = torch.full((64,), -0.002, dtype=torch.float64)

    def on(device: str) -> tuple[Tensor, ...]:
        e, a, v, m = (t.to(device) for t in (strain, alpha, viscous, move))
        table = {k: t.to(device) for k, t in rows(NACC).items()}
        returned = ops.return_mapping(e, a, m, dt=1e-3, **table)[:3]
        return ops.viscous_step(v, e, a, m, returned, dt=1e-3, **table)

    here, there = on("cpu"), on("cuda")
    for a, b in zip(here, there, strict=True):
        assert torch.allclose(a, b.cpu(), rtol=1e-9, atol=1e-9 * float(a.abs().max()))
