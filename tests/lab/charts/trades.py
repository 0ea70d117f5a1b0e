"""Running a case twice and comparing the errors."""

from __future__ import annotations

import dataclasses

import numpy as np

from gsfluent.fracturebench.registry import find, judge
from gsfluent.fracturebench.run import Run
from gsfluent.fracturebench.scene import Scene


def coarse(case: str) -> Scene:
    """The coarsest rung of a case, eight points a cell."""
    found = find(case)
    return found.build(max(found.ladder), 8)


COARSE = coarse


def judged(scene: Scene, run: Run) -> float:
    """Error of a run."""
    assert run.finite, run.failed
    return judge(scene, run)[0].error


def same_error(scene: Scene, with_: Run, without: Run, slack: float = 0.0) -> None:
    """The two errors differ by at most 1 % of the case's tolerance, in every measure."""
    for run in (with_, without):
        assert run.finite, run.failed
    pairs = zip(judge(scene, with_), judge(scene, without), strict=True)
    for a, b in pairs:
        bar = 0.01 * a.tolerance + slack
        assert abs(a.error - b.error) <= bar, (a.quantity, a.error, b.error)


def same_bits(a: Run, b: Run) -> None:
    """Every position and velocity is the same number."""
    assert np.array_equal(a.x, b.x) and np.array_equal(a.v, b.v)
    assert a.steps == b.steps


def apart(a: Run, b: Run) -> float:
    """Largest distance of a point in the one from itself in the other [m]."""
    return float(np.abs(a.x - b.x).max())


def all_laws(scene: Scene) -> Scene:
    """The same scene with a row of a third law that no point has: it takes the general kernels."""
    row = {**scene.materials[0], "law": "corotated"}
    return dataclasses.replace(scene, materials=(*scene.materials, row))
