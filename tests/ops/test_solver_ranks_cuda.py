"""Several ranks on CUDA, in lockstep on one device and one on each: the bits of one."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from solver_scenes import scene
from test_solver_cpu import STATE, shuffled, small
from test_solver_ranks import CASES, DTYPES, assert_same_state, dust

from gsfluent import has_cuda, ops
from gsfluent.errors import GsfluentError, InputError
from gsfluent.ops import solver_buffers as layout
from gsfluent.ops import solver_ranks

pytestmark = [
    pytest.mark.cuda,
    pytest.mark.skipif(not has_cuda(), reason="needs a GPU and gsfluent's CUDA kernels"),
]
STEPS = 40
KNOWN = [name for name in CASES if name != "metal with a rate"]  # which has kernels on a CPU only
PEERS = 4
"""Devices used at most."""


def devices() -> list[str]:
    """Two devices or more of this host, or a skip that says how many there are."""
    there = torch.cuda.device_count()
    if there < 2:
        pytest.skip(f"needs two GPUs of one host, this one has {there}")
    return [f"cuda:{i}" for i in range(min(there, PEERS))]


def here(given: dict[str, Any]) -> dict[str, Any]:
    return {
        name: value.to("cuda:0") if isinstance(value, torch.Tensor) else value
        for name, value in given.items()
    }


def run(given: dict[str, Any], steps: int = STEPS, **options: Any) -> ops.Solver:
    solver = ops.Solver(**given, **options)
    solver.advance(steps=steps)
    return solver


def assert_equal(have: ops.Solver, want: ops.Solver) -> None:
    assert_same_state(have, want)
    assert torch.equal(have.torque, want.torque)
    assert have.counters() == want.counters()
    assert have.time == want.time and have.dt == want.dt


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize("name", KNOWN)
def test_ranks_on_one_device_give_the_bits_of_one(name: str, dtype: torch.dtype) -> None:
    given = here(CASES[name](dtype))
    one = run(given)
    for ranks in (2, 3, 4):
        several = run(given, ranks=ranks)
        assert_equal(several, one)
        parts = several.rank_counts()
        assert sum(part["points"] for part in parts) == one.count
        assert sum(part["points"] > 0 for part in parts) > 1
        assert sum(part["shared"] for part in parts) > 0


@pytest.mark.parametrize("name", KNOWN)
def test_several_devices_give_the_bits_of_one(name: str) -> None:
    given = here(CASES[name](torch.float32))
    assert_equal(run(given, devices=devices()), run(given))


@pytest.mark.parametrize("points", [599_000, 601_000])
def test_a_body_of_many_homes_through_many_builds(points: int) -> None:
    """Below 600 000 points two CTAs share a home."""
    given = here(scene(cells=43, dtype=torch.float32))
    for name, value in given.items():
        if isinstance(value, torch.Tensor) and value.shape[0] > points:
            given[name] = value[:points]
    one = run(given, 200)
    assert one.counters()["builds"] > 1
    assert_equal(run(given, 200, ranks=4), one)
    if torch.cuda.device_count() > 1:
        assert_equal(run(given, 200, devices=devices()), one)


def test_a_thousand_steps_on_several_devices() -> None:
    given = here(scene(cells=24, bodies=2, laws=(0, 1), dtype=torch.float32, track=True))
    assert_equal(run(given, 1000, devices=devices()), run(given, 1000))


@pytest.mark.parametrize("parent", [[0, 1, 2], [0, 0, 1], [0, 0, 0]], ids=str)
def test_sparse_points_that_drift_keep_the_bits(parent: list[int]) -> None:
    given = dust(torch.float32, 1)
    given["parent"] = torch.tensor(parent, dtype=torch.int32)
    given["cut"] = torch.zeros(3, dtype=torch.int32)
    given = here(given)
    one = run(given, 50)
    for ranks in (2, 7, 64):
        assert_equal(run(given, 50, ranks=ranks), one)


def test_order_of_points_and_room_for_blocks_leave_no_trace() -> None:
    given = scene(cells=8, bodies=2, laws=(0, 1), dtype=torch.float32)
    mixed, order = shuffled(given)
    one = run(here(given), 20)
    several = run(here(mixed), 20, ranks=5)
    assert torch.equal(several.position, one.position[order.cuda()])
    assert torch.equal(several.impulse, one.impulse)
    tight = ops.Solver(**here(given), ranks=3)
    homes = int(tight.clock()["homes"])
    tight._whole.reserve_blocks(homes, 1, 2)
    tight._parts.grow()
    start = tight.snapshot()
    for _ in range(2):
        tight.advance(steps=20)
        assert torch.equal(tight.position, one.position)
        tight.restore(start)


def test_a_time_is_met_in_one_call_or_in_two() -> None:
    given = here(small("two bodies", torch.float32))
    one, several = ops.Solver(**given), ops.Solver(**given, ranks=3)
    for until in (0.004, 0.01):
        one.advance(until=until)
        several.advance(until=until)
        assert_equal(several, one)


def test_points_stay_with_their_ranks_from_call_to_call() -> None:
    given = here(CASES["bullet"](torch.float32))
    one, several = ops.Solver(**given), ops.Solver(**given, ranks=3)
    for solver in (one, several):
        solver.advance(steps=15)
        solver.advance(steps=1)
        slower = solver.colliders
        slower[:, 10:13] *= 0.5
        solver.set_colliders(slower)
        solver.advance(steps=10)
    assert_equal(several, one)
    assert several._whole.id.numel() == several._whole.offset.numel() == 0


@pytest.mark.parametrize("name", ["free", "two bodies", "relaxing", "flip", "objects"])
def test_points_come_from_host_memory_some_at_a_time(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = CASES[name](torch.float32)
    one = run(here(given))
    monkeypatch.setattr(layout, "CHUNK", 61)
    for where in (["cuda:0"], ["cuda:0"] * 3):
        several = run(given, devices=where)
        assert not several.position.is_cuda
        for value in (*STATE, "body", "stress"):
            want = getattr(one, value)
            assert want is None or torch.equal(getattr(several, value), want.cpu()), value
        assert several.counters() == one.counters()
        assert all(index.is_cuda for index, _ in several.chunks("position"))


def test_each_rank_has_memory_for_its_share_and_grows_where_points_gather() -> None:
    given = here(scene(cells=24, bodies=2, laws=(0, 1), dtype=torch.float32))
    one, several = run(given), run(given, ranks=4)
    room = [part.id.numel() for part in several._parts.parts]
    assert sum(room) < 1.3 * one.count and max(room) < 0.3 * one.count
    # All points drift into the share of one rank: what lies there is too small and grows.
    for part in several._parts.parts:
        part.reserve_points(several._widths, int(part.clock[layout.INDEX["cursor"]]))
    before = [part.id.numel() for part in several._parts.parts]
    for solver in (one, several):
        solver.advance(steps=200)
    assert_equal(several, one)
    assert [part.id.numel() for part in several._parts.parts] != before


def test_the_same_failure_at_the_same_step() -> None:
    given = here(small("two bodies", torch.float32))
    told = []
    for ranks in (1, 4):
        with pytest.raises(ops.SolverError) as failure:
            run(given, ranks=ranks, dt=6e-3)
        told.append(str(failure.value))
    assert told[0] == told[1]


def test_a_device_that_stands_still_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    given = here(small("elastic", torch.float32))
    several = torch.cuda.device_count() > 1
    where = {"devices": devices()} if several else {"ranks": 2}
    solver = ops.Solver(**given, **where)
    whole = solver_ranks.Parts._lists

    def slowly(parts: solver_ranks.Parts) -> Any:
        with torch.cuda.device(1 if several else 0):
            torch.cuda._sleep(6_000_000_000)  # about 3 s
        return whole(parts)

    monkeypatch.setattr(solver_ranks, "PATIENCE", 0.2)
    monkeypatch.setattr(solver_ranks.Parts, "_lists", slowly)
    with pytest.raises(GsfluentError, match=r"no step on cuda:0.* was finished in 0.2 s"):
        solver.advance(steps=1)
    monkeypatch.undo()
    torch.cuda.synchronize()
    assert_equal(run(given, **where), run(given))


def test_points_must_lie_on_one_of_the_devices() -> None:
    with pytest.raises(InputError, match="the points lie on cuda:0"):
        ops.Solver(**here(small("elastic", torch.float32)), devices=devices()[1:])
