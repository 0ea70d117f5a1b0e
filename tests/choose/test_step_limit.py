"""How long a step loose pieces bear, and that `error:` offers no longer one."""

from __future__ import annotations

import math

import pytest
from simulation_shapes import ellipsoid

from gsfluent import materials
from gsfluent.choose.choose import loose_limit, safe_steps
from gsfluent.materials import Material
from gsfluent.scene.scene import Scene


def scene(*matter: Material) -> Scene:
    made = Scene()
    for one in matter:
        made.add(ellipsoid(), one)
    return made


def test_the_limit_is_that_of_the_bulk_wave_alone() -> None:
    for nu in (0.0, 0.3, 0.45, 0.495):
        bulk_over_pressure_wave = (1.0 + nu) / (3.0 * (1.0 - nu))  # K / (rho c^2)
        assert loose_limit(nu) == pytest.approx(1.0 / math.sqrt(3.0 * bulk_over_pressure_wave))
    assert loose_limit(0.495) > 0.5 * 1.15  # the default step, for any matter that can be made


def test_steps_that_loose_pieces_would_not_bear_are_left_out() -> None:
    brittle = materials.get("fruit.apple")
    assert brittle.law == "nacc"
    soft, stiff = (brittle.override(poisson_ratio=nu) for nu in (0.25, 0.4))
    assert safe_steps(scene(soft), (0.7,)) == (0.7,)
    assert safe_steps(scene(stiff), (0.5, 0.6, 0.7)) == (0.5, 0.6)
    assert safe_steps(scene(soft, stiff), (0.7,)) == ()
    assert safe_steps(scene(materials.get("rubber")), (0.7,)) == (0.7,)  # it stays in one piece
