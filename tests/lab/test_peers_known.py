"""Named points of released solvers: the textbook variant with their choices shows the failure."""

from __future__ import annotations

import math

import pytest

from gsfluent.lab.peers.known import POINTS, Known, courant, find


@pytest.mark.parametrize("point", POINTS, ids=lambda p: p.name)
def test_a_named_point_fails_as_it_is_said_to(point: Known) -> None:
    """Or does not, where the point says so; without the fault it never does."""
    value = point.measure(point.variant, point.parameters)
    assert point.failing(value) == point.shown, value
    sound = point.measure(point.sound, point.parameters)
    assert not point.failing(sound), sound
    if point.reported is not None:  # the same quantity as theirs: it is their figure as well
        near = 0.25 if point.name == "one field" else 0.03  # blocks of other sizes
        assert math.isclose(value, point.reported, abs_tol=near), value


def test_courant_numbers_of_physgaussians_demos() -> None:
    """Solver.md 0.3: 0.366, 0.110, 0.367, 0.028, 0.070, 0.013, and 0.62 in a part of the ficus."""
    names = ("ficus", "vasedeck", "wolf", "tear_bread", "plane", "pillow2sofa")
    wanted = (0.366, 0.110, 0.367, 0.028, 0.070, 0.013)
    for name, number in zip(names, wanted, strict=True):
        found = find(f"PhysGaussian {name}").parameters["courant"]
        assert found == pytest.approx(number, abs=6e-4)
    assert courant(2e6, 0.4, 70.0, 1e-4, 0.04) == pytest.approx(0.62, abs=0.005)


def test_an_unknown_point_is_refused() -> None:
    with pytest.raises(ValueError, match="no point"):
        find("nobody")
