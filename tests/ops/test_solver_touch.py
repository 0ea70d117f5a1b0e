"""Bodies whose points push each other: where they touch, what they keep, how they rub."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from gsfluent import ops
from gsfluent.errors import InputError
from gsfluent.lab.problems.contact import touching
from gsfluent.lab.problems.contact.contact import SPACING, bodies
from gsfluent.lab.world.driver import World, running_on
from gsfluent.lab.world.registry import Result
from gsfluent.lab.world.shapes import box
from gsfluent.lab.world.walls import wall
from gsfluent.ops.reference import touch

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)]


def holds(result: Result) -> None:
    assert result.passed, f"{result.name}, {result.quantity}: {result.value}"


@pytest.mark.parametrize("device", DEVICES)
def test_cube_rests_where_the_points_end(device: str) -> None:
    with running_on(device):
        for result in touching.rest(4):
            holds(result)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(
    ("cfl", "flip", "least"), [(0.25, 0.0, 0.9), (0.5, 0.0, 0.94), (0.25, 0.5, 0.94)]
)
def test_balls_bounce_and_make_neither_energy_nor_momentum(
    cfl: float, flip: float, least: float, device: str
) -> None:
    with running_on(device):
        kept, most, drift = touching.head_on(5.0, cfl=cfl, flip=flip)
    assert least < kept < 1.0  # the transfer's loss is one of each step
    assert most <= 1.0 + 1e-6
    assert drift < (1e-6 if device == "cpu" else 1e-5)  # sums of 32-bit numbers there


def test_nodes_that_exchange_impulses_keep_less() -> None:
    assert touching.head_on(4.0)[0] > touching.head_on(4.0, touch=False)[0] + 0.1


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("friction", [0.25, 0.5])
def test_sliding_is_coulombs(friction: float, device: str) -> None:
    with running_on(device):
        holds(touching.slide(friction))


def _pressed(
    device: str,
    dtype: torch.dtype = torch.float64,
    turn: torch.Tensor | None = None,
    **options: Any,
) -> World:
    """Two rough cubes that overlap by a fifth of a cell and move into each other."""
    generator = torch.Generator().manual_seed(2)
    parts = [box((0.1, 0.2, z), (2.0, 2.0, 2.0), SPACING) for z in (0.3, 2.1)]
    parts = [p + 0.1 * torch.rand(p.shape, generator=generator, dtype=p.dtype) for p in parts]
    if turn is not None:
        parts = [p[turn] for p in parts]
    speed = torch.tensor([0.01, 0.02, 0.04], dtype=torch.float64)
    given: dict[str, Any] = dict(dtype=dtype, surface=0.5, touch=True, friction=0.3, device=device)
    return bodies(parts, [speed, -speed], **given, **options)


@pytest.mark.parametrize("device", DEVICES)
def test_solver_agrees_with_the_reference(device: str) -> None:
    given: dict[str, Any] = dict(dtype=torch.float64, surface=0.5, touch=True, dt=0.3, friction=0.0)
    solver, world = (bodies(*_two(), device=place, **given) for place in (device, "cpu"))
    scene = world.scene
    assert scene.radius is not None and scene.body is not None
    density = scene.params[0, 6].expand(len(scene.mass))
    wave = ((scene.params[0, 1] + 4.0 / 3.0 * scene.params[0, 0]) / density).sqrt()
    position, velocity = world.position, world.velocity
    push = touch.touch_push(
        position, velocity, scene.body, scene.radius, scene.volume, density, wave, 1.0, 0.3, 0.3
    )
    assert float(push.norm(dim=1).max()) > 1e-5
    blocks = ops.build_blocks(position, 1.0)
    grid, _ = ops.p2g(
        position, velocity + push / scene.mass[:, None], world.affine, scene.mass, dx=1.0,
        blocks=blocks, body=scene.body, fields=2,
    )  # fmt: skip
    speed = grid[..., :3] / grid[..., 3:].clamp(min=1e-300)
    moved = ops.g2p(
        speed.contiguous(), position, dx=1.0, dt=0.3, blocks=blocks,
        body=scene.body, velocity=velocity,
    )  # fmt: skip
    solver.run(steps=1)
    assert float((solver.velocity.cpu() - moved[1]).abs().max()) < 1e-12
    assert float((solver.position.cpu() - moved[0]).abs().max()) < 1e-12


def _two() -> tuple[list[torch.Tensor], list[torch.Tensor]]:
    """Two cubes that hardly overlap: nodes have nothing to do."""
    parts = [box((0.1, 0.2, z), (2.0, 2.0, 2.0), SPACING) for z in (0.3, 2.27)]
    speed = torch.tensor([0.0, 0.0, 0.01], dtype=torch.float64)
    return parts, [speed, -speed]


@pytest.mark.parametrize("device", DEVICES)
def test_momentum_and_angular_momentum_are_exchanged_only(device: str) -> None:
    world = _pressed(device)
    first = torch.arange(len(world.position)) < len(world.position) // 2
    scale = float(world.scene.mass.sum()) * 0.04
    before = world.momentum(), world.angular_momentum(), world.momentum(first)
    world.run(steps=60)
    assert float((world.momentum(first) - before[2]).norm()) > 0.1 * scale
    bar = 1e-13 if device == "cpu" else 1e-11  # sums of whole numbers there
    assert float((world.momentum() - before[0]).norm()) < bar * scale
    turned = world.angular_momentum() - before[1]
    assert float(turned.norm()) < bar * scale


@pytest.mark.cuda
def test_a_gpu_does_what_a_cpu_does() -> None:
    """Rough bodies that overlap, rub, stand on a floor that pushes them and keep their motion."""
    floors = [wall(2, 0.2, mode="separate", friction=0.3)]
    given = dict(dt=0.3, flip=0.4, colliders=floors, gravity=(0.0, 0.0, -0.002))
    here, there = (_pressed(place, **given).run(steps=40) for place in ("cuda", "cpu"))
    assert float(there.impulse[0, 2]) > 0.0
    for part in ("position", "velocity", "affine", "strain"):
        a, b = getattr(here, part).cpu(), getattr(there, part)
        assert float((a - b).abs().max()) < 1e-9, part
    assert float((here.impulse.cpu() - there.impulse).abs().max()) < 1e-6


@pytest.mark.parametrize("device", DEVICES)
def test_order_and_threads_change_no_bit(device: str) -> None:
    count = len(box((0.0, 0.0, 0.0), (2.0, 2.0, 2.0), SPACING))
    order = torch.randperm(count, generator=torch.Generator().manual_seed(1))
    found = []
    for turn, threads in ((None, 1), (order, 2)):
        before = torch.get_num_threads()
        torch.set_num_threads(threads)
        try:
            world = _pressed(device, torch.float32, turn).run(steps=40)
        finally:
            torch.set_num_threads(before)
        place = world.position.cpu().view(2, count, 3)
        found.append(place if turn is None else place[:, torch.argsort(turn)])
    assert torch.equal(*found)


def _solver(device: str = "cpu", **given: torch.Tensor) -> ops.Solver:
    parts, speed = _two()
    position = torch.cat(parts)
    count = len(position)
    body = (torch.arange(count) >= count // 2).to(torch.int32)
    velocity = torch.where(body[:, None] == 0, speed[0], speed[1]).float()
    ones = torch.ones(count)
    moved = {name: value.to(device) for name, value in given.items()}
    mass = 0.125 * ones.to(device)
    solver = ops.Solver(
        position.to(device), velocity.to(device), mass, mass, dx=1.0, body=body.to(device),
        gravity=(0.0, 0.0, 0.0), law=torch.zeros(1, dtype=torch.int32, device=device),
        params=torch.tensor([[0.4, 0.5, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0]], device=device), **moved,
    )  # fmt: skip
    solver.advance(steps=30)
    return solver


@pytest.mark.parametrize("device", DEVICES)
def test_fields_of_one_object_touch_at_nodes(device: str) -> None:
    radius = torch.full((128,), 0.25)
    plain = _solver(device)
    alike = _solver(device, radius=radius, objects=torch.zeros(2, dtype=torch.int32))
    apart = _solver(device, radius=radius, objects=torch.arange(2, dtype=torch.int32))
    assert torch.equal(plain.velocity, alike.velocity)
    assert not torch.equal(plain.velocity, apart.velocity)


def test_bad_objects_are_refused() -> None:
    with pytest.raises(InputError, match="by their radius, which is missing"):
        _solver(objects=torch.arange(2, dtype=torch.int32))
    with pytest.raises(ValueError, match="objects"):
        _solver(radius=torch.full((128,), 0.25), objects=torch.arange(3, dtype=torch.int32))


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("ranks", [1, 2])
def test_bodies_lose_what_rebound_says(ranks: int, device: str) -> None:
    """Two cubes that start pressed into each other part more slowly."""
    if device == "cuda" and ranks > 1:
        pytest.skip("several ranks of one GPU are tested elsewhere")
    apart = []
    for share in (1.0, 0.25):
        cube = box((0.25, 0.25, 0.25), (3.0, 3.0, 3.0), SPACING).double()
        place = torch.cat([cube, cube + torch.tensor([2.9, 0.0, 0.0], dtype=torch.float64)])
        count = len(place)
        one = torch.ones(count, dtype=torch.float64)
        made = ops.Solver(
            place.to(device), torch.zeros(count, 3, dtype=torch.float64, device=device),
            (0.125 * one).to(device), (0.125 * one).to(device), dx=1.0,
            law=torch.zeros(1, dtype=torch.int32, device=device),
            params=torch.tensor(
                [[0.4, 0.6, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0]], dtype=torch.float64, device=device
            ),
            body=(torch.arange(count) >= len(cube)).int().to(device), gravity=(0.0, 0.0, 0.0),
            radius=(0.25 * one).to(device), rebound=(share * one).to(device),
            objects=torch.arange(2, dtype=torch.int32, device=device), ranks=ranks,
        )  # fmt: skip
        made.advance(steps=60)
        speed = made.velocity.cpu()[:, 0]
        apart.append(float(speed[len(cube) :].mean() - speed[: len(cube)].mean()))
    assert apart[0] > 0.01
    assert 0.3 < apart[1] / apart[0] < 0.95


def test_pieces_of_one_object_on_several_ranks() -> None:
    one, two = (_pieces(ranks) for ranks in (1, 2))
    assert torch.equal(one.position, two.position)


def _pieces(ranks: int) -> ops.Solver:
    cube = box((0.25, 0.25, 0.25), (4.0, 4.0, 4.0), SPACING).double()
    place = torch.cat([cube, cube + torch.tensor([4.2, 0.0, 0.0], dtype=torch.float64)])
    one = torch.ones(len(place), dtype=torch.float64)
    made = ops.Solver(
        place, torch.zeros_like(place), 0.125 * one, 0.125 * one, dx=1.0,
        law=torch.zeros(1, dtype=torch.int32), body=(torch.arange(len(place)) >= len(cube)).int(),
        params=torch.tensor([[0.4, 0.6, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0]], dtype=torch.float64),
        radius=0.25 * one, objects=torch.zeros(2, dtype=torch.int32), ranks=ranks,
        gravity=(0.0, 0.0, 0.0),
    )  # fmt: skip
    made.advance(steps=20)
    return made
