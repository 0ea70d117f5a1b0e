"""The acceptance of issue 2: a watermelon that is dropped breaks into pieces."""

from __future__ import annotations

import math

import pytest
from simulation_shapes import ellipsoid

from gsfluent import materials
from gsfluent.pipeline.simulate.stage import Simulate
from gsfluent.scene.scene import Scene


@pytest.mark.slow
def test_a_dropped_watermelon_breaks_into_chunks():
    height = 2.0  # 1.5 m, on a coarser grid: test_simulate_pieces.py
    scene = Scene(floor=0.0)
    scene.add(ellipsoid((0.125, 0.105, 0.105), voxels=48), materials.fruit.watermelon)
    scene.drop(height)
    landing = math.sqrt(2 * height / 9.81)
    # two frames: the start, and 0.2 s after landing
    simulation = Simulate(dx=0.0156, splats=False)(  # 16 cells
        scene, fps=1 / (landing + 0.2), seconds=2 * (landing + 0.2)
    )
    *_, last = simulation
    report = simulation.report
    assert report["verdict"] == "clean"
    assert report["momentum_error"] < 1e-4
    assert last.stats["fragments_over_3_percent"] >= 2
    # chunks, not dust: next to nothing is loose, though cracks are cells wide
    assert last.stats["loose_fraction"] < 0.03
    assert float(last.pieces.mass_fractions.sum()) > 0.97
    assert last.stats["broken_fraction"] > 0.1


def test_a_melon_that_is_laid_down_stays_whole():
    scene = Scene(floor=0.0)
    scene.add(ellipsoid((0.125, 0.105, 0.105), voxels=32), materials.fruit.watermelon)
    scene.drop(0.02)
    simulate = Simulate(dx=0.02, splats=False)
    *_, last = simulate(scene, fps=5, seconds=0.4)
    assert last.stats["fragments"] == 1 and last.stats["damaged_fraction"] < 0.01
