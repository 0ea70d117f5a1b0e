"""Phase-field matter through the simulation: it cracks, its energies add up, the plan knows it."""

from __future__ import annotations

import pytest
import torch
from simulation_scenes import CLAY, dropped

from gsfluent import materials
from gsfluent.errors import InputError
from gsfluent.pipeline.matter.points import build_matter
from gsfluent.pipeline.simulate.stage import Simulate
from gsfluent.stages.findings import lowered

DX = 0.03


def test_a_hard_landing_cracks_and_costs_energy() -> None:
    simulation = Simulate(dx=DX)(dropped(CLAY, 0.6), fps=100, seconds=0.41)
    frames = [f for f in simulation if f.index in (0, 36, 40)]
    report = simulation.report
    assert report["verdict"] == "clean" and report["momentum_error"] < 1e-5
    assert report["composed_steps"] == 0 < report["substeps"]
    before, struck, after = (f.energy for f in frames)
    assert before["surface"] == 0.0 < struck["surface"] <= after["surface"] * 1.01
    assert float(frames[-1].broken.float().mean()) > 0.01
    total = [sum(e[k] for k in ("kinetic", "elastic", "gravity")) for e in (before, struck, after)]
    assert total[0] > total[1] > total[2] * 0.999
    damage = frames[-1].damage
    assert 0.0 <= float(damage.min()) and float(damage.max()) == 1.0


def test_a_soft_landing_leaves_it_whole() -> None:
    strong = CLAY.override(tensile_strength=9e4)
    simulation = Simulate(dx=DX)(dropped(strong, 0.02), fps=50, seconds=0.09)
    last = list(simulation)[-1]
    assert last.energy["surface"] == 0.0 and not bool(last.broken.any())
    assert last.energy["elastic"] > 0.0


def test_plan_says_what_two_cells_bind() -> None:
    (said_of_toughness,) = lowered(dropped(CLAY.override(tensile_strength=4e4), 0.2), DX)
    assert "bind" in said_of_toughness and "times its toughness" in said_of_toughness
    tough = CLAY.override(toughness=4.0, prefer="toughness", tensile_strength=4e4)
    (said_of_strength,) = lowered(dropped(tough, 0.2), DX)
    assert "bind" in said_of_strength and "of the strength are left" in said_of_strength


def test_the_grid_keeps_what_is_preferred() -> None:
    length, strong, tough = materials.phase_field.kept(CLAY.override(toughness=4.0), DX)
    assert length == 2.0 * DX and strong == pytest.approx(1.0) and tough > 10.0
    weak = CLAY.override(toughness=4.0, prefer="toughness", tensile_strength=4e4)
    _, strong, tough = materials.phase_field.kept(weak, DX)
    assert strong < 0.5 and tough == 1.0


def test_a_length_below_two_cells_is_refused() -> None:
    scene = dropped(CLAY.override(length=0.04), 0.1)
    with pytest.raises(InputError, match=r"length must be at least 2 cells"):
        build_matter(scene, DX)


def test_a_preset_takes_the_law_with_its_own_numbers() -> None:
    row = materials.glass.override(law="phase_field")
    assert row.toughness == materials.glass.fracture_energy and row.fracture_energy is None
    assert row.tensile_strength == materials.glass.tensile_strength
    assert materials.glass.override(law="phase_field", toughness=8.0).toughness == 8.0
    matter = build_matter(dropped(row, 0.1), DX)
    assert matter.has_field and bool(matter.brittle.all())
    assert torch.equal(matter.particles.alpha, torch.full_like(matter.particles.alpha, -1.0))
