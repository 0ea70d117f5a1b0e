"""gsfluent's answers to fracture cases on the GPU: driven by forces and velocities, and free."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gsfluent.fracturebench.registry import find, judge
from gsfluent.fracturebench.shapes import box, elastic, free
from gsfluent.fracturebench.statistics import distance, ensemble
from gsfluent.lab.frozen.answer import run_case

pytestmark = pytest.mark.cuda


@pytest.mark.parametrize("name", ["brazilian_disc", "double_cantilever", "spall", "stretched_bar"])
def test_a_case_has_the_error_of_the_cpu(name: str) -> None:
    case = find(name)
    scene = case.build(case.ladder[0], 8)
    there, here = judge(scene, run_case(scene, device="cuda")), judge(scene, run_case(scene))
    assert there[0].error == pytest.approx(here[0].error, rel=0.05, abs=0.01)


def test_pieces_on_the_gpu_are_within_the_band_of_those_on_the_cpu() -> None:
    case, dx = find("shatter"), 0.05 / 5
    here = ensemble(case, dx, 8, range(4), run_case)
    there = ensemble(case, dx, 8, range(4), lambda scene: run_case(scene, device="cuda"))
    assert all(d.within for d in distance(here, there).values())


def test_drives_give_the_impulse_that_they_say_on_the_gpu() -> None:
    points = box([0.0] * 3, [0.3] * 3, 0.1, 8)
    scene = free(
        "pushed", points, [0.0] * 3, 0.1, 8, np.array([0.1, 0.2]),
        elastic(1e5, 0.2, 1000.0), asks=("impulse",),
        drives=({"points": "all", "force": [[0.0, 2.0, 0.0]] * len(points)},),
    )  # fmt: skip
    run = run_case(scene, device="cuda", dtype=torch.float64)
    assert run.impulse is not None
    assert run.impulse[:, 0, 1] == pytest.approx(2.0 * len(points) * scene.times, rel=1e-9)
    assert scene.mass @ run.v[-1, :, 1] == pytest.approx(run.impulse[-1, 0, 1], rel=1e-9)
