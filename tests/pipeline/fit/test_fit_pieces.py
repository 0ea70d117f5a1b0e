"""Numbers of what breaks, from statistics of the pieces."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from fit_scenes import scene

from gsfluent.errors import InputError
from gsfluent.materials import Material
from gsfluent.pipeline.fit.breaks import (
    Break,
    FitPieces,
    bands,
    cma,
    cost_of,
    read_numbers,
    run_break,
)
from gsfluent.targets import Pieces
from gsfluent.targets.pieces import PARTS, statistics


def brittle(young: float = 1e5) -> Any:
    """A cube of what crumbles, thrown at the floor."""
    matter = Material("crumb", young, 0.3, 1000.0, cohesion=0.05, hardening=0.5,
                      friction_angle=30.0, alpha0=-0.01, law="nacc")  # fmt: skip
    return scene(matter, velocity=(0.0, 0.0, -4.0), gap=0.02)


def test_statistics_are_shares_and_quantiles() -> None:
    found = statistics([1.0, 3.0], [[0, 0, 0], [1, 2, 3]], 0.25)
    np.testing.assert_allclose(found["masses"][:3], [0.75, 0.25, 0.0])
    assert len(found["places"]) == 3 * len(PARTS) and found["broken"] == [0.25]
    assert found["places"][0] == 0.0 and found["places"][len(PARTS) - 1] == 1.0
    moved = statistics([1.0, 3.0], [[0.5, 0, 0], [1.5, 2, 3]])["places"] - found["places"]
    np.testing.assert_allclose(moved, [0.5] * len(PARTS) + [0.0] * 2 * len(PARTS))
    same = {k: np.stack([v, v]) for k, v in found.items()}
    one = {k: np.ones_like(v) for k, v in found.items()}
    assert cost_of(same, found, one) == 0.0
    assert cost_of(same, {"broken": found["broken"] + 2.0}, one) == 2.0


@pytest.mark.parametrize("size", [1, 2, 3])
def test_the_search_finds_the_bottom_of_a_valley_and_its_width(size: int) -> None:
    """A quadratic whose axes are turned; bands are those of its inverse."""
    random = np.random.default_rng(size)
    root = random.standard_normal((size, size)) + 3.0 * np.eye(size)
    bend, bottom = root.T @ root, 0.5 * random.random(size)
    chance = np.random.default_rng(7)

    def costs(frees: Any) -> list[float]:
        return [0.5 * (f - bottom) @ bend @ (f - bottom) + 1e-6 * chance.random() for f in frees]

    tried, cost = cma(costs, np.zeros(size), 40, 0)
    assert np.abs(tried[int(np.argmin(cost))] - bottom).max() < 0.01
    again, _ = cma(costs, np.zeros(size), 40, 0)
    assert np.array_equal(tried[:5], again[:5])
    tried = bottom + 0.5 * random.standard_normal((60, size))
    found = bands(tried, np.asarray(costs(tried)))
    np.testing.assert_allclose(
        found, np.sqrt(np.diag(np.linalg.inv(bend + np.eye(size) / 1.5**2))), rtol=1e-2
    )


def test_what_does_not_matter_is_unidentified() -> None:
    tried = np.random.default_rng(0).standard_normal((40, 2))
    found = bands(tried, 0.5 * (tried[:, 0] / 0.2) ** 2)
    assert found[0] == pytest.approx(0.2, rel=0.01) and found[1] > 1.4


def test_a_break_is_simulated_and_searched() -> None:
    """Two seeds of a coarse drop; a law of the pieces that is known takes its place afterwards."""
    one = run_break(Break(brittle(), 0.08, 0.15, 0))
    assert sum(one["masses"]) <= 1.0 + 1e-9 and 0.0 < one["broken"][0] <= 1.0

    def runner(function: Any, tasks: Any) -> list[Any]:
        young = [t.scene.bodies[0].material.young_modulus for t in tasks]
        return [{**one, "broken": [0.1 * np.log10(e) + 0.001 * t.seed]}
                for e, t in zip(young, tasks, strict=True)]  # fmt: skip

    target = Pieces([1.0], broken=0.1 * np.log10(3e5) + 0.0005, time=0.15)
    del target.wanted["masses"]
    fit = FitPieces(["thing.young_modulus"], seeds=2, rounds=12, cells=4, runner=runner)
    found = fit(brittle(), target)
    assert found.values["thing.young_modulus"] == pytest.approx(3e5, rel=0.02)
    assert found.sd["thing.young_modulus"] == pytest.approx(
        0.1, rel=0.1
    )  # 0.01 over a slope of 0.1
    assert found.scene.bodies[0].material.young_modulus == found.values["thing.young_modulus"]
    assert found.report["runs"] == 2 * (12 * 4 + 2)


def test_what_pieces_do_not_show_is_said() -> None:
    with pytest.raises(InputError, match="not from pieces"):
        read_numbers(brittle(), ["thing.density"])
    with pytest.raises(InputError, match="no object"):
        read_numbers(brittle(), ["think.cohesion"])
    with pytest.raises(InputError, match="positive"):
        Pieces([1.0, -1.0])
    with pytest.raises(InputError, match="places"):
        Pieces([1.0], places=[[0.0, 0.0]])
    assert read_numbers(brittle(), ["thing.alpha0"]) == {"thing.alpha0": -0.01}
