"""The searches of a fit on a GPU: the motion of the CPU, and the numbers that it was made with."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from fit_scenes import SIDE, elastic, scene, seen

from gsfluent.materials import Material
from gsfluent.pipeline import Fit
from gsfluent.pipeline.fit.forward import Forward
from gsfluent.pipeline.fit.together import together
from gsfluent.targets import Points

pytestmark = pytest.mark.cuda
DX = SIDE / 4
TIMES = [k / 24 for k in range(8)]


def test_a_run_is_that_of_the_cpu_and_the_same_bits_twice() -> None:
    here, there = (Forward(scene(elastic()), TIMES, DX, device=d) for d in ("cpu", "cuda"))
    dt = here.step({})
    wanted, found, again = here.run({}, 8, dt), there.run({}, 8, dt), there.run({}, 8, dt)
    assert found.position.device.type == "cpu"
    assert float((found.position - wanted.position).abs().max()) < 1e-6
    assert torch.equal(found.position, again.position)
    assert torch.equal(found.deformation, again.deformation)


def test_a_search_finds_what_the_motion_was_made_with() -> None:
    tracks, _ = seen(scene(elastic(1e5)), DX, frames=8)
    learn = ["thing.young_modulus", "thing.velocity"]
    fit = Fit(learn, starts=1, cells=4, grids=1, offset=False, device="cuda")
    found = fit(scene(elastic(5e4)), Points(tracks))
    assert found.values["thing.young_modulus"] == pytest.approx(1e5, rel=0.01)


def test_searches_that_wait_for_each_other_are_one_run() -> None:
    """Two things of other laws beside each other move as on the CPU, frame by frame."""
    clay = Material("clay", 1e5, 0.3, 1000.0, law="von_mises", yield_stress=2e3)
    things = [scene(elastic()), scene(clay, velocity=(0.3, 0.0, -1.5))]

    def run(device: str, thing: Any) -> Any:
        return Forward(thing, TIMES, DX, device=device).run({}, len(TIMES), 1e-3)

    found = together(lambda thing: run("cuda", thing), things)
    wanted = together(lambda thing: run("cpu", thing), things)
    for one, other in zip(found, wanted, strict=True):
        assert float((one.position - other.position).abs().max()) < 1e-6
        assert float(one.strain) == pytest.approx(float(other.strain), rel=1e-4)


def test_laws_are_tried_beside_each_other() -> None:
    tracks, _ = seen(scene(elastic(1e5)), DX, frames=8)
    fit = Fit(laws=["elastic", "fluid"], starts=1, cells=4, grids=1, offset=False, device="cuda")
    assert fit(scene(elastic(5e4)), Points(tracks)).laws == {"thing": "elastic"}
