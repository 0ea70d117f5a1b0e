"""Failure catalogue (solver.md section 4), rows seen through a whole run: 7, 15, 24, 26."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from simulation_shapes import ellipsoid

from gsfluent import materials, ops
from gsfluent.pipeline.simulate.stage import Simulate
from gsfluent.scene.scene import Scene

SOFT = materials.elastic.override(young_modulus=2e4)


def dropped(height: float = 0.01, **material: float) -> Scene:
    scene = Scene()
    scene.add(ellipsoid(), SOFT.override(**material) if material else SOFT)
    scene.drop(height)
    return scene


def spoil(name: str, value: float, *, after: int, times: int) -> Callable[[Any], Any]:
    """A hook that writes ``value`` into one point's ``name``, ``times`` times (-1: for ever)."""
    left = [times]

    def hook(state: Any) -> Any:
        if state.step < after or left[0] == 0:
            return state
        left[0] -= 1
        changed = getattr(state.particles, name).clone()
        changed[7, 1] = value
        return state._replace(particles=state.particles.replace(**{name: changed}))

    return hook


def test_row_7_a_run_takes_shorter_steps_in_stiffer_matter() -> None:
    dt = []
    for young in (2e4, 8e4):
        simulation = Simulate(dx=0.04, splats=False)(
            dropped(0.05, young_modulus=young), fps=20, seconds=0.2
        )
        frames = list(simulation)
        report = simulation.report
        assert report["verdict"] == "clean" and len(frames) == 4
        dt.append(report["dt_max"])
    assert dt[1] == pytest.approx(0.5 * dt[0], rel=0.15)  # the falling speed counts too


def test_row_15_points_outside_the_grid_are_counted_and_never_read() -> None:
    inside = torch.rand(50, 3, generator=torch.Generator().manual_seed(0))
    blocks = ops.build_blocks(inside, 0.1)
    wild = inside.clone()
    wild[0], wild[1, 1], wild[2, 0], wild[3] = 1e30, math.nan, -math.inf, -7.0
    grid, _ = ops.p2g(
        wild, torch.zeros(50, 3), torch.zeros(50, 3, 3), torch.ones(50), dx=0.1, blocks=blocks
    )
    assert float(grid[..., 3].sum()) == pytest.approx(46.0, rel=1e-5)
    nodes, _, _ = ops.grid_update(grid, dx=0.1, dt=0.01, blocks=blocks)
    moved, *_, skipped = ops.g2p(
        nodes, wild, dx=0.1, dt=0.01, blocks=blocks, velocity=torch.zeros(50, 3),
        return_skipped=True,
    )  # fmt: skip
    assert int(skipped) == 4 and bool(torch.isfinite(moved[4:]).all())


@pytest.mark.parametrize("value", [math.nan, 1e12, -1e12])
def test_row_15_a_point_thrown_out_of_the_world_once_is_healed(value: float) -> None:
    hook = spoil("position", value, after=12, times=1)
    simulation = Simulate(dx=0.04, splats=False, step_hook=hook)(dropped(), fps=20, seconds=0.2)
    frames = list(simulation)
    report = simulation.report
    assert report["verdict"] == "healed" and report["reason"] and len(frames) == 4
    last = frames[-1].particles.position
    assert bool(torch.isfinite(last).all()) and float(last.abs().max()) < 1.0


def test_row_15_a_point_thrown_out_again_and_again_ends_the_run_with_the_reason() -> None:
    hook = spoil("position", 1e12, after=12, times=-1)
    simulation = Simulate(dx=0.04, splats=False, step_hook=hook, max_rollbacks=2)(
        dropped(), fps=20, seconds=0.3
    )
    frames = list(simulation)
    report = simulation.report
    assert report["verdict"] == "failed" and len(frames) == report["frames"] < 6
    assert "frame" in report["reason"] and "step" in report["reason"]


def test_row_24_the_number_of_splats_does_not_set_the_number_of_points() -> None:
    counts = []
    for splats in (40, 40_000):
        scene = Scene()
        scene.add(ellipsoid(splats=splats), SOFT)
        matter = Simulate(dx=0.02).prepare(scene)
        counts.append(matter.particles.count)
    assert counts[0] == counts[1]
    cells = 4.0 / 3.0 * math.pi * 5.0**3  # a ball of radius 0.1 in cells of 0.02
    assert counts[0] / cells == pytest.approx(8.0, rel=0.05)


def test_row_26_a_nan_at_step_seven_is_healed_and_the_clock_stays_right() -> None:
    clean = Simulate(dx=0.04, splats=False)(dropped(), fps=20, seconds=0.2)
    *_, wanted = clean
    hook = spoil("velocity", math.nan, after=7, times=1)
    simulation = Simulate(dx=0.04, splats=False, step_hook=hook)(dropped(), fps=20, seconds=0.2)
    frames = list(simulation)
    report = simulation.report
    assert report["verdict"] == "healed" and report["rollbacks"] == 1
    assert [frame.time for frame in frames] == [k / 20 for k in range(4)]
    apart = (frames[-1].particles.position - wanted.particles.position).abs().max()
    assert float(apart) < 0.05 * 0.04
    assert report["dt_min"] < 0.6 * clean.report["dt_max"]  # it went on with half the step


def test_row_26_a_nan_in_every_step_fails_and_keeps_what_was_good() -> None:
    hook = spoil("velocity", math.nan, after=7, times=-1)
    simulation = Simulate(dx=0.04, splats=False, step_hook=hook, max_rollbacks=2)(
        dropped(), fps=20, seconds=0.3
    )
    frames = list(simulation)
    report = simulation.report
    assert report["verdict"] == "failed" and report["rollbacks"] == 2
    assert "frame" in report["reason"] and "step" in report["reason"]
    for frame in frames:
        assert bool(torch.isfinite(frame.particles.position).all())
