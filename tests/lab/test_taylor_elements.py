"""Finite elements of Taylor bars against what is known, and how the solver's bars are read."""

from __future__ import annotations

import math

import numpy as np
import pytest

from gsfluent.lab.problems.flow import metal
from gsfluent.lab.problems.flow.elements import Bar, Metal, Numbers

RADIUS, LENGTH = 1e-3, 20e-3


def never(strain: Numbers, rate: Numbers, work: Numbers) -> Numbers:
    return np.full_like(strain, 1e30)


def test_elastic_bar_comes_back_when_its_wave_does() -> None:
    """Saint-Venant: the contact lasts 2 L / c, and the bar leaves as fast as it came."""
    bar = Bar(Metal(100e9, 0.0, 10000.0, never), RADIUS, LENGTH, 10.0, across=3)
    start, energy, wave = bar.momentum(), bar.energy(), math.sqrt(100e9 / 10000.0)
    bar.run(LENGTH / wave)
    assert abs(bar.momentum()) < 0.03 * abs(start)  # it stands
    assert bar.energy() < 0.1 * energy
    bar.run(1.3 * LENGTH / wave)
    assert bar.momentum() == pytest.approx(-start, rel=0.03)
    assert 0.9 * energy < bar.energy() <= energy * (1.0 + 1e-9)


def test_mass_is_that_of_the_bar() -> None:
    bar = Bar(Metal(100e9, 0.3, 10000.0, never), RADIUS, LENGTH, 10.0, across=3)
    bar.v[..., 1] = 1.0
    assert bar.momentum() == pytest.approx(10000.0 * math.pi * RADIUS**2 * LENGTH, rel=1e-12)


def test_elements_meet_the_bar_that_was_recovered() -> None:
    fitted = Metal(117e9, 0.35, 8930.0, metal.fitted_flow)
    bar = Bar(fitted, metal.ANNEALED.radius, metal.ANNEALED.length, 190.0, across=4)
    bar.run(80e-6)
    length, foot, bulge = bar.measures()
    assert length * 1e3 == pytest.approx(metal.RECOVERED[190.0][0], rel=0.01)
    assert 2e3 * foot == pytest.approx(metal.FOOT, rel=0.03)
    assert 2e3 * bulge == pytest.approx(metal.RECOVERED[190.0][1], rel=0.02)


@pytest.mark.parametrize("cells", [3, 4])
def test_a_bar_at_rest_is_read_as_wide_as_it_is(cells: int) -> None:
    bar = metal.impact(1e-3, metal.ANNEALED, metal.fitted_copper(), cells=cells, seconds=1e-9)
    assert bar.foot == pytest.approx(metal.ANNEALED.radius, rel=1e-6)
    assert bar.bulge == pytest.approx(metal.ANNEALED.radius, rel=1e-6)
    assert bar.length == pytest.approx(bar.start, rel=1e-6)
