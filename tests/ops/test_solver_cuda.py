"""The resident solver on a GPU against the composed operators, and its guarantees."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from solver_scenes import MASS, SPEED, bullet, composed, resident, scene
from torch import Tensor

from gsfluent import has_cuda, ops

pytestmark = [
    pytest.mark.cuda,
    pytest.mark.skipif(not has_cuda(), reason="needs a GPU and gsfluent's CUDA kernels"),
]
DT = 2e-4
STEPS = 60
CASES: list[dict[str, Any]] = [
    {"laws": (0,)},
    {"laws": (0,), "track": True},
    {"laws": (1,)},
    {"laws": (0, 1), "bodies": 2},
    {"laws": (1,), "bodies": 2, "track": True},
]


def error(have: Tensor, want: Tensor) -> float:
    scale = float(want.double().abs().max()) + 1e-30
    return float((have.double().cpu() - want.double().cpu()).abs().max()) / scale


@pytest.mark.parametrize("dtype, bar", [(torch.float64, 1e-9), (torch.float32, 2e-4)])
@pytest.mark.parametrize("case", CASES)
def test_steps_equal_the_composed_operators(
    case: dict[str, Any], dtype: torch.dtype, bar: float
) -> None:
    want = composed(scene(**case), DT, STEPS)
    solver = resident(scene(**case, dtype=dtype, device="cuda"), DT, STEPS)
    assert solver.steps == STEPS
    for name in ("position", "velocity"):
        assert error(getattr(solver, name), want[name]) < bar, name
    assert float((solver.strain.double().cpu() - want["strain"]).abs().max()) < 20 * bar
    assert error(solver.impulse.sum(dim=0), want["impulse"]) < bar
    if case.get("track"):
        assert error(solver.deformation, want["deformation"]) < 10 * bar
    if 1 in case["laws"]:
        assert float((solver.alpha.double().cpu() - want["alpha"]).abs().max()) < 20 * bar


def test_same_bits_for_any_run_and_any_order() -> None:
    given = scene(laws=(0, 1), bodies=2, dtype=torch.float32, device="cuda", track=True)
    first = resident(given, None, 200)
    n = given["position"].shape[0]
    shuffle = torch.randperm(n, generator=torch.Generator().manual_seed(3)).cuda()
    mixed = dict(given)
    for name, value in given.items():
        if isinstance(value, Tensor) and value.shape[:1] == (n,):
            mixed[name] = value[shuffle]
    for other, order in (
        (resident(given, None, 200), slice(None)),
        (resident(mixed, None, 200), shuffle),
    ):
        for name in ("position", "velocity", "affine", "strain", "alpha", "deformation"):
            assert torch.equal(getattr(other, name), getattr(first, name)[order]), name
        assert torch.equal(other.impulse, first.impulse)


def test_a_time_is_met_exactly_and_a_frame_may_be_cut_in_two() -> None:
    given = scene(dtype=torch.float32, device="cuda")
    solver = ops.Solver(**given)
    solver.advance(until=0.01)
    assert solver.time == 0.01
    solver.advance(until=0.02)
    assert solver.time == 0.02
    saved = solver.snapshot()
    solver.advance(until=0.03)
    there = solver.position
    solver.restore(saved)
    assert solver.time == 0.02
    solver.advance(until=0.03)
    assert torch.equal(solver.position, there)


def test_room_for_blocks_grows() -> None:
    given = scene(dtype=torch.float32, device="cuda")
    tight = ops.Solver(**given, dt=DT)
    tight._whole.reserve_blocks(int(tight.clock()["homes"]), 3, 1)
    tight.advance(steps=STEPS)
    loose = resident(given, DT, STEPS)
    assert torch.equal(tight.position, loose.position)


def test_bad_states_stop_with_a_reason() -> None:
    given = scene(dtype=torch.float32, device="cuda")
    solver = ops.Solver(**given, dt=DT)
    solver._whole.velocity[4 * 5] = float("nan")
    with pytest.raises(ops.SolverError, match="not finite"):
        solver.advance(steps=10)
    fast = ops.Solver(**given, dt=0.05)
    with pytest.raises(ops.SolverError, match="moved further"):
        fast.advance(steps=10)


def test_distance_from_the_origin_changes_nothing() -> None:
    near = resident(scene(dtype=torch.float32, device="cuda"), DT, STEPS)
    cells = 4 * 4096
    far = resident(scene(dtype=torch.float32, device="cuda", shift=cells * 0.02), DT, STEPS)
    moved = far.position
    moved[:, 0] -= cells * 0.02
    assert float((moved - near.position).abs().max()) < 1e-6 * 0.02


def test_a_bullet_hits_matter_at_rest_and_keeps_the_momentum() -> None:
    """Points at rest have no momentum to count in; what a bullet gives is counted all the same."""
    given = scene(dtype=torch.float32, device="cuda", speed=0.0)
    given["velocity"] = torch.zeros_like(given["velocity"])
    given["colliders"] = bullet(given["position"], torch.float32)
    solver = ops.Solver(**given, gravity=(0, 0, 0), dt=1e-4)
    before = solver.colliders[0]
    solver.advance(steps=3)
    after = solver.colliders[0]
    taken = (given["mass"].double()[:, None] * solver.velocity.double()).sum(dim=0)
    lost = before[MASS] * (before[SPEED] - after[SPEED])
    assert float(taken.norm()) > 1e-4
    rounding = 1e-6 * float(before[MASS] * before[SPEED].norm())  # float32 velocities
    torch.testing.assert_close(taken, lost, rtol=0.0, atol=rounding)
    torch.testing.assert_close(solver.impulse[0], lost, rtol=0.0, atol=1e-9)
