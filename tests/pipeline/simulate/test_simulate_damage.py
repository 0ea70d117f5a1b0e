"""Damage is a matter of brittle material: metal, sand and liquid bend, pour and flow unbroken."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from simulation_shapes import ellipsoid

from gsfluent import materials
from gsfluent.ops.solver_state import UNBROKEN
from gsfluent.pipeline.simulate.stage import Simulate, SimulationFrame
from gsfluent.scene.scene import Scene

METAL = materials.get("aluminium").override(young_modulus=1e6, yield_stress=2e4)
SOFT = {
    "sand": materials.get("sand"),
    "soil": materials.get("soil"),
    "metal": METAL,
    "water": materials.get("water"),
}


def smashed(
    material: materials.Material, *, parts: list[dict[str, Any]] | None = None, **options: bool
) -> list[SimulationFrame]:
    """A ball thrown at the floor so hard that it yields at once."""
    scene = Scene()
    scene.add(ellipsoid((0.05,) * 3), material, velocity=(0, 0, -8.0), parts=parts)
    scene.drop(0.01)
    simulation = Simulate(dx=0.02, **options)(scene, fps=50, seconds=0.08)
    frames = list(simulation)
    report = simulation.report
    assert report["verdict"] == "clean", report["reason"]
    moved = frames[-1].particles.position - frames[0].particles.position
    assert float(moved.abs().max()) > 0.02
    return frames


@pytest.mark.parametrize("resident", [True, False])
@pytest.mark.parametrize("name", SOFT)
def test_what_cannot_break_reports_no_damage(name: str, resident: bool) -> None:
    frames = smashed(SOFT[name], resident=resident)
    last = frames[-1]
    if name != "water":  # it did yield: alpha is at work, but not as damage
        assert not torch.equal(last.particles.alpha, frames[0].particles.alpha)
    for frame in frames:
        assert frame.stats["damaged_fraction"] == 0.0 and frame.stats["alpha_max"] == UNBROKEN
        assert float(frame.damage.abs().max()) == 0.0 and not bool(frame.broken.any())
        # What flows has no pieces, however far it runs apart.
        assert frame.stats["fragments"] == (name == "metal")
    assert not bool(last.motion.broken.any())
    assert last.stats["largest_fragment"] == (1.0 if name == "metal" else 0.0)


@pytest.mark.parametrize("resident", [True, False])
def test_in_a_body_of_both_only_the_brittle_part_breaks(resident: bool) -> None:
    rind = {"name": "rind", "material": METAL, "where": {"box": [[-1, -1, -1], [0, 1, 1]]}}
    apple = materials.fruit.apple.override(variation=0.0)
    frames = smashed(apple, parts=[rind], resident=resident)
    last = frames[-1]
    metal = frames[0].particles.alpha == METAL.start_alpha
    assert 0.2 < float(metal.float().mean()) < 0.8
    assert not bool(last.broken[metal].any()) and bool(last.broken[~metal].any())
    assert float(last.damage[metal].max()) == 0.0 < float(last.damage[~metal].max())
    assert last.stats["damaged_fraction"] == pytest.approx(
        float((last.particles.mass * last.broken).sum() / last.particles.mass.sum()), rel=1e-5
    )


def test_only_brittle_matter_loses_its_cohesion() -> None:
    """Column 3 of the parameters is cohesion in sand too: it must not go with alpha."""
    ends = []
    for irreversible in (True, False):
        frames = smashed(SOFT["soil"], irreversible=irreversible, resident=False)
        ends.append(frames[-1].particles.position)
    assert torch.equal(*ends)
