"""Velocity fields of pieces: what hangs together, how many may meet, and no welding."""

from __future__ import annotations

import itertools
import math

import pytest
import torch
from simulation_scenes import SOFT, at
from simulation_shapes import ellipsoid
from torch import Tensor

from gsfluent import materials
from gsfluent.data import Frame
from gsfluent.pipeline.matter.fields import breakable, number_fields
from gsfluent.pipeline.matter.fragments import rest_links
from gsfluent.pipeline.matter.pieces import Pieces, Web, find_pieces
from gsfluent.pipeline.matter.points import Matter, build_matter
from gsfluent.pipeline.simulate.engine import SolverOptions
from gsfluent.pipeline.simulate.run import Run
from gsfluent.scene.scene import Scene

DX = 0.02
APPLE = materials.fruit.apple.override(variation=0.0)


def fields_per_block(field: Tensor, position: Tensor) -> int:
    """Most fields that can reach one block of 4^3 nodes, by brute force."""
    block = torch.floor(position / (4 * DX) - 0.125).long()
    there: dict[tuple[int, ...], set[int]] = {}
    for place, number in zip(block.tolist(), field.tolist(), strict=True):
        for step in itertools.product((-1, 0, 1), repeat=3):
            key = tuple(a + b for a, b in zip(place, step, strict=True))
            there.setdefault(key, set()).add(number)
    return max(len(s) for s in there.values())


@pytest.mark.parametrize("limit", [2, 5, 16])
def test_no_block_gets_more_fields_than_it_has_room_for(limit: int) -> None:
    generator = torch.Generator().manual_seed(limit)
    position = torch.rand(1500, 3, generator=generator, dtype=torch.float64) * 0.5
    unit = (position / 0.08).long() @ torch.tensor([100, 10, 1]) - 1
    mass = torch.rand(1500, generator=generator)
    everyone = torch.ones(1500, dtype=torch.bool)
    field = number_fields(unit, position, mass, everyone, DX, limit, 1024)
    assert fields_per_block(field, position) <= limit
    assert int(field.max()) + 1 == torch.unique(field).shape[0] > 1
    # Points of one unit share a field, and the heaviest unit has one of its own.
    assert (
        torch.unique(torch.stack([unit, field.long()]), dim=1).shape[1]
        == (torch.unique(unit).shape[0])
    )
    weight = torch.zeros(int(unit.max()) + 2).index_add_(0, unit + 1, mass)
    heaviest = int(weight.argmax()) - 1
    assert torch.equal(field == 0, unit == heaviest)


def test_no_more_fields_than_there_may_be_in_all() -> None:
    position = torch.arange(40, dtype=torch.float64)[:, None] * torch.tensor([[1.0, 0, 0]])
    unit, mass = torch.arange(40), torch.ones(40)
    everyone = torch.ones(40, dtype=torch.bool)
    assert int(number_fields(unit, position, mass, everyone, DX, 16, 8).max()) + 1 == 8
    assert int(number_fields(unit, position, mass, everyone, DX, 16, 1024).max()) + 1 == 40


def split_ball(material: materials.Material) -> tuple[Matter, Tensor, Tensor]:
    """A ball with a broken layer through its middle, the halves 4 cells apart."""
    scene = Scene(floor=None)
    scene.add(ellipsoid(), material, frame=Frame.identity())
    matter = build_matter(scene, DX)
    rest = matter.rest.double()
    broken = rest[:, 0].abs() < DX
    position = rest.clone()
    position[:, 0] += torch.where(rest[:, 0] > 0, 2 * DX, -2 * DX)
    return matter, broken, position


def pieces_of(matter: Matter, broken: Tensor, position: Tensor) -> Pieces:
    links = rest_links(matter.rest, matter.ranges, matter.spacing)
    p = matter.particles
    web = Web(
        links, matter.rest, p.body.long(), torch.tensor(matter.spacing).double(), p.mass,
        matter.of_law("fluid", "drucker_prager"), breakable(matter), torch.tensor([0.5]).double(),
        torch.tensor([False]),
    )  # fmt: skip
    return find_pieces(web, position, broken, torch.zeros(len(links), dtype=torch.bool))


def test_powder_belongs_to_the_piece_it_lies_on() -> None:
    matter, broken, position = split_ball(APPLE)
    found = pieces_of(matter, broken, position)
    right = matter.rest[:, 0] > 0
    assert torch.unique(found.unit).shape[0] == 2 and int(found.unit.min()) >= 0
    assert torch.equal(found.unit, found.fragments.labels.long())
    for half in (right, ~right):
        assert torch.unique(found.unit[half]).shape[0] == 1
    # What has flown off belongs to no piece: the layer hangs together, and is a lump of its own.
    away = position.clone()
    away[broken] += torch.tensor([0.0, 0.0, 0.5])
    found = pieces_of(matter, broken, away)
    assert torch.unique(found.unit[~broken]).shape[0] == 2
    assert not bool(torch.isin(found.unit[broken], found.unit[~broken]).any())


def test_what_cannot_break_stays_one_field() -> None:
    for material in (SOFT, materials.get("water"), materials.get("sand")):
        matter, broken, position = split_ball(material)
        found = pieces_of(matter, torch.zeros_like(broken), position)
        assert torch.unique(found.unit).shape[0] == 1
        flows = material is not SOFT
        assert found.fragments.count == (0 if flows else 1)


@pytest.mark.parametrize("separate", [True, False])
def test_pieces_that_were_pressed_together_come_apart_again(separate: bool) -> None:
    """Two halves move together, then apart: in fields of their own nothing holds them."""
    scene = Scene(floor=None, gravity=(0, 0, 0))
    scene.add(ellipsoid(), APPLE, frame=at(0, 0, 0))
    options = {"free_flight": False, "separate_fragments": separate}
    run = Run(scene, build_matter(scene, DX), 100.0, SolverOptions(**options, max_rollbacks=3))
    rest = run.matter.rest
    right = rest[:, 0] > 0
    # A break without a layer of powder: the halves lie beside each other, the links are cut.
    a, b = run.links.unbind(dim=1)
    run.state = run.state._replace(cut_links=right[a] != right[b])
    speed = torch.where(right, 0.2, -0.2)
    velocity = speed[:, None] * torch.tensor([1.0, 0.0, 0.0])
    state = run.state
    run.state = state._replace(particles=state.particles.replace(velocity=velocity))
    run.watch.energy = float(0.5 * state.particles.mass.sum() * 0.04)
    for frame in range(1, 6):
        assert run.advance_to(frame, None), run.failure
        _, pieces, _ = run.record(frame)
    assert pieces.count == 2
    mass = state.particles.mass
    left_over = float((mass * run.state.particles.velocity[:, 0])[right].sum())
    kept = left_over / float((mass * speed)[right].sum())
    if separate:
        assert kept == pytest.approx(1.0, abs=1e-3)
    else:
        assert not math.isclose(kept, 1.0, abs_tol=0.2)
