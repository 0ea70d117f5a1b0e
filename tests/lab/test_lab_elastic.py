"""Transfers, waves, statics and beams: the fast problems, and the wrong ways that must fail."""

from __future__ import annotations

import math

import pytest
import torch

from gsfluent.lab.problems.contact import discs
from gsfluent.lab.problems.elastic import axes, beams, driven, statics, transfer, vortex, waves
from gsfluent.lab.world import registry
from gsfluent.lab.world.driver import World, running_on
from gsfluent.lab.world.shapes import ball, parameters

FAST = [
    p.name
    for p in registry.problems("fast")
    if p.function.__module__
    in {m.__name__ for m in (axes, transfer, waves, statics, beams, driven, discs, vortex)}
]


@pytest.mark.parametrize("name", FAST)
def test_fast_problems_meet_their_tolerances(name: str) -> None:
    (problem,) = [p for p in registry.problems("fast", name) if p.name == name]
    results = registry.run(problem)
    assert results
    missed = [f"{r.quantity}: {r.value:g} for {r.reference:g}" for r in results if not r.passed]
    assert missed == []


def test_a_thin_rod_twists_by_its_own_inertia_or_by_that_of_the_mass_that_the_grid_spreads() -> (
    None
):
    own, spread = beams.torsion()
    assert own.passed and spread.passed and spread.value < 0.96 * own.value


def test_the_composed_ops_fail_where_absolute_float32_positions_must() -> None:
    # why the solver keeps a position as cell and offset
    with running_on("cpu", "ops"):
        far, crept = transfer.far_from_origin()
    assert not far.passed and not crept.passed and crept.value == 0.0


def test_particles_in_cell_without_the_affine_part_lose_their_spin() -> None:
    def forget(world: World, dt: float) -> None:
        world.affine = torch.zeros_like(world.affine)

    points = ball([0.0, 0.0, 0.0], 0.05, 0.01)
    turn = torch.zeros(3, 3, dtype=torch.float64)
    turn[0, 1], turn[1, 0] = -4.0, 4.0
    world = World(
        points, points @ turn.T, mass=1e-3, volume=1e-6, dx=0.02, law=0,
        params=parameters(1e5, 0.3, 1000.0), force=forget,
    )  # fmt: skip
    before = float(world.angular_momentum()[2])
    world.run(steps=100)
    assert float(world.angular_momentum()[2]) < 0.2 * before  # APIC: 1e-15 of it


def test_a_body_tears_where_its_points_are_drawn_further_apart_than_a_cell() -> None:
    # numerical fracture: shear 3 at two points per cell and axis; with four it holds (0.075 there)
    torn, _ = vortex.Vortex(0.5, 1.0).run(16, 1.0, per_cell=2)
    assert torn / 0.5 > 0.15
    whole, _ = vortex.Vortex(0.5, 1.0).run(12, 1.0, per_cell=4)
    assert whole / 0.5 < 0.1


def test_the_wave_loses_its_amplitude_by_the_step_and_not_by_the_second() -> None:
    coarse, fine = (waves.run_wave(16, 5.0, cfl) for cfl in (0.2, 0.05))
    assert fine.steps == 4 * coarse.steps
    assert fine.loss == pytest.approx(coarse.loss, rel=0.2)


def test_the_elastica_agrees_with_the_table_of_elliptic_integrals() -> None:
    # Bisshopp and Drucker 1945, as quoted in solver.md 3, row 13
    for load, across in ((1.0, 0.302), (2.0, 0.494), (5.0, 0.714), (10.0, 0.811)):
        assert beams.elastica(load)[0] == pytest.approx(across, abs=1e-3)
    assert beams.elastica(1e-3)[0] == pytest.approx(1e-3 / 3.0, rel=1e-4)


def test_the_vortex_moves_as_its_velocity_says_and_turns_only_inside() -> None:
    scene = vortex.Vortex(0.7, 2.0)
    points = torch.tensor([[0.9, 0.1, 0.0], [0.5, -0.9, 0.2], [0.3, 0.2, 0.0], [1.3, 0.4, 0.0]])
    points = points.double()
    step = 1e-6
    v, gradient = scene.velocity(points)
    moved = (scene.place(points, step) - scene.place(points, -step)) / (2.0 * step)
    assert torch.allclose(moved, v, atol=1e-9)
    assert float(v[2:].abs().max()) == 0.0
    for axis in range(3):
        shift = torch.zeros(3, dtype=torch.float64)
        shift[axis] = step
        slope = (scene.velocity(points + shift)[0] - scene.velocity(points - shift)[0]) / (2 * step)
        assert torch.allclose(slope, gradient[:, :, axis], atol=1e-6)


def test_a_plate_acts_behind_its_last_held_node() -> None:
    # the solution of the static equations next to held nodes: c(i) = i + FACE - FACE r^i
    r = -2.0 + math.sqrt(3.0)
    c = {i: i + statics.FACE - statics.FACE * r**i for i in range(0, 8)} | {-1: 0.0}
    assert abs(c[0]) < 1e-15 and abs(-1.0 + statics.FACE - statics.FACE / r) < 1e-15
    for i in (1, 2, 5):
        rest = c[i] - (c[i - 1] + c[i + 1]) / 3.0 - (c[i - 2] + c[i + 2]) / 6.0
        assert abs(rest) < 1e-14


def test_lateral_stretch_is_poissons_at_small_strain() -> None:
    assert statics.lateral_stretch(1e5, 0.3, 1.0001) - 1.0 == pytest.approx(-0.3e-4, rel=1e-3)
    assert statics.lateral_stretch(1e5, 0.0, 1.0) == pytest.approx(1.0, abs=1e-12)
