"""Colliders that push points: where bodies rest, what they keep, how they rub."""

from __future__ import annotations

import math

import pytest
import torch

from gsfluent import ops
from gsfluent.errors import InputError
from gsfluent.lab.problems.contact import edges, floor
from gsfluent.lab.problems.contact.contact import SPACING, bodies
from gsfluent.lab.world.driver import World, running_on
from gsfluent.lab.world.registry import Result
from gsfluent.lab.world.shapes import box
from gsfluent.lab.world.walls import wall

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)]


def holds(result: Result) -> None:
    assert result.passed, f"{result.name}, {result.quantity}: {result.value}"


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("cells", [4, 6])
def test_cube_rests_where_its_points_end(cells: int, device: str) -> None:
    with running_on(device):
        for result in floor.rest(cells):
            holds(result)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("cfl", [0.25, 0.5])
def test_ball_bounces_and_makes_no_energy(cfl: float, device: str) -> None:
    with running_on(device):
        kept, most, booked = floor.bounce(5.0, cfl=cfl)
    assert 0.94 < kept < 1.0  # the transfer's loss is one of each step
    assert most <= 1.0 + 1e-6
    assert booked == pytest.approx(1.0, abs=1e-5)


def test_nodes_that_are_held_keep_less() -> None:
    assert floor.bounce(5.0)[0] > floor.bounce(5.0, surface=None)[0]


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("friction", [0.25, 0.5])
def test_sliding_is_coulombs(friction: float, device: str) -> None:
    with running_on(device):
        for result in floor.slide(friction):
            holds(result)


def _sliding(engine: str, dtype: torch.dtype = torch.float64) -> World:
    points = box((0.13, 0.27, 0.1), (3.0, 3.0, 3.0), SPACING)
    push = torch.tensor([0.05, 0.02, -0.05], dtype=torch.float64)
    floors = [wall(2, 0.0, mode="separate", friction=0.4, velocity=(0.0, 0.03, 0.01), stiffer=1.5)]
    world = bodies(
        [points], [push], colliders=floors, surface=0.5, engine=engine, dtype=dtype, dt=0.3,
        gravity=(0.0, 0.0, -0.002),
    )  # fmt: skip
    return world if engine == "ops" else world.run(steps=40)


@pytest.mark.parametrize("device", DEVICES)
def test_solver_agrees_with_the_reference(device: str) -> None:
    reference = _sliding("ops")
    with running_on(device):
        solver = _sliding("solver")
    moving = reference.scene.colliders
    assert moving is not None
    for _ in range(40):  # the composed operators do not move colliders
        reference.run(steps=1)
        moving[:, 3:6] += 0.3 * moving[:, 10:13]
    assert float((solver.position.cpu() - reference.position).abs().max()) < 1e-9
    assert float((solver.velocity.cpu() - reference.velocity).abs().max()) < 1e-10
    booked = 1e-9 if device == "cpu" else 1e-7  # in whole numbers there
    assert torch.allclose(solver.impulse.cpu(), reference.impulse, rtol=1e-9, atol=booked)
    assert float(solver.impulse[0, 2]) > 0.0


@pytest.mark.parametrize("device", DEVICES)
def test_order_and_threads_change_no_bit(device: str) -> None:
    generator = torch.Generator().manual_seed(1)
    points = box((0.13, 0.27, 0.2), (3.0, 3.0, 3.0), SPACING)
    order = torch.randperm(len(points), generator=generator)
    found = []
    for turn, threads in ((None, 1), (order, 2)):
        before = torch.get_num_threads()
        torch.set_num_threads(threads)
        try:
            world = bodies(
                [points if turn is None else points[turn]],
                [torch.tensor([0.02, 0.0, -0.05], dtype=torch.float64)],
                colliders=[wall(2, 0.0, mode="separate", friction=0.4)], surface=0.5,
                dtype=torch.float32, device=device,
            )  # fmt: skip
            world.run(steps=30)
        finally:
            torch.set_num_threads(before)
        place = world.position.cpu()
        found.append(place if turn is None else place[torch.argsort(turn)])
        assert float(world.impulse[0, 2]) > 0.0
    assert torch.equal(*found)


@pytest.mark.parametrize(
    "row",
    [
        ops.collider_row("sphere", point=(1.5, 1.5, -4.0), radius=4.0),
        ops.collider_row("box", point=(1.5, 1.5, -2.0), extent=(6.0, 6.0, 2.0)),
        ops.collider_row("cylinder", point=(1.5, 1.5, -2.0), radius=6.0, extent=(0.0, 0.0, 2.0)),
    ],
)
@pytest.mark.parametrize("device", DEVICES)
def test_other_shapes_push_points_too(row: torch.Tensor, device: str) -> None:
    points = box((0.03, 0.02, 0.05), (3.0, 3.0, 3.0), SPACING)
    down = torch.tensor([0.0, 0.0, -0.05], dtype=torch.float64)
    world = bodies([points], [down], colliders=[row], surface=0.5, device=device)
    mass, start = float(world.scene.mass.sum()), world.kinetic()
    world.run(120.0)
    assert float(world.momentum()[2]) / mass > 0.6 * 0.05  # it came back
    assert world.kinetic() + world.elastic() <= start * (1.0 + 1e-9)
    given = float(world.impulse[0, 2]) / mass
    assert given == pytest.approx(0.05 + float(world.momentum()[2]) / mass, rel=1e-7)


def test_stiffer_plates_sink_in_less() -> None:
    soft, stiff = (edges.pressed(4, 0.24, stiffer=s) for s in (0.0, 3.0))
    assert 0.0 < stiff < 0.4 * soft


@pytest.mark.parametrize("speed", [0.05, 0.4])
def test_landing_on_a_stiffer_floor_makes_no_energy(speed: float) -> None:
    points = box((0.13, 0.27, 0.4), (4.0, 3.0, 4.0), SPACING)
    world = bodies(
        [points], [torch.tensor([0.01, 0.0, -speed], dtype=torch.float64)],
        colliders=[wall(2, mode="separate", stiffer=3.0)], surface=0.5,
    )  # fmt: skip
    assert floor.largest_energy(world, 40.0) <= 1.0 + 1e-6
    assert float(world.momentum()[2]) > 0.0


def test_a_point_that_starts_inside_by_its_radius_is_not_pushed() -> None:
    points = box((0.0, 0.0, -0.4), (3.0, 3.0, 3.0), SPACING)
    world = bodies(
        [points], [torch.zeros(3, dtype=torch.float64)], surface=-0.4,
        colliders=[wall(2, 0.0, mode="separate")],
    )  # fmt: skip
    world.run(20.0)
    assert world.kinetic() == 0.0


def test_bad_radii_are_refused() -> None:
    points = torch.rand(4, 3, dtype=torch.float64)
    given = dict(
        velocity=torch.zeros(4, 3), mass=torch.ones(4), volume=torch.ones(4), dx=1.0,
        law=torch.zeros(1, dtype=torch.int32), params=torch.ones(1, 8),
    )  # fmt: skip
    with pytest.raises(InputError, match=r"at most 0\.5 dx"):
        ops.Solver(points, radius=torch.full((4,), 0.6), **given)
    with pytest.raises(InputError, match=r"cfl must be at most 0\.5"):
        ops.Solver(points, radius=torch.full((4,), 0.2), cfl=0.6, **given)
    with pytest.raises(ValueError, match="finite"):
        ops.Solver(points, radius=torch.full((4,), math.nan), **given)
    with pytest.raises(ValueError, match="radius"):
        ops.Solver(points, radius=torch.zeros(3), **given)
