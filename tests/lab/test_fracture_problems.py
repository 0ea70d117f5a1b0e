"""Plastic and fracture problems with known answers (gsfluent.lab), the fast ones."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch

from gsfluent.lab.problems.elastic.paths import breaking_step
from gsfluent.lab.problems.flow import granular, liquid
from gsfluent.lab.problems.fracture import energy, notch, spall
from gsfluent.lab.world import registry
from gsfluent.lab.world.shapes import nacc
from gsfluent.pipeline.matter.crack_band import (
    brittle_spacing,
    crack_band,
    fracture_energy,
    softening_energy,
)

FAST = (
    "bar_energy", "brazilian_disc", "kalthoff_winkler", "liquid_at_rest", "plate_impact_spall",
    "return_map_paths", "single_edge_notch", "softening_bar", "taylor_bar",
)  # fmt: skip


@pytest.mark.parametrize("name", FAST)
def test_fast_problems_meet_their_tolerances(name: str) -> None:
    registry.discover()
    (item,) = [p for p in registry.problems("fast") if p.name == name]
    for result in registry.run(item):
        assert result.passed, (
            f"{result.quantity}: {result.value:.6g}, wanted {result.reference:.6g}"
        )


def test_a_weaker_impact_does_not_spall() -> None:
    plane, strength = spall.plate_impact_spall(over=0.9)
    assert math.isnan(plane.value) and not plane.passed
    # the whole pulse comes out: the face stops, so the "strength" is the impact stress
    assert strength.value == pytest.approx(0.9 * strength.reference, rel=0.05)


def test_peak_of_a_notched_beam_has_the_limits_of_toughness_and_of_strength() -> None:
    tough = 1e-5  # of E G_c / s^2 beside a depth of 1 m: linear elastic fracture mechanics
    held = math.sqrt(energy.YOUNG / (1 - energy.POISSON**2) * energy.fracture_energy(tough))
    # P S f / (B D^1.5) = K_c with f = 1.339 at a quarter's depth and a span of 4 (ASTM E399)
    assert energy.beam_peak(tough, span=4.0) == pytest.approx(held / (4.0 * 1.339), rel=1e-3)
    peaks = [energy.beam_peak(length) for length in (0.05, 0.5, 5.0, 5e3)]
    assert peaks == sorted(peaks)
    # where toughness asks for nothing: the ligament at its strength, elastic to plastic
    ligament = 2.0 * energy.TENSILE * 0.75**2 / (3.0 * 3.0)
    assert ligament < peaks[-1] < 1.5 * ligament


def test_watermelon_of_cohesion_one_breaks_in_shear_only_with_shear_damage() -> None:
    assert breaking_step("simple shear", cohesion=1.0, implicit=False)[0] is None
    step, _, _ = breaking_step("simple shear", cohesion=1.0, shear_damage=0.3, implicit=False)
    assert step is not None and abs(step - 293) <= 1  # equations.md 7.4
    assert breaking_step("simple shear", cohesion=5.0, implicit=False)[1] <= -0.04  # it hardens


def test_implicit_alpha_breaks_a_few_steps_earlier_than_explicit() -> None:
    for path, most in (("simple shear", 8), ("uniaxial tension", 8), ("isotropic tension", 6)):
        late, early = (breaking_step(path, shear_damage=0.3, implicit=i)[0] for i in (False, True))
        assert late is not None and early is not None and 0 < late - early <= most


def test_crack_band_keeps_strength_and_stretches_softening() -> None:
    row = nacc(1e9, 0.2, 1000.0, friction=2.0, cohesion=0.1, hardening=0.4)
    alpha = torch.tensor([-0.05, -0.02, 0.0, 0.3], dtype=torch.float64)
    rows, stretched = crack_band(row, alpha, dx=0.01, reference=0.04)
    assert torch.allclose(stretched, torch.tensor([-0.2, -0.08, 0.0, 0.3], dtype=torch.float64))
    before, after = row[4] * alpha[:2], rows[4] * stretched[:2]
    assert torch.allclose(before, after, rtol=1e-14)  # p0 = kappa sinh(xi |alpha|) is the same
    assert torch.equal(rows[torch.arange(8) != 4], row[torch.arange(8) != 4])
    same = fracture_energy(row, -0.05, dx=0.04)
    assert fracture_energy(rows, -0.2, dx=0.01) == pytest.approx(same, rel=0.03)
    # without scaling the finer grid would take a quarter of the energy
    assert fracture_energy(row, -0.05, dx=0.01) == pytest.approx(0.25 * same)


def test_crack_band_knows_the_grid_that_is_too_coarse() -> None:
    row = nacc(1e9, 0.2, 1000.0, friction=2.0, cohesion=0.5, hardening=1.0)
    limit = float(brittle_spacing(row, reference=0.01))
    assert limit == pytest.approx(0.02)
    energy = []
    for dx in (limit / 8.0, limit / 4.0, 2.0 * limit, 4.0 * limit):
        scaled, alpha = crack_band(row, torch.tensor(-0.02), dx=dx, reference=0.01)
        energy.append(fracture_energy(scaled, float(alpha), dx=dx))
    assert energy[1] == pytest.approx(energy[0], rel=0.1)
    assert energy[3] > 1.3 * energy[2]  # a one-step failure takes the stored energy of the band


def test_crack_band_refuses_bad_numbers() -> None:
    row = nacc(1e9, 0.2, 1000.0, friction=2.0, cohesion=0.1, hardening=0.4)
    with pytest.raises(ValueError, match="positive"):
        crack_band(row, torch.tensor(-0.1), dx=0.0, reference=1.0)
    with pytest.raises(ValueError, match="below"):
        crack_band(row, torch.tensor(-0.1), dx=1e-3, reference=1.0)
    with pytest.raises(ValueError, match="negative"):
        softening_energy(row, 0.0)
    with pytest.raises(ValueError, match="positive"):
        fracture_energy(row, -0.1, dx=-1.0)
    with pytest.raises(ValueError, match="still"):  # alpha moves by 0.2 in a step at most
        softening_energy(row, -9.0, steps=10)


def test_a_strip_torn_too_fast_fails_everywhere_and_that_is_no_crack() -> None:
    """The bound of ``single_edge_notch`` can be missed: it is not built into the tip's search."""
    assert notch.run_crack(24, pull=5e-4, crossings=4.0).fastest > 1.0


@pytest.mark.data
def test_dam_break_against_the_measured_fronts(data_root: Path) -> None:
    for result in liquid.dam_break(data=data_root):
        assert result.passed, f"{result.quantity}: {result.value:+.3f}"


def test_dam_break_says_when_the_data_is_missing(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="GSFLUENT_DATA"):
        liquid.dam_break(data=tmp_path)


def test_a_sand_column_runs_as_far_as_its_height_asks() -> None:
    (result,) = granular.sand_column(aspects=(1.0,), cells=14)
    assert result.passed, f"{result.value:.3f}, wanted {result.reference:.3f}"
