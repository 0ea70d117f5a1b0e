"""Heat and rubber against their closed forms, on the coarser bars of the battery."""

from __future__ import annotations

import math

import pytest

from gsfluent import materials
from gsfluent.lab.problems.elastic import rubber
from gsfluent.lab.problems.heat import melting
from gsfluent.lab.world import registry


def test_conduction_is_of_second_order() -> None:
    coarse, fine = (melting.conduction_error(cells) for cells in (6, 12))
    assert fine < 0.01
    assert math.log2(coarse / fine) == pytest.approx(2.0, abs=0.05)


@pytest.mark.parametrize("cells", [3, 6])
def test_the_front_of_melting_ice_is_where_neumann_says(cells: int) -> None:
    assert melting.stefan_front(cells) == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.5, 0.5), (0.2, 0.7)])
def test_two_half_bars_that_touch_are_as_one(shift: tuple[float, float]) -> None:
    (_, coarse, _), (between, passed, lost) = (melting.half_bars(n, shift) for n in (6, 12))
    assert between == pytest.approx(1.0, abs=1e-3)
    assert passed == pytest.approx(1.0, abs=0.02)
    assert math.log2((1.0 - coarse) / (1.0 - passed)) == pytest.approx(2.0, abs=0.3)
    assert lost < 1e-12


def test_rubber_pulled_by_grips_answers_as_its_law_says() -> None:
    for material in (materials.rubber_band, materials.natural_rubber):
        force, reached = rubber.pulled(material, 1.4)
        assert force == pytest.approx(rubber.tension(material, reached), rel=0.02)
        assert 1.35 < reached < 1.4


def test_they_are_rows_of_the_battery() -> None:
    names = {problem.name for problem in registry.problems("fast")}
    assert {"heat_conduction", "heat_contact", "melting_front", "rubber_in_tension"} <= names
