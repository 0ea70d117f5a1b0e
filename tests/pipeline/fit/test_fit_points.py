"""Laws mixed at every point: shares of one move as it does, and two in a block are told apart."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import pytest
import torch
from fit_scenes import SIDE, elastic, halves, scene, seen

from gsfluent.errors import InputError
from gsfluent.materials import Material
from gsfluent.pipeline import Fit
from gsfluent.pipeline.fit.forward import Forward
from gsfluent.pipeline.fit.points import (
    FieldTask,
    Mixed,
    _unknowns,
    corners,
    divided,
    run_field,
    shares,
)
from gsfluent.scene.scene import Scene
from gsfluent.targets import Points

DX = SIDE / 4
TIMES = [k / 24 for k in range(6)]


def test_shares_are_a_softmax_between_nodes() -> None:
    box = torch.tensor([[0.0, 0, 0], [1, 2, 3]], dtype=torch.float64)
    at = torch.tensor([[0.0, 0.0, 0.0], [0.5, 1.0, 1.5], [0.25, 2.0, 3.0]], dtype=torch.float64)
    basis = corners(at, box, 3)
    torch.testing.assert_close(basis.sum(dim=1), torch.ones(3).double())
    assert basis[0, 0] == 1.0 and basis[1, 13] == 1.0
    assert basis[2, 8] == 0.5 and basis[2, 17] == 0.5  # half way between two nodes along x
    logits = torch.linspace(-1, 1, 54)
    found = shares(basis, logits.tolist(), 3, 0.5)
    other = basis @ logits.double().reshape(27, 2)
    wanted = torch.softmax(torch.cat([torch.zeros(3, 1), other], dim=1) / 0.5, dim=1)
    torch.testing.assert_close(found, wanted, atol=1e-5, rtol=0)


@pytest.mark.parametrize("logit", [-40.0, 40.0])
def test_a_share_of_one_is_that_law(logit: float) -> None:
    clay = Material("clay", 1e5, 0.3, 1000.0, law="von_mises", yield_stress=1e3)
    mixed = Mixed(scene(clay), TIMES, DX, ("elastic", "von_mises"), 2)
    pure = scene(clay if logit > 0 else elastic(1e5))
    alone = Forward(pure, TIMES, DX)
    dt = alone.step({})
    found = mixed.run({"thing.logits": [logit] * 8}, 6, dt)
    wanted = alone.run({}, 6, dt)
    assert float((found.position - wanted.position).abs().max()) < 1e-4  # shares end at 1e-6
    moved = (wanted.position[-1] - wanted.position[0]).norm(dim=1).min()
    assert float(moved) > 0.02


def test_halves_of_two_stiffnesses_are_one_of_their_mean() -> None:
    """Neo-Hookean stress is linear in the moduli: half of E and half of 3 E are 2 E."""
    mixed = Mixed(scene(elastic(1e5)), TIMES, DX, ("elastic", "elastic"), 2)
    mixed.experts = [elastic(1e5), elastic(3e5)]
    alone = Forward(scene(elastic(2e5)), TIMES, DX)
    dt = 0.8 * alone.step({})
    found, wanted = mixed.run({"thing.logits": [0.0] * 8}, 6, dt), alone.run({}, 6, dt)
    assert float((found.position - wanted.position).abs().max()) < 1e-9


BELOW = {"law": "von_mises", "yield_stress": 1e3}


def right(found: Scene) -> float:
    """Share of the matter under the right law: the lower half yields."""
    solid = found.bodies[0].solid
    assert solid is not None and solid.regions is not None
    low = solid.voxel_centers(solid.occupancy.nonzero())[:, 2] < 0.5 * SIDE
    return float((solid.regions[solid.occupancy] == low.int()).double().mean())


@pytest.mark.timeout(1200)
def test_two_laws_in_a_block_are_told_apart() -> None:
    """Rubber on clay, on the grid of the truth: 95 % of its matter under the right law."""
    tracks, _ = seen(halves(BELOW, elastic(1e5)), DX, frames=7)
    guess, laws = scene(elastic(5e4)), ("elastic", "von_mises")
    found = run_field(FieldTask(guess, Points(tracks), laws, {}, DX, 1, False, 2))
    assert right(divided(guess, laws, found["values"], 2)) > 0.95
    assert found["rms"] < 1.0
    assert abs(math.log10(found["values"]["thing.yield_stress"]) - 3.0) < 0.1


def test_regions_of_laws_get_numbers_of_their_own() -> None:
    """What the mixture has left is searched as parts, and runs as any other scene."""
    tracks, _ = seen(halves(BELOW, elastic(1e5)), DX, frames=6)
    mixed = {"thing.logits": [2.6, -2.4] * 4, "thing.young_modulus": 9e4,
             "thing.poisson_ratio": 0.3, "thing.yield_stress": 1.1e3}  # fmt: skip

    def runner(function: Any, items: Any) -> list[Any]:
        if function is run_field:
            return [{"values": mixed, "rms": 1.0, "runs": [0]} for _ in items]
        return [function(item) for item in items]

    fit = Fit(laws=["elastic", "von_mises"], per="point", nodes=2, cells=4, grids=1,
              offset=False, runner=runner)  # fmt: skip
    found = fit(scene(elastic(5e4)), Points(tracks))
    assert right(found.scene) > 0.95
    assert found.laws == {"thing": "von_mises", "thing/elastic": "elastic"}
    assert found.report["shares"]["elastic"] == pytest.approx(0.5, abs=0.05)
    assert {"thing/elastic.young_modulus", "thing.yield_stress"} <= set(found.values)
    assert found.values["thing.yield_stress"] == pytest.approx(1e3, rel=0.1)
    Forward(found.scene, TIMES, DX)


def test_a_velocity_is_learnt_beside() -> None:
    """As the stage hands it over, by keys."""
    target = Points(torch.zeros(6, 1, 3).numpy())
    laws = ("elastic", "von_mises")
    task = FieldTask(scene(elastic()), target, laws, {"thing.velocity": True}, DX, 1, False, 2)
    made = _unknowns(task, Mixed(scene(elastic()), TIMES, DX, laws, 2))
    assert next(iter(made.slices())) == "thing.velocity" and len(made) == 3 + 3 + 8


def test_what_cannot_be_mixed_is_said() -> None:
    with pytest.raises(InputError, match="two laws"):
        Fit(laws=["elastic"], per="point")
    with pytest.raises(InputError, match="nodes"):
        Fit(laws=["elastic", "fluid"], per="point", nodes=9)
    with pytest.raises(InputError, match="without parts"):
        Mixed(halves({"young_modulus": 1e5}, elastic()), TIMES, DX, ("elastic", "fluid"), 2)
    target = Points(torch.zeros(6, 1, 3).numpy())
    task = FieldTask(scene(elastic()), target, ("elastic", "fluid"), {}, DX, 1, True, 6)
    with pytest.raises(InputError, match="numbers for 2 laws"):
        run_field(task)
    assert dataclasses.replace(task, nodes=2).nodes == 2
