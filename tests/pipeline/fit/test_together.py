"""Searches that wait for each other find what each finds alone, whatever becomes of the others."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from fit_scenes import SIDE, elastic, scene, seen

from gsfluent.materials import Material
from gsfluent.pipeline import Fit
from gsfluent.pipeline.fit import together as rooms
from gsfluent.pipeline.fit.forward import Forward
from gsfluent.pipeline.fit.together import TooFast, agreed, moved, solve, together
from gsfluent.targets import Points

DX = SIDE / 4
TIMES = [k / 24 for k in range(6)]
CLAY = Material("clay", 1e5, 0.3, 1000.0, law="von_mises", yield_stress=2e3)


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many lanes each run of the solver has."""
    made: list[int] = []

    def counted(setup: Any, lanes: Any) -> Any:
        made.append(len(lanes))
        return solve(setup, lanes)

    monkeypatch.setattr(rooms, "solve", counted)
    return made


def test_runs_of_several_searches_are_those_of_each(calls: list[int]) -> None:
    """Two laws, other numbers of frames, another speed: one run of the solver."""
    things = [(scene(elastic(9e4)), 6), (scene(CLAY, velocity=(0.3, 0.0, -1.5)), 4)]

    def run(thing: Any) -> Any:
        forward = Forward(thing[0], TIMES, DX)
        return forward.run_all([{}, {"thing.poisson_ratio": 0.2}], thing[1], 1e-3)

    found = together(run, things)
    assert calls == [4]
    for (made, frames), motions in zip(things, found, strict=True):
        forward = Forward(made, TIMES, DX)
        dt = together(lambda _: agreed(1e-3), [0])[0]
        assert 1e-3 / 2**0.5 < dt <= 1e-3
        wanted = forward.run_all([{}, {"thing.poisson_ratio": 0.2}], frames, dt)
        for one, other in zip(motions, wanted, strict=True):
            assert one.position.shape == (frames, forward.count, 3)
            assert float((one.position - other.position).abs().max()) < 1e-8
            assert float(one.strain) == pytest.approx(float(other.strain), rel=1e-6)


def test_what_one_cannot_run_does_not_stop_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """A run that fails is told to the search that asked for it, and to no other."""

    def fails(setup: Any, lanes: Any) -> Any:
        if any(float(lane.fields["params"][0, 0]) > 4e5 for lane in lanes):
            raise TooFast
        return solve(setup, lanes)

    monkeypatch.setattr(rooms, "solve", fails)

    def run(young: float) -> Any:
        try:
            return Forward(scene(elastic(young)), TIMES[:3], DX).run({}, 3, 1e-3)
        except TooFast:
            return None

    found = together(run, [1e5, 2e6, 2e5])
    assert found[1] is None and found[0] is not None and found[2] is not None
    assert not torch.equal(found[0].position, found[2].position)


def test_an_error_is_raised_and_nobody_waits_for_ever() -> None:
    def run(number: int) -> float:
        if number == 1:
            raise ValueError("no")
        return float(Forward(scene(elastic()), TIMES[:2], DX).run({}, 2, 1e-3).strain)

    with pytest.raises(ValueError, match="no"):
        together(run, [0, 1, 2])


def test_what_stands_beside_a_collider_runs_by_itself() -> None:
    forward = Forward(scene(elastic()), TIMES[:2], DX)
    setups: list[Any] = []

    def run(alone: bool) -> int:
        lane = forward._lane({}, 1e-3, torch.zeros(3, dtype=torch.float64))
        made = rooms.Setup(
            DX, 1e-3, tuple(TIMES[:2]), forward.scene.gravity, 0.3, forward.rigid.start, None,
            torch.device("cpu"),
        )  # fmt: skip
        setups.append(made)
        return len(moved(made, [lane], alone=alone))

    assert together(run, [True, False]) == [1, 1] and len(setups) == 2


def test_fits_side_by_side_find_their_numbers() -> None:
    def fit(young: float) -> float:
        tracks, _ = seen(scene(elastic(young)), DX, frames=6)
        stage = Fit(["thing.young_modulus"], starts=1, cells=4, grids=1, offset=False)
        return float(stage(scene(elastic(1e5)), Points(tracks)).values["thing.young_modulus"])

    found = together(fit, [6e4, 2e5])
    assert found == pytest.approx([6e4, 2e5], rel=1e-2)


def test_searches_within_searches_wait_for_all(calls: list[int]) -> None:
    """Two scenes, two runs of each: four lanes of one run, then two."""

    def inner(young: float) -> float:
        return float(Forward(scene(elastic(young)), TIMES[:3], DX).run({}, 3, 1e-3).strain)

    def outer(young: float) -> list[float]:
        both = together(inner, [young, 2.0 * young])
        return [*both, inner(young)]

    found = together(outer, [5e4, 1e5])
    assert sorted(calls, reverse=True)[0] == 4 and sum(calls) == 6
    assert found[0][1] == pytest.approx(found[1][0], rel=1e-6)
    assert found[0][2] == pytest.approx(found[0][0], rel=1e-6)
