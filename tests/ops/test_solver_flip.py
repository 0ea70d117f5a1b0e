"""Points that keep a share of their own motion (FLIP): as composed, and what is conserved."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from gsfluent import ops
from gsfluent.errors import InputError
from gsfluent.lab.problems.contact import placement
from gsfluent.lab.problems.contact.contact import SPACING, YOUNG, bodies
from gsfluent.lab.world.driver import World, running_on
from gsfluent.lab.world.shapes import ball, parameters
from gsfluent.pipeline.simulate.engine import SolverOptions

BRITTLE = parameters(YOUNG, 0.2, 1.0, c2=1.85, c3=0.3, c4=10.0, c5=0.05)
METAL = parameters(YOUNG, 0.2, 1.0, c2=0.01, c4=0.01)
RATE = parameters(YOUNG, 0.2, 1.0, c2=0.01, c4=0.01, c7=0.5, c3=0.02)
MATTER: dict[str, dict[str, Any]] = {
    "elastic": {"law": 0},
    "brittle": {"law": 1, "params": BRITTLE, "deformation": True},
    "metal": {"law": 3, "params": METAL},
    "metal with a rate": {"law": 3, "params": RATE},
    "relaxing": {"law": 0, "viscous": torch.tensor([0.0] * 6 + [0.4, 5.0, 0.0])},
}


DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)]


def impact(dtype: torch.dtype = torch.float64, radius: float = 2.5, **options: Any) -> World:
    """Two balls that meet off the axes, rough where they are brittle."""
    points, away = ball([0.0, 0.0, 0.0], radius, SPACING), torch.tensor([radius + 0.4, 0.2, 0.1])
    parts = [points - away, points + away]
    if options.get("law") == 1:
        draw = torch.rand(2 * len(points), generator=torch.Generator().manual_seed(0))
        options["alpha"] = -0.02 * (0.85 + 0.3 * draw.double())
    speed = torch.tensor([0.1, 0.0, 0.02], dtype=torch.float64)
    return bodies(parts, [speed, -speed], dtype=dtype, **options)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("name", MATTER)
def test_solver_does_what_the_composed_operators_do(name: str, device: str) -> None:
    worlds = []
    for place, engine in ((device, "solver"), ("cpu", "ops")):
        with running_on(place, engine):  # type: ignore[arg-type]
            given = {**MATTER[name], "flip": 0.4, "dt": 0.2}
            worlds.append(impact(frame=(0.0, 0.0, 0.0), **given))
        worlds[-1].run(steps=40)
    have, want = worlds
    assert have.engine == "solver" and want.engine == "ops"
    bar = 1e-11 if device == "cpu" else 1e-9
    for part in ("position", "velocity", "affine", "strain", "alpha", "deformation"):
        a, b = getattr(have, part), getattr(want, part)
        if b is not None:
            assert float((a.cpu() - b).abs().max()) <= bar * (1.0 + float(b.abs().max())), part
    assert float((have.strain**2).sum()) > 0.0


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("share", [0.25, 0.5, 0.9])
def test_momentum_is_kept_and_no_energy_made(share: float, device: str) -> None:
    with running_on(device):
        world = impact(flip=share, cfl=0.5 - 0.5 * share)
    mass, about = world.scene.mass, torch.zeros(3, dtype=torch.float64, device=device)

    def sums() -> tuple[torch.Tensor, torch.Tensor, float]:
        inner = 0.25 * (world.affine**2).sum(dim=(1, 2))
        kinetic = 0.5 * (mass * ((world.velocity**2).sum(dim=1) + inner)).sum()
        momentum = (mass[:, None] * world.velocity).sum(dim=0)
        return momentum, world.angular_momentum(about), float(kinetic) + world.elastic()

    before, spin, energy = sums()
    for _ in range(8):
        world.run(4.0)
        after, turned, now = sums()
        assert float((after - before).abs().max()) < 1e-13 * float(mass.sum())
        assert float((turned - spin).abs().max()) < 1e-12 * float(mass.sum())
        assert now <= energy * (1.0 + 1e-12)
    assert now < 0.95 * energy  # they have met


@pytest.mark.parametrize("device", DEVICES)
def test_order_of_the_points_leaves_no_trace(device: str) -> None:
    given = dict(flip=0.5, cfl=0.25, frame=(0.0, 0.0, 0.0))
    with running_on(device):
        one = impact(torch.float32, **given)
    turn = torch.randperm(len(one.position), generator=torch.Generator().manual_seed(1)).to(device)
    scene = one.scene
    assert scene.body is not None
    two = World(
        one.position[turn], one.velocity[turn], volume=SPACING**3, dx=1.0, law=0,
        params=scene.params, body=scene.body[turn], dtype=torch.float32, **given,
    )  # fmt: skip
    one.run(12.0)
    two.run(12.0)
    for part in ("position", "velocity", "affine", "strain"):
        assert torch.equal(getattr(one, part)[turn], getattr(two, part)), part


@pytest.mark.parametrize("device", DEVICES)
def test_calls_divide_a_run_without_a_trace(device: str) -> None:
    with running_on(device):
        whole, parts = (impact(flip=0.5, dt=0.25) for _ in range(2))
    whole.run(steps=24)
    for _ in range(4):
        parts.run(steps=6)
    bar = 1e-13 if device == "cpu" else 1e-11  # other blocks, other units of the sums
    assert torch.allclose(whole.velocity, parts.velocity, rtol=0.0, atol=bar)
    assert torch.allclose(whole.affine, parts.affine, rtol=0.0, atol=bar)


def test_what_strains_is_the_gradient_at_the_nodes_and_not_what_points_keep() -> None:
    with running_on("cpu", "ops"):
        world = impact(flip=0.5, dt=0.2, deformation=True)
    world.run(steps=20)
    before = world.deformation
    world.run(steps=1)
    assert before is not None and world.deformation is not None
    gradient = world.stepper.gradient
    moved = before + 0.2 * gradient @ before
    assert torch.allclose(world.deformation, moved, rtol=0.0, atol=1e-14)
    assert float((gradient - world.affine).abs().max()) > 1e-4
    with pytest.raises(NotImplementedError, match="gradient with flip"):
        _ = impact(flip=0.5).stepper.gradient


def test_shorter_steps_break_as_much() -> None:
    for result in placement.brittle_steps():
        assert result.passed, f"{result.quantity}: {result.value}"


@pytest.mark.parametrize(("cfl", "flip"), [(0.5, 0.0), (0.8, 0.0), (0.25, 0.5), (0.125, 0.75)])
def test_a_shot_keeps_what_its_courant_number_says(cfl: float, flip: float) -> None:
    assert SolverOptions(cfl=cfl).flip == pytest.approx(flip)


def _solver(**options: Any) -> ops.Solver:
    points, one = torch.tensor([[0.1, 0.1, 0.1]]), torch.ones(1)
    law = torch.tensor([0], dtype=torch.int32)
    given = {"law": law, "params": BRITTLE[None].float(), **options}
    return ops.Solver(points, torch.zeros_like(points), one, one, dx=1.0, **given)


@pytest.mark.parametrize("flip", [-0.1, 1.0, float("nan")])
def test_a_share_is_a_share(flip: float) -> None:
    with pytest.raises(InputError, match=r"flip must lie in \[0, 1\)"):
        _solver(flip=flip)


def test_phase_field_matter_is_refused() -> None:
    params = torch.tensor([[0.4, 0.5, 0.01, 1.0, 1.0, 0.0, 1.0, 0.0]])
    with pytest.raises(InputError, match="phase_field"):
        _solver(flip=0.5, law=torch.tensor([9], dtype=torch.int32), params=params)
