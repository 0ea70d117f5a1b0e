"""World and the registry: what every problem with a known answer relies on."""

from __future__ import annotations

import types

import pytest
import torch

from gsfluent.lab.world import registry
from gsfluent.lab.world.driver import World, running_on
from gsfluent.lab.world.registry import Result, compare
from gsfluent.lab.world.shapes import ball, box, parameters, rotation

STEEL = parameters(1e5, 0.3, 1000.0)


def cube(**changes: object) -> World:
    given: dict[str, object] = {
        "mass": 1e-3,
        "volume": 1e-6,
        "dx": 0.02,
        "law": 0,
        "params": STEEL,
    }
    points = box([0.03, 0.01, 0.05], [0.08, 0.06, 0.04], 0.01)
    return World(points, [0.3, -0.2, 0.1], **{**given, **changes})  # type: ignore[arg-type]


@pytest.mark.parametrize("engine", ["solver", "ops"])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_a_run_ends_exactly_on_time_and_keeps_momentum(dtype: torch.dtype, engine: str) -> None:
    world = cube(dtype=dtype, engine=engine)
    assert world.engine == engine
    before = world.momentum()
    calls = []
    world.run(0.0123, each=lambda w: calls.append(w.time))
    assert world.time == 0.0123 == calls[-1] and len(calls) == world.steps > 5
    bound = 1e-14 if dtype == torch.float64 else 1e-6
    assert torch.allclose(world.momentum(), before, rtol=bound, atol=0.0)
    assert world.velocity.dtype == dtype


def test_a_fixed_step_is_kept_and_the_force_acts_once_a_step() -> None:
    def pull(world: World, dt: float) -> None:
        world.velocity = world.velocity + dt * torch.tensor([0.0, 0.0, 2.0], dtype=torch.float64)

    world = cube(dt=1e-4, force=pull).run(steps=20)
    assert world.steps == 20 and world.time == pytest.approx(2e-3)
    assert float(world.velocity[:, 2].mean()) == pytest.approx(0.1 + 2.0 * 2e-3, rel=1e-12)


def test_a_periodic_axis_has_no_end() -> None:
    # a bar that fills the period is a ring: it moves through the seam without noticing it
    points = box([0.0, 0.03, 0.03], [0.16, 0.02, 0.02], 0.01)
    given = {"mass": 1e-3, "volume": 1e-6, "dx": 0.02, "law": 0, "params": STEEL}
    world = World(points, [1.0, 0.0, 0.0], period=(0.16, None, None), **given)
    world.run(0.1)
    assert world.elastic() < 1e-20 and float(world.position[:, 0].max()) < 0.16
    # a shear wave set up across the seam stays the same under a shift along the ring
    runs = []
    for shift in (0.0, 0.06):
        wave = torch.zeros_like(points)
        wave[:, 1] = 0.01 * torch.sin(2 * torch.pi * (points[:, 0] - shift) / 0.16)
        runs.append(World(points, wave, period=(0.16, None, None), dt=5e-4, **given).run(steps=40))
    moved = runs[0].velocity.reshape(16, -1).roll(6, 0).reshape(-1, 3)
    assert float((moved - runs[1].velocity).abs().max()) < 1e-14


def test_energy_and_angular_momentum_of_a_rigid_rotation() -> None:
    points = ball([0.0, 0.0, 0.0], 0.05, 0.01)
    spin = torch.tensor([0.3, -1.0, 2.0], dtype=torch.float64)
    cross = torch.tensor([[0, -2.0, -1.0], [2.0, 0, -0.3], [1.0, 0.3, 0]], dtype=torch.float64)
    world = World(
        points, points @ cross.T, affine=cross.expand(552, 3, 3).clone(), mass=1e-3,
        volume=1e-6, dx=0.02, law=0, params=STEEL,
    )  # fmt: skip
    # point masses plus a spread of dx^2 / 4 on every axis
    inertia = 1e-3 * float((points**2).sum()) * 2.0 / 3.0 + 552e-3 * 2.0 * 0.02**2 / 4.0
    assert torch.allclose(world.angular_momentum(), inertia * spin, rtol=1e-3)
    assert world.kinetic() == pytest.approx(0.5 * inertia * float(spin @ spin), rel=1e-3)
    assert world.elastic() == 0.0


def test_a_strained_body_starts_with_its_stress_and_energy() -> None:
    stretch = rotation([1.0, 2.0, 3.0], 0.4) @ torch.diag(
        torch.tensor([1.01, 0.99, 1.0], dtype=torch.float64)
    )
    b = stretch @ stretch.T - torch.eye(3, dtype=torch.float64)
    e = b.reshape(9)[[0, 4, 8, 1, 2, 5]]
    world = cube(strain=e, deformation=True)
    assert float(world.stress.abs().max()) > 100.0 and world.elastic() > 0.0
    energy = world.elastic() + world.kinetic()
    world.run(steps=30)
    assert world.kinetic() + world.elastic() <= energy
    assert world.deformation is not None and world.deformation.shape == (192, 3, 3)


def test_bad_requests_are_refused() -> None:
    with pytest.raises(ValueError, match="dt must be positive"):
        cube(dt=0.0)
    with pytest.raises(ValueError, match="whole number of dx"):
        cube(period=(0.03, None, None))
    with pytest.raises(ValueError, match="either seconds or steps"):
        cube().run()
    with pytest.raises(ValueError, match="a force changes velocities"):
        cube(engine="solver", force=lambda world, dt: None)
    with pytest.raises(ValueError, match="outside the solver"):
        cube().velocity = torch.zeros(192, 3)
    broken = cube(dt=1e-4, engine="ops")
    broken.velocity = broken.velocity * float("nan")
    with pytest.raises((FloatingPointError, ValueError)):
        broken.run(steps=2)


def test_both_engines_do_the_same_and_the_default_is_the_solver_where_it_can() -> None:
    assert cube().engine == "solver" and cube(force=lambda world, dt: None).engine == "ops"
    with running_on("cpu", "ops"):
        assert cube().engine == "ops"
    floor = torch.zeros(1, 16, dtype=torch.float64)
    floor[0, 1], floor[0, 2], floor[0, 5], floor[0, 8] = 2.0, 0.4, 0.045, 1.0
    body = (torch.arange(192) % 4 >= 2).to(torch.int32)
    ends = [
        cube(
            engine=engine, gravity=(0.0, 0.0, -9.81), colliders=floor, body=body, friction=0.2,
            deformation=True, dt=4e-4,
        ).run(steps=60)
        for engine in ("solver", "ops")
    ]  # fmt: skip
    for name in ("position", "velocity", "affine", "strain", "stress", "impulse", "deformation"):
        a, b = (getattr(world, name).double() for world in ends)
        assert float((a - b).abs().max()) <= 1e-9 * float(b.abs().max()), name
    assert ends[0].time == pytest.approx(ends[1].time) and ends[0].steps == ends[1].steps


def test_a_result_is_judged_by_its_error() -> None:
    assert compare("q", 1.02, 1.0, tolerance=0.03).passed
    assert not compare("q", 1.04, 1.0, tolerance=0.03).passed
    assert not compare("q", float("nan"), 1.0, tolerance=0.03).passed
    assert compare("q", 1e-4, tolerance=1e-3).passed
    assert not compare("q", 1e-4, 0.0, tolerance=1e-3).passed


def test_problems_are_found_by_name_and_tier(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "_PROBLEMS", {})

    @registry.problem(tier="fast")
    def fall() -> Result:
        """A fall.

        More."""
        return Result("fall", "height", 1.0, 1.0, 0.0, 0.1)

    @registry.problem(tier="slow")
    def rise() -> list[Result]:
        return [Result("rise", "height", 1.0, 2.0, 0.5, 0.1)] * 2

    assert [p.name for p in registry.problems()] == ["fall", "rise"]
    assert [p.name for p in registry.problems("slow")] == ["rise"]
    assert registry.problems(only="al")[0].summary == "A fall"
    assert len(registry.run(registry.problems("slow")[0])) == 2
    with pytest.raises(ValueError, match="tier"):
        registry.problem(tier="medium")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="already a problem"):
        other = types.FunctionType(fall.__code__, globals(), "fall")
        other.__module__ = "elsewhere"
        registry.problem(tier="fast")(other)


def test_every_module_of_the_lab_registers_under_names_of_its_own() -> None:
    registry.discover()
    found = registry.problems()
    assert {"projectile", "pull_apart", "taylor_bar"} <= {p.name for p in found}
    assert all(p.summary != p.name for p in found)  # the table says what each one is
