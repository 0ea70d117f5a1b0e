"""What a plan foresees, against closed forms and against runs; bounds; the time budget."""

from __future__ import annotations

import math

import pytest
from simulation_scenes import SOFT, at
from simulation_shapes import ellipsoid

from gsfluent import materials
from gsfluent.errors import InputError
from gsfluent.pipeline.simulate.groups import LANDING
from gsfluent.pipeline.simulate.stage import Simulate
from gsfluent.plan.bounds import (
    PIECE_CELLS,
    THIN_CELLS,
    bounds_of,
    budget_spacing,
    choose_cells,
    fragment_size,
    thickness,
)
from gsfluent.plan.motion import foresee
from gsfluent.scene.scene import Scene

APPLE = materials.fruit.apple.override(variation=0.0)
DX = 0.01


def dropped(height: float, material: materials.Material = SOFT) -> Scene:
    scene = Scene()
    scene.add(ellipsoid((0.05,) * 3), material, frame=at(0, 0, 0.05))
    scene.drop(height)
    return scene


def counts(scene: Scene, dx: float = DX) -> list[int]:
    return [round(8 * body.volume / dx**3) for body in scene.bodies]


def test_a_fall_ends_when_the_parabola_says() -> None:
    height = 0.5
    seen = foresee(dropped(height), DX, 1.0, 30, [4000])
    lands = math.sqrt(2.0 * (height - LANDING * DX) / 9.81)
    assert seen.grid_from == pytest.approx(lands, abs=1e-4)
    assert seen.strike_speed == pytest.approx(math.sqrt(2.0 * 9.81 * height), rel=0.01)


def test_what_nothing_touches_needs_no_grid() -> None:
    seen = foresee(dropped(5.0), DX, 0.5, 15, [4000])
    assert (seen.substeps, seen.grid_seconds, seen.blocks) == (0, 0.0, 0.0)


@pytest.mark.parametrize("height", [0.0, 0.06])
def test_steps_points_and_blocks_are_those_of_the_run(height: float) -> None:
    scene = dropped(height)
    frames, fps = 10, 60.0
    seen = foresee(scene, DX, (frames - 1) / fps, frames, counts(scene))
    simulation = Simulate(dx=DX, splats=False)(dropped(height), fps=fps, seconds=frames / fps)
    for _ in simulation:
        pass
    report = simulation.report
    assert sum(counts(scene)) == pytest.approx(report["particles"], rel=0.03)
    assert seen.substeps == pytest.approx(report["substeps"], rel=0.1)
    assert seen.grid_from == pytest.approx(report["skipped"]["free_flight_seconds"], abs=0.01)
    assert seen.blocks == pytest.approx(report["active_blocks_mean"], rel=0.3)


def test_two_that_meet_are_on_the_grid_when_they_do() -> None:
    scene = Scene(floor=None, gravity=(0, 0, 0))
    for side in (-1.0, 1.0):
        scene.add(ellipsoid((0.05,) * 3), SOFT, frame=at(0.2 * side, 0, 0),
                  velocity=(-2.0 * side, 0, 0))  # fmt: skip
    seen = foresee(scene, DX, 0.2, 20, counts(scene))
    # 0.3 m between them less the reach, at 4 m/s
    assert seen.grid_from == pytest.approx((0.3 - LANDING * DX) / 4.0, abs=2e-3)
    assert seen.strike_speed == pytest.approx(4.0)


def test_a_bullet_shortens_the_step_and_is_slowed_by_what_it_goes_through() -> None:
    def struck(density: float) -> float:
        scene = Scene()
        scene.add(ellipsoid((0.05,) * 3), APPLE, frame=at(0, 0, 0.05))
        scene.bullet((-0.2, 0, 0.05), (0, 0, 0.05), 100.0, radius=0.01, density=density, rigid=True)
        return foresee(scene, DX, 0.01, 10, [4000]).speed

    light, heavy = struck(1e3), struck(1e5)
    assert 5.0 < light < heavy <= 100.0
    assert heavy > 95.0


def test_only_what_breaks_flies_apart() -> None:
    # wave speed times failure strain: half of that does not break it, ten times does
    limit = APPLE.wave_speed * APPLE.failure_strain
    blocks = []
    for speed in (0.5 * limit, 10.0 * limit):
        scene = Scene()
        scene.add(ellipsoid((0.05,) * 3), APPLE, frame=at(0, 0, 0.05), velocity=(0, 0, -speed))
        seen = foresee(scene, DX, 0.5, 20, counts(scene), blocks=[100.0])
        blocks.append(seen.blocks)
    assert blocks[0] == pytest.approx(100.0) and blocks[1] > 150.0


def test_a_blade_parts_what_it_cuts_once_it_is_at_work() -> None:
    scene = Scene()
    scene.add(ellipsoid((0.05,) * 3), APPLE, frame=at(0, 0, 0.05))
    scene.add_event({"type": "blade", "path": [[0, 0, 0.2], [0, 0, -0.05]], "width": 0.2,
                     "speed": 1.0, "at": 0.1})  # fmt: skip
    assert foresee(scene, DX, 1.0, 30, [4000]).shatters
    assert not foresee(scene, DX, 0.05, 2, [4000]).shatters


# --- bounds ---


def slab(material: materials.Material, half: float = 0.01) -> Scene:
    scene = Scene()
    scene.add(ellipsoid((0.1, 0.1, half), voxels=64), material, frame=at(0, 0, half))
    return scene


def test_a_thin_slab_is_bound_by_its_thickness() -> None:
    body = slab(SOFT).bodies[0]
    assert 0.004 < thickness(body) <= 0.02
    bounds, binding = bounds_of([body], 0.02, strike=0.0)
    assert binding == "thinnest part" and not bounds[0].kept
    assert bounds[0].dx == pytest.approx(thickness(body) / THIN_CELLS)


def test_a_hard_strike_is_bound_by_the_size_of_pieces() -> None:
    body = dropped(0.0, APPLE).bodies[0]
    limit = APPLE.wave_speed * APPLE.failure_strain
    assert fragment_size(body, 0.9 * limit) is None
    size = body.volume ** (1 / 3)
    assert fragment_size(body, 8.0 * limit) == pytest.approx(size / 4.0)
    bounds, binding = bounds_of([body], 0.001, strike=1000.0 * limit)
    assert binding == "fragment size"
    assert bounds[0].dx == pytest.approx(size / 100.0 / PIECE_CELLS)


def test_a_grain_is_a_damage_length() -> None:
    body = dropped(0.0, materials.fruit.apple.override(variation=0.2, grain=0.003)).bodies[0]
    bounds, binding = bounds_of([body], 0.002, strike=0.0)
    assert binding == "damage length" and bounds[0].dx == pytest.approx(0.001)


def test_the_budget_binds_where_it_allows_less_than_the_others_ask_for() -> None:
    body = slab(SOFT).bodies[0]
    fine = thickness(body) / THIN_CELLS
    assert bounds_of([body], 2 * fine, strike=0.0, budget=2 * fine)[1] == "time budget"
    assert bounds_of([body], 0.5 * fine, strike=0.0, budget=0.5 * fine)[1] == "thinnest part"


def test_the_budget_formula_is_that_of_the_specification() -> None:
    """solver.md, section 6, row 8: 0.4 m melon, c 50 m/s, tau 0.15 ns, 33 ms: 8 mm."""
    volume = math.pi / 6 * 0.4**3
    dx = budget_spacing(
        volume, wave=50.0, frame=1 / 30, seconds=0.033, per_point_step=0.15e-9, cfl=0.5
    )
    assert dx == pytest.approx(0.008, rel=0.05)
    twice = budget_spacing(
        volume, wave=50.0, frame=1 / 30, seconds=2 * 0.033, per_point_step=0.15e-9, cfl=0.5
    )
    assert dx / twice == pytest.approx(2**0.25)
    with pytest.raises(ValueError, match="volume must be positive"):
        budget_spacing(0.0, wave=1.0, frame=1.0, seconds=1.0, per_point_step=1.0)


def test_cells_are_the_most_that_keep_to_the_budget() -> None:
    def cost(cells: int) -> float:
        return 1e-6 * cells**4

    for budget in (0.01, 1.0, 50.0):
        cells = choose_cells(cost, budget)
        assert cost(cells) <= budget < cost(cells + 1)
    with pytest.raises(InputError, match="even 8 cells take"):
        choose_cells(cost, 1e-4)


def test_a_ball_is_as_thick_as_it_is_wide() -> None:
    assert thickness(dropped(0.0).bodies[0]) == pytest.approx(0.1, rel=0.25)
