"""What of a solid is liquid is drawn as a liquid, in the colours that it had in the solid."""

from __future__ import annotations

import pytest
import torch
from simulation_shapes import ellipsoid

from gsfluent import materials
from gsfluent.pipeline import Simulate
from gsfluent.pipeline.cracks.torn import flows_at
from gsfluent.pipeline.light.from_shot import clear_of
from gsfluent.pipeline.simulate.stage import SimulationFrame
from gsfluent.scene.scene import Scene
from gsfluent.stages.simulate import saved

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)]
WHITE = {"name": "white", "where": {"depth_above": 0.02}, "material": "water"}


def fallen(device: str, parts: list[dict[str, object]]) -> tuple[Scene, list[SimulationFrame]]:
    """A ball that is liquid inside lands."""
    scene = Scene()
    scene.add(ellipsoid((0.05,) * 3), materials.jelly, velocity=(0.0, 0.0, -1.0), parts=parts)
    scene.drop(0.005)
    return scene, list(Simulate(dx=0.01, device=device)(scene, fps=100.0, seconds=0.04))


@pytest.mark.parametrize("device", DEVICES)
def test_a_liquid_inside_is_drawn_by_the_sheet(device: str) -> None:
    scene, frames = fallen(device, [WHITE])
    frame = frames[-1]
    liquid = frame.liquid
    assert liquid is not None
    assert liquid.bodies == (0,)
    carry = frame._binding().carry
    paint = carry.gaussians.colors()
    # mean colours of splats are within what these have
    assert bool((liquid.colors.amax(0) <= paint.amax(0) + 1e-5).all())
    assert bool((liquid.colors.amin(0) >= paint.amin(0) - 1e-5).all())
    kept = saved(frame, scene)
    wet = (kept.ids < 0) & (kept.anchor >= 0)
    assert torch.equal(kept.anchor[wet].long(), liquid.rows)
    # nothing else follows what flows
    assert not bool(liquid.holds(kept.anchor[~wet]).any())
    # a splat is no more than a spacing from its point, and no needle
    away = kept.gaussians.means[wet] - kept.positions[kept.anchor[wet].long()].to(torch.float32)
    spacing = carry.matter.spacing[0]
    assert float(away.norm(dim=1).max()) < spacing
    assert float(kept.gaussians.scales[wet].max()) < 1.5 * spacing
    drawn = clear_of(kept)
    assert drawn is not None
    assert torch.equal(drawn.rows, wet)
    assert bool(drawn.attenuation.isinf().all())
    assert drawn.volume.shape == (len(liquid.rows),)


def test_a_solid_without_a_liquid_stays_as_it_is() -> None:
    scene, frames = fallen("cpu", [])
    assert frames[-1].liquid is None
    kept = saved(frames[-1], scene)
    assert kept.facts["liquid_inside"] == []
    assert clear_of(kept) is None
    assert kept.carried == frames[-1].carried.count


def test_no_face_is_looked_for_in_what_flows() -> None:
    for parts, wet in (([WHITE], True), ([], False)):
        matter = fallen("cpu", parts)[1][0]._binding().carry.matter
        firm = ~matter.of_law("fluid", "drucker_prager")
        assert bool((~firm).any()) == wet
        assert torch.equal(flows_at(matter.rest, 0, firm, matter), ~firm)
