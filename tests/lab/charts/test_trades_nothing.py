"""Measures that make a run cheaper and trade nothing: with and without each, the error is the same.

What gsfluent leaves out, sorts or reuses (docs/theory/solver.md, docs/theory/solver.md,
docs/theory/simulation.md),
by name: a case with a known answer is run with the measure and without it, and the two errors may
differ by at most 1 % of the case's tolerance (``solver.md`` section 6). Where the pages promise the
same bits, the runs have the same bits. On a GPU: tests/lab/charts/test_trades_nothing_cuda.py.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
import torch
from simulation_scenes import SOFT, at, near_miss, resting
from simulation_shapes import ellipsoid
from trades import COARSE, all_laws, apart, judged, same_bits, same_error

from gsfluent import ops
from gsfluent.fracturebench.run import Run
from gsfluent.fracturebench.scene import Scene as Frozen
from gsfluent.lab.charts.run_case import even_dt, shuffled, stepwise
from gsfluent.lab.frozen.answer import run_case
from gsfluent.lab.world import stepper
from gsfluent.ops.reference import plasticity
from gsfluent.pipeline.simulate.engine import SolverOptions
from gsfluent.pipeline.simulate.stage import Simulate, SimulationFrame
from gsfluent.scene.scene import Scene

CASES = ("bar", "pull_apart")
both_precisions = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
each_case = pytest.mark.parametrize("case", CASES)


# --- the resident solver ---


@each_case
def test_resident(case: str) -> None:
    """State that stays in the solver, against the composed operators; float64, the same steps."""
    scene = COARSE(case)
    dt = even_dt(scene, 0.4)
    with_, without = (
        run_case(scene, engine=engine, dtype=torch.float64, dt=dt) for engine in ("solver", "ops")
    )
    assert (with_.settings["engine"], without.settings["engine"]) == ("solver", "ops")
    assert with_.steps == without.steps
    same_error(scene, with_, without)
    assert apart(with_, without) < 1e-9 * scene.dx


@both_precisions
@each_case
def test_sorted(case: str, dtype: torch.dtype) -> None:
    """Points kept in the order of cells: any order they are given in has the same bits."""
    scene = COARSE(case)

    def run(given: Frozen) -> Run:
        return run_case(given, dtype=dtype)

    with_, without = run(scene), shuffled(scene, run, seed=5)
    same_error(scene, with_, without)
    same_bits(with_, without)


@each_case
def test_deterministic(case: str) -> None:
    """Sums in one order: a run repeated has the same bits."""
    scene = COARSE(case)
    same_bits(run_case(scene), run_case(scene))


def test_threads() -> None:
    """Any number of threads gives the same bits."""
    scene = COARSE("bar")
    before = torch.get_num_threads()
    runs = []
    try:
        for count in (1, 2):
            torch.set_num_threads(count)
            runs.append(run_case(scene))
    finally:
        torch.set_num_threads(before)
    same_error(scene, *runs)
    same_bits(*runs)


@pytest.mark.parametrize("fixed", [True, False])
@each_case
def test_many_steps_in_a_call(case: str, fixed: bool) -> None:
    """``advance`` to a time against a call for every step."""
    scene = COARSE(case)
    dt = even_dt(scene, 0.4) if fixed else None
    with_ = run_case(scene, dt=dt, dtype=torch.float64)
    with stepwise(True):
        without = run_case(scene, dt=dt, dtype=torch.float64)
    same_error(scene, with_, without)
    if fixed:  # the automatic step looks at speeds anew in every call
        assert apart(with_, without) < 1e-9 * scene.dx


@each_case
def test_law_kernels(case: str) -> None:
    """A scene of elastic matter has kernels of its own, against those of all laws."""
    scene = COARSE(case)
    dt = even_dt(scene, 0.4)  # the automatic step looks at wave speeds in every step there
    with_, without = (
        run_case(given, dt=dt, dtype=torch.float64) for given in (scene, all_laws(scene))
    )
    same_error(scene, with_, without)
    assert apart(with_, without) < 1e-9 * scene.dx


@each_case
def test_deformation_tracked_only_when_asked_for(case: str) -> None:
    scene = COARSE(case)
    with_, without = run_case(scene), run_case(scene, deformation=True)
    same_error(scene, with_, without)
    same_bits(with_, without)


def test_contact_only_where_bodies_meet() -> None:
    """Bodies that share no block: fields of their own do not cost them a bit."""
    scene = COARSE("pull_apart")
    x = scene.x.copy()
    x[scene.body == 1] += 64 * scene.dx
    away = dataclasses.replace(scene, x=x)
    with_, without = run_case(away), run_case(away, fields=False)
    assert with_.settings["fields"] and not without.settings["fields"]
    same_error(scene, with_, without)
    same_bits(with_, without)


def test_places_kept_relative_to_their_cell() -> None:
    """A body 65 km from the origin moves as it does there: what float32 positions would cost."""
    scene = COARSE("bar")
    away = np.array([4.0 * 2**15 * scene.dx, 0.0, -4.0 * 2**15 * scene.dx])
    far = dataclasses.replace(scene, x=scene.x + away)
    with_, without = run_case(far), run_case(scene)
    at_home = dataclasses.replace(with_, x=with_.x - away)
    # what is left is the rounding of the places that are given and read, in float64
    same_error(scene, at_home, without, slack=1e-6)


# --- the composed operators ---


def _composed(scene: Frozen) -> Run:
    return run_case(scene, engine="ops", dtype=torch.float64)


sparse_blocks = ops.build_blocks


def _dense(position: torch.Tensor, dx: float, **options: Any) -> ops.Blocks:
    """Blocks for the whole bounding box: what a dense grid would store."""
    sparse = sparse_blocks(position, dx, **options)
    size = sparse.table.shape
    table = torch.arange(sparse.table.numel(), dtype=torch.int32).view(size)
    coords = torch.cartesian_prod(*[torch.arange(n, dtype=torch.int32) for n in size])
    counts = torch.zeros(table.numel(), dtype=torch.int32)
    counts[sparse.table.flatten() >= 0] = sparse.start.diff()
    start = torch.nn.functional.pad(torch.cumsum(counts, 0), (1, 0)).to(torch.int32)
    coords = coords + torch.tensor(sparse.origin, dtype=torch.int32)
    return sparse._replace(table=table, coords=coords, start=start)


def test_sparse_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Blocks where matter is, against a dense grid over the box around it."""
    scene = COARSE("pull_apart")
    x = scene.x.copy()
    x[scene.body == 1] += 12 * scene.dx  # a box with emptiness in it
    scene = dataclasses.replace(scene, x=x)
    with_ = _composed(scene)
    stored = []

    def dense(position: torch.Tensor, dx: float, **options: Any) -> ops.Blocks:
        blocks = _dense(position, dx, **options)
        stored.append(blocks.block_count / sparse_blocks(position, dx, **options).block_count)
        return blocks

    monkeypatch.setattr(ops, "build_blocks", dense)
    without = _composed(scene)
    assert min(stored) > 1.0
    same_error(scene, with_, without)
    assert apart(with_, without) < 1e-12 * scene.dx


@pytest.mark.parametrize("margin", [0, 2])
def test_block_margin(monkeypatch: pytest.MonkeyPatch, margin: int) -> None:
    """Blocks that serve several steps, against a search in every step (margin 0) or in fewer."""
    scene = COARSE("pull_apart")
    with_ = _composed(scene)
    searches = []

    def blocks(position: torch.Tensor, dx: float, **options: Any) -> ops.Blocks:
        searches.append(1)
        return sparse_blocks(position, dx, margin=margin)

    monkeypatch.setattr(ops, "build_blocks", blocks)
    without = _composed(scene)
    assert (len(searches) >= without.steps) == (margin == 0)
    same_error(scene, with_, without)
    assert apart(with_, without) < 1e-12 * scene.dx


def test_elastic_early_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """Points inside the yield surface leave the return map early, against its whole way.

    The bars are NACC matter that is stretched but does not break.
    """
    scene = COARSE("bar")
    brittle = {
        **scene.materials[0], "law": "nacc", "friction": 1.85, "cohesion": 0.5, "hardening": 3.0,
        "alpha": -0.04,
    }  # fmt: skip
    scene = dataclasses.replace(scene, materials=(brittle,), times=scene.times[:6])
    early = run_case(scene, dtype=torch.float64)
    with_ = _composed(scene)

    def whole_way(
        strain: torch.Tensor, alpha: torch.Tensor, increment: torch.Tensor, *, law: torch.Tensor,
        params: torch.Tensor, material: torch.Tensor | None = None, dt: float = 0.0,
    ) -> Any:  # fmt: skip
        return plasticity.return_mapping(
            strain, alpha, increment, law=law, params=params, material=material, dt=dt
        )

    monkeypatch.setattr(stepper.ops, "return_mapping", whole_way)
    without = _composed(scene)
    for run in (early, with_):
        same_error(scene, run, without)
    assert apart(with_, without) < 1e-9 * scene.dx


# --- the simulation stage: bodies that leave the grid ---

DX = 0.02


def _frames(
    scene: Scene, fps: float, seconds: float, **options: Any
) -> tuple[list[SimulationFrame], Any]:
    simulation = Simulate(dx=DX, splats=False, **options)(scene, fps=fps, seconds=seconds)
    frames = list(simulation)
    report = simulation.report
    assert report["verdict"] == "clean", report["reason"]
    return frames, report


def _fall_error(frames: list[SimulationFrame], turn: float) -> float:
    """Largest rms distance of the points from a rigid body on a parabola, over its radius."""
    start = frames[0].particles
    first, mass = start.position.double(), start.mass.double()[:, None]
    center = (mass * first).sum(dim=0) / mass.sum()
    worst = 0.0
    for frame in frames[1:]:
        t, angle = frame.time, turn * frame.time
        c, s = math.cos(angle), math.sin(angle)
        spin = torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
        path = torch.tensor([0.5 * t, 0.2 * t, 0.5 * t - 0.5 * 9.81 * t * t], dtype=torch.float64)
        exact = (first - center) @ spin.T + center + path
        gap = (frame.particles.position.double() - exact).square().sum(dim=1).mean().sqrt()
        worst = max(worst, float(gap) / 0.05)
    return worst


@pytest.mark.parametrize("turn", [0.0, 3.0])
def test_free_flight(turn: float) -> None:
    """Bodies that touch nothing on a parabola in closed form, against the grid."""
    scene = Scene()
    scene.add(
        ellipsoid((0.05, 0.05, 0.05)), SOFT, frame=at(0.0, 0.0, 0.5), velocity=(0.5, 0.2, 0.5),
        angular_velocity=(0.0, 0.0, turn),
    )  # fmt: skip
    (on, with_), (off, without) = (
        _frames(scene, 20, 0.25, free_flight=flag, piece_flight=flag) for flag in (True, False)
    )
    assert with_["substeps"] == 0 < without["substeps"]
    closed, gridded = _fall_error(on, turn), _fall_error(off, turn)
    # better than unchanged: symplectic Euler falls g t dt / 2 behind the parabola
    assert closed < (1e-6 if turn == 0.0 else 1e-3) < gridded
    assert gridded - closed < 1.2 * 0.5 * 9.81 * 0.2 * without["dt_max"] / 0.05 + 0.01


def _straight_error(frames: list[SimulationFrame]) -> float:
    """Largest distance of the centres of two free balls from straight lines, over their radius."""
    start = frames[0].particles
    worst = 0.0
    for ball in (0, 1):
        own = start.body == ball
        mass = start.mass[own].double()[:, None]

        def center(value: torch.Tensor, own: torch.Tensor = own, mass: torch.Tensor = mass) -> Any:
            return (mass * value[own].double()).sum(dim=0) / mass.sum()

        place, speed = center(start.position), center(start.velocity)
        for frame in frames[1:]:
            gap = center(frame.particles.position) - place - frame.time * speed
            worst = max(worst, float(gap.norm()) / 0.05)
    return worst


@pytest.mark.parametrize("measure", ["piece_flight", "contact_proximity"])
def test_bodies_that_pass_each_other(measure: str) -> None:
    """Two balls that come near and do not touch fly straight on.

    ``piece_flight`` takes them off the grid again behind each other; ``contact_proximity`` looks
    for contact only while they are near.
    """
    (on, with_), (off, without) = (
        _frames(near_miss(), 40, 0.3, resident=False, **{measure: flag}) for flag in (True, False)
    )
    if measure == "piece_flight":
        assert with_["pieces_flown"] == 2 and with_["substeps"] < without["substeps"]
    else:
        skipped = [r["skipped"]["contact_steps"] for r in (with_, without)]
        assert skipped[0] > skipped[1]
    errors = _straight_error(on), _straight_error(off)
    assert max(errors) < 1e-3 and abs(errors[0] - errors[1]) < 1e-4


@pytest.mark.parametrize(("surface", "bar"), [(False, 2e-3), (True, 0.03)])
def test_sleep(surface: bool, bar: float) -> None:
    """What rests is taken off the grid: it stays where it would have stayed.

    At points a springy body goes on bouncing by a few hundredths of a cell for seconds, which a
    body that sleeps does not (docs/theory/contact.md).
    """
    scene, options = resting(False), SolverOptions(surface=surface)
    (on, with_), (off, without) = (
        _frames(scene, 10, 2.0, sleep=flag, options=options) for flag in (True, False)
    )
    assert with_["naps"] == 1 and without["naps"] == 0
    assert with_["substeps"] < without["substeps"]

    def height(frames: list[SimulationFrame]) -> list[float]:
        return [float(f.particles.position[:, 2].double().mean()) / 0.04 for f in frames]

    # a body in equilibrium does not move: that is the answer both are judged by
    late_on, late_off = height(on)[-5:], height(off)[-5:]
    assert max(late_on) - min(late_on) <= max(late_off) - min(late_off) < bar
    assert min(late_off) - 2e-3 < late_on[-1] < max(late_off) + 2e-3


def test_the_comparison_itself_sees_a_difference() -> None:
    """The bar is no matter of course: a coarser step and another dx fail it."""
    scene = COARSE("bar")
    base = run_case(scene)
    for other in (run_case(scene, cfl=0.2), dataclasses.replace(base, x=base.x * 1.001)):
        with pytest.raises(AssertionError):
            same_error(scene, base, other)
    assert judged(scene, base) > 0.0
