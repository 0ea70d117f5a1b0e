"""gsfluent answers FractureBench on the GPU as on the CPU."""

from __future__ import annotations

import math

import pytest

from gsfluent.fracturebench.registry import find, judge
from gsfluent.lab.frozen.answer import clock, run_case

pytestmark = pytest.mark.cuda


@pytest.mark.parametrize("name", ["bar", "spin", "covariance_transport", "collide", "drop"])
def test_errors_are_those_of_the_cpu(name: str) -> None:
    case = find(name)
    scene = case.build(case.ladder[0], 8)
    there, here = judge(scene, run_case(scene, device="cuda")), judge(scene, run_case(scene))
    # the GPU sums momenta as whole numbers: rounding of about 1e-6 of the fastest point
    assert there[0].error == pytest.approx(here[0].error, rel=5e-3, abs=2e-5)


def test_clock_on_the_gpu() -> None:
    scene = find("bar").build(1 / 8, 8)
    assert all(0.0 < s < math.inf for s in clock(scene, 2, device="cuda"))
