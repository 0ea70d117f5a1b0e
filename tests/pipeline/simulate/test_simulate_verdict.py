"""The verdict: clean, healed (where and how), failed (frame, region, cause, what to change)."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any

import pytest
import torch
from simulation_shapes import ellipsoid

from gsfluent import materials
from gsfluent.data import Frame
from gsfluent.ops.solver import Solver, SolverError
from gsfluent.ops.solver_buffers import SITE_FIELDS
from gsfluent.pipeline.matter.state import State
from gsfluent.pipeline.simulate import run as simulate_run
from gsfluent.pipeline.simulate.health import CHECK_EVERY
from gsfluent.pipeline.simulate.run import Run
from gsfluent.pipeline.simulate.stage import Simulate, SimulationFrame
from gsfluent.scene.scene import Scene

SOFT = materials.elastic.override(young_modulus=2e4)
FPS, SECONDS = 20.0, 0.3
Hook = Callable[[State], State]


def two_balls() -> Scene:
    """Two balls on the floor, half a metre apart."""
    scene = Scene()
    for name, x in (("left", 0.0), ("right", 0.5)):
        place = Frame(torch.eye(3), torch.tensor([x, 0.0, 0.105]), 1.0)
        scene.add(ellipsoid(), SOFT, frame=place, name=name)
    return scene


def poison(when: Callable[[State], bool], times: int, value: float = math.nan) -> Hook:
    """Write ``value`` into the velocity of some points of the right ball, so many times."""
    left = [times]

    def hook(state: State) -> State:
        if left[0] == 0 or not when(state):
            return state
        left[0] -= 1
        velocity = state.particles.velocity.clone()
        velocity[-5:, 1] = value
        return state._replace(particles=state.particles.replace(velocity=velocity))

    return hook


def simulated(hook: Hook | None, **options: int) -> tuple[list[SimulationFrame], dict[str, Any]]:
    simulate = Simulate(dx=0.04, splats=False, step_hook=hook, **options)  # type: ignore[arg-type]
    simulation = simulate(two_balls(), fps=FPS, seconds=SECONDS)
    return list(simulation), simulation.report


def test_a_clean_run_has_no_reason() -> None:
    _, report = simulated(None)
    assert (report["verdict"], report["reason"], report["rollbacks"]) == ("clean", "", 0)


@pytest.mark.parametrize("value", [math.nan, 1e5])
def test_one_bad_step_is_healed_and_the_reason_says_where_and_how(value: float) -> None:
    frames, report = simulated(poison(lambda s: s.step == 20, 1, value))
    assert report["verdict"] == "healed" and report["rollbacks"] == 1
    assert [f.index for f in frames] == list(range(6))
    assert [f.time for f in frames] == [k / FPS for k in range(6)]
    reason = report["reason"]
    assert re.search(r"t = [\d.e-]+ s, step \d+", reason), reason
    assert "'right'" in reason and "around (0.5" in reason and "box" in reason, reason
    assert "went back to t = " in reason and "0.5 of the time step" in reason, reason
    clean, _ = simulated(None)
    for a, b in zip(frames, clean, strict=True):
        assert float((a.particles.position - b.particles.position).abs().max()) < 0.05 * 0.04


def test_a_run_that_cannot_be_healed_keeps_its_frames_and_says_what_to_change() -> None:
    frames, report = simulated(poison(lambda s: s.time > 0.12, -1), max_rollbacks=3)
    assert report["verdict"] == "failed" and report["frames"] == len(frames) == 3
    assert [f.index for f in frames] == [0, 1, 2]
    reason = report["reason"]
    assert reason.startswith("frame 3: t = ") and "'right'" in reason, reason
    assert "likely cause: " in reason and "hint: " in reason and "step_hook" in reason
    for frame in frames:
        assert bool(torch.isfinite(frame.particles.position).all())


def test_trouble_that_comes_back_ends_the_run_even_with_good_checks_in_between() -> None:
    """With half the step there is a good check on the way to the same trouble, every time."""
    late = 0.0

    def when(state: State) -> bool:
        nonlocal late
        late = max(late, state.time)
        return state.time > 0.19

    frames, report = simulated(poison(when, -1), max_rollbacks=4)
    assert report["verdict"] == "failed" and report["rollbacks"] == 4 and len(frames) == 4
    assert report["substeps"] > CHECK_EVERY and late < 0.2


def test_each_failure_in_a_row_goes_further_back() -> None:
    frames, report = simulated(poison(lambda s: s.time > 0.14, 3))
    assert report["verdict"] == "healed" and report["rollbacks"] == 3 and len(frames) == 6
    back = [float(t) for t in re.findall(r"went back to t = ([\d.e-]+)", report["reason"])]
    assert len(back) == 3 and back[2] <= back[1] <= back[0] < 0.14
    # Never behind the frame that was handed out before.
    assert min(back) >= 0.1
    assert "0.125 of the time step" in report["reason"]


def test_too_many_pieces_in_one_place_share_fields(monkeypatch: pytest.MonkeyPatch) -> None:
    """More fields than a block has room for are no reason to stop, nor for shorter steps."""
    simulate = Simulate(dx=0.04, splats=False)
    scene = two_balls()
    run = Run(scene, simulate.prepare(scene), FPS)
    unit = torch.arange(run.matter.particles.count) // 10
    assert int(unit.max()) > 2 * SITE_FIELDS
    find = simulate_run.find_pieces
    monkeypatch.setattr(
        simulate_run, "find_pieces", lambda *a, **k: find(*a, **k)._replace(unit=unit)
    )
    run.stepper.field_limit = 8 * SITE_FIELDS  # as if it did not know how much room there is
    for frame in range(1, 3):
        assert run.advance_to(frame, None), run.failure
        run.record(frame)
    report = run.report()
    assert report["verdict"] == "healed" and "share one block" in report["reason"]
    assert f"at most {SITE_FIELDS} pieces apart in one place" in report["reason"]
    assert run.stepper.field_limit <= SITE_FIELDS and run.stepper.dt_scale == 1.0
    assert SITE_FIELDS // 2 < int(run.state.field.max()) + 1 < int(unit.max())
    # The place is one block of four cells, not the whole scene.
    low, high = re.findall(r"box \(([\d.e-]+), .*? to \(([\d.e-]+),", report["reason"])[0]
    assert float(high) - float(low) <= 4 * 0.04
    assert report["momentum_error"] < 1e-5


def test_what_stops_the_solver_at_one_time_ends_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    """Inside a call of the solver too, failures count until the run is past them."""
    advance, tries = Solver.advance, []

    def breaks(self: Solver, until: float, *, steps: int) -> None:
        advance(self, until, steps=steps)
        if self.time > 0.02:  # of the call's own clock, which starts anew at each frame
            tries.append(self.dt)
            raise SolverError(1, self.time, self.steps)

    monkeypatch.setattr(Solver, "advance", breaks)
    frames, report = simulated(None, max_rollbacks=3)
    assert report["verdict"] == "failed" and report["rollbacks"] == 3 and len(tries) == 4
    assert len(frames) == 1 and report["reason"].startswith("frame 1: t = 0.0")
    assert "is not finite" in report["reason"] and tries[-1] < 0.2 * tries[0]
