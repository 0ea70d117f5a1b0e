"""Measures that trade nothing on a GPU: with and without each, the error of a case is the same.

As ``test_trades_nothing.py`` beside it; here are the graph of a round of steps, the sums in fixed
point and the sorting of points, which only a GPU has in this form.
"""

from __future__ import annotations

import pytest
import torch
from trades import all_laws, apart, coarse, same_bits, same_error

from gsfluent import has_cuda, ops
from gsfluent.fracturebench.run import Run
from gsfluent.fracturebench.scene import Scene
from gsfluent.lab.charts.run_case import even_dt, shuffled, stepwise
from gsfluent.lab.frozen.answer import run_case

pytestmark = [
    pytest.mark.cuda,
    pytest.mark.skipif(not has_cuda(), reason="needs a GPU and gsfluent's CUDA kernels"),
]
each_case = pytest.mark.parametrize("case", ["bar", "pull_apart"])
both_precisions = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])


@each_case
def test_fixed_point_sums(case: str) -> None:
    """Sums of integers against sums of floats: the composed operators on the CPU, in float64."""
    scene = coarse(case)
    dt = even_dt(scene, 0.4)
    with_ = run_case(scene, device="cuda", dt=dt, dtype=torch.float64)
    without = run_case(scene, engine="ops", dt=dt, dtype=torch.float64)
    same_error(scene, with_, without)
    assert apart(with_, without) < 1e-6 * scene.dx
    single = run_case(scene, device="cuda", dt=dt)
    same_error(scene, single, without)


@both_precisions
@each_case
def test_sorted(case: str, dtype: torch.dtype) -> None:
    """Points in the order of homes: any order they are given in has the same bits."""
    scene = coarse(case)

    def run(given: Scene) -> Run:
        return run_case(given, device="cuda", dtype=dtype)

    with_, without = run(scene), shuffled(scene, run, seed=5)
    same_error(scene, with_, without)
    same_bits(with_, without)


@each_case
def test_deterministic(case: str) -> None:
    """Atomics of integers have no order to depend on: a run repeated has the same bits."""
    scene = coarse(case)
    same_bits(run_case(scene, device="cuda"), run_case(scene, device="cuda"))


@pytest.mark.parametrize("length", [1, 32])
@each_case
def test_graph_of_a_round(case: str, length: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Eight steps in a graph against graphs of one step and of 32: the clock is on the device."""
    scene = coarse(case)
    with_ = run_case(scene, device="cuda")
    monkeypatch.setattr(ops.Solver, "steps_per_round", length)
    without = run_case(scene, device="cuda")
    same_error(scene, with_, without)
    assert with_.steps == without.steps


@each_case
def test_many_steps_in_a_call(case: str) -> None:
    """``advance`` to a time against a call for every step."""
    scene = coarse(case)
    dt = even_dt(scene, 0.4)
    with_ = run_case(scene, device="cuda", dt=dt, dtype=torch.float64)
    with stepwise(True):
        without = run_case(scene, device="cuda", dt=dt, dtype=torch.float64)
    same_error(scene, with_, without)
    assert apart(with_, without) < 1e-6 * scene.dx


@each_case
def test_law_kernels(case: str) -> None:
    """Kernels for elastic matter only, against those of all laws."""
    scene = coarse(case)
    dt = even_dt(scene, 0.4)
    with_, without = (
        run_case(given, device="cuda", dt=dt, dtype=torch.float64)
        for given in (scene, all_laws(scene))
    )
    same_error(scene, with_, without)
    assert apart(with_, without) < 1e-6 * scene.dx


@each_case
def test_deformation_tracked_only_when_asked_for(case: str) -> None:
    scene = coarse(case)
    with_, without = (
        run_case(scene, device="cuda"),
        run_case(scene, device="cuda", deformation=True),
    )
    same_error(scene, with_, without)
    same_bits(with_, without)
