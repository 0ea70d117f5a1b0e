"""Contact problems with known answers (gsfluent.lab.problems.contact), fast sizes."""

from __future__ import annotations

import pytest
import torch

from gsfluent.lab.problems.contact import contact, edges, friction, observer, placement
from gsfluent.lab.world.driver import running_on
from gsfluent.lab.world.registry import Result


def holds(result: Result) -> None:
    assert result.passed, (
        f"{result.quantity}: {result.value:.6g}, wanted {result.reference:.6g} ({result.note})"
    )


@pytest.mark.parametrize("gap", [0.0, 1.0])
def test_pulled_apart_blocks_keep_their_speed(gap: float) -> None:
    holds(contact.pull_apart(gap=gap))


def test_one_velocity_field_glues_what_touches() -> None:
    glued = contact.pull_apart(one_field=True)
    assert not glued.passed and glued.value < 0.5


def test_oblique_frictionless_balls_leave_without_spin() -> None:
    (result,) = contact.oblique_spheres(turns=1)
    holds(result)


def test_one_velocity_field_spins_them() -> None:
    (result,) = contact.oblique_spheres(radius=5.0, turns=1, one_field=True)
    assert not result.passed and result.value > 0.3  # solver.md 3.10: +0.34 to +0.51


def test_an_impact_does_not_depend_on_who_watches_but_on_a_grid_that_stays() -> None:
    holds(observer.moving_observer())
    with running_on("cpu", "ops"):  # their grid does not move along
        assert observer.moving_observer().value > 1.2


def test_head_on_balls_follow_hertz() -> None:
    for result in contact.hertz(6.0, 0.025):
        holds(result)
    *_, nodes = contact.hertz(6.0, 0.025, touch=False)
    *_, transfer = contact.hertz(6.0, 0.025, touch=False, one_field=True)
    assert nodes.value > transfer.value - 0.05  # contact itself takes next to nothing


def test_cubes_that_meet_lose_less_on_a_finer_grid_and_where_points_push() -> None:
    coarse, fine = edges.cubes(3)[0], edges.cubes(5)[0]
    assert 0.84 < coarse < fine - 0.03
    assert edges.cubes(3, touch=False)[0] < coarse - 0.05


@pytest.mark.parametrize("cells", [4, 8])
def test_plates_sink_by_about_a_cell_times_the_strain_and_presses_by_less(cells: int) -> None:
    assert 0.0 < edges.pressed(cells, 0.05, stiffer=0.0) < 0.06
    assert 0.0 < edges.pressed(cells, 0.05) < 0.02


@pytest.mark.parametrize("mu", [0.0, 0.5])
def test_block_slides_down_an_incline(mu: float) -> None:
    holds(friction.slide(mu))


def test_block_slides_in_float32_as_in_float64() -> None:
    holds(friction.slide(0.5, dtype=torch.float32))


def test_block_thrown_along_a_surface_stops() -> None:
    holds(friction.block_stops())


def test_block_rests_on_a_steep_incline_of_high_friction() -> None:
    for result in friction.block_rests():
        holds(result)


def test_a_brittle_impact_is_the_same_to_a_moving_observer() -> None:
    plain, moved = (placement.brittle_impact(3, boost=boost) for boost in (0.0, 0.5))
    assert 0.05 < plain.broken < 0.5 < plain.lost < 1.0
    assert moved.lost == pytest.approx(plain.lost, rel=1e-5)
    assert moved.broken == plain.broken
    turned = placement.brittle_impact(3, shifted=True, turned=True)
    assert turned.lost != plain.lost and turned.lost == pytest.approx(plain.lost, rel=0.1)
