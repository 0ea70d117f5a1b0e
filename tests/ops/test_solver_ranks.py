"""Ranks in lockstep: the bits of one, whatever is cut where."""

from __future__ import annotations

import itertools
from typing import Any
from unittest.mock import MagicMock

import pytest
import torch
from solver_scenes import DX, bullet, scene
from test_solver_cpu import STATE, broken, mixed_rows, shuffled, small

from gsfluent import ops
from gsfluent.errors import GsfluentError, InputError
from gsfluent.lab.world.shapes import parameters
from gsfluent.ops import solver_buffers as layout
from gsfluent.ops import solver_points, solver_ranks
from gsfluent.ops.plasticity import PHASE_CODES

DTYPES = [torch.float32, torch.float64]
STEPS = 40


def free(dtype: torch.dtype) -> dict[str, Any]:
    return small("tracked", dtype) | {"colliders": None}


def of_law(law: int, row: torch.Tensor) -> Any:
    """One body above the floor, of a law whose kernel is compiled apart."""

    def given(dtype: torch.dtype) -> dict[str, Any]:
        table = row.to(dtype).reshape(1, 8).clone()
        table[:, 6] = 1000.0
        kind = torch.tensor([law], dtype=torch.int32)
        return small("elastic", dtype) | {"law": kind, "params": table}

    return given


def relaxing(dtype: torch.dtype) -> dict[str, Any]:
    given = small("two bodies", dtype)
    row = torch.tensor([0.0] * 6 + [0.4, 0.002, 0.0], dtype=dtype)
    return given | {"viscous": row.expand(given["mass"].shape[0], 9).contiguous()}


def kept(dtype: torch.dtype) -> dict[str, Any]:
    return small("all", dtype) | {"cfl": 0.25, "flip": 0.5}


def pushed(dtype: torch.dtype) -> dict[str, Any]:
    given = small("two bodies", dtype)
    return given | {"radius": torch.full_like(given["mass"], 0.25 * DX)}


def pressed(dtype: torch.dtype) -> dict[str, Any]:
    """Bodies whose points push each other, across the cut too."""
    given = side_by_side(dtype)
    radius = torch.full_like(given["mass"], 0.25 * DX)
    return given | {"radius": radius, "objects": torch.tensor([0, 1], dtype=torch.int32)}


def stacked(dtype: torch.dtype) -> dict[str, Any]:
    return pushed(dtype) | {"objects": torch.tensor([0, 1], dtype=torch.int32)}


def shot(dtype: torch.dtype) -> dict[str, Any]:
    """A ball with a mass of its own flies in: where it goes hangs on every impulse it gets."""
    given = small("two bodies", dtype)
    return given | {"colliders": bullet(given["position"], dtype)}


def side_by_side(dtype: torch.dtype) -> dict[str, Any]:
    """Two bodies that fly at each other along x, the axis of the cuts: with two ranks, one each."""
    given = small("two bodies", dtype)
    speed = torch.where(given["body"] == 0, 3.0, -3.0).to(dtype)
    turned = given["velocity"][:, [1, 0, 0]].clone()
    turned[:, 0] = speed
    return given | {
        "position": given["position"][:, [2, 1, 0]].contiguous(), "velocity": turned,
        "colliders": None, "frame": (0.0, 0.0, 0.0),
    }  # fmt: skip


def cut_by_a_blade(dtype: torch.dtype) -> dict[str, Any]:
    """Four fields of two bodies: those of one move as one, but for two that a blade parts."""
    given = small("two bodies", dtype)
    half = (given["position"][:, 0] > given["position"][:, 0].mean()).int()
    ints = {"parent": [0, 0, 1, 1], "cut": [1, 2, 0, 0]}
    return given | {
        "body": 2 * given["body"] + half,
        **{name: torch.tensor(rows, dtype=torch.int32) for name, rows in ints.items()},
    }


def dust(dtype: torch.dtype, seed: int = 0) -> dict[str, Any]:
    """Points of three bodies anywhere, so that homes hold few, reach little and drift apart."""
    given = small("elastic", dtype)
    n = 300
    generator = torch.Generator().manual_seed(seed)
    lot = torch.rand(n, 7, generator=generator, dtype=torch.float64)
    return {name: value[:n] if isinstance(value, torch.Tensor) and value.shape[0] > n else value
            for name, value in given.items()} | {
        "position": lot[:, :3] * torch.tensor([20 * DX, 10 * DX, 6 * DX], dtype=torch.float64),
        "velocity": (4.0 * (lot[:, 3:6] - 0.5)).to(dtype),
        "body": (3.0 * lot[:, 6]).int(),
        "colliders": None, "frame": (0.0, 0.0, 0.0),
    }  # fmt: skip


CASES = {
    "free": free,
    "nacc": lambda dtype: small("nacc", dtype),
    "metal": of_law(3, parameters(1e5, 0.3, 1.0, c2=20.0, c4=0.01)),
    "metal with a rate": of_law(3, parameters(1e5, 0.3, 1.0, c2=20.0, c4=0.01, c7=0.5, c3=0.02)),
    "relaxing": relaxing,
    "two bodies": lambda dtype: small("all", dtype),
    "mixed": mixed_rows,
    "broken": broken,
    "flip": kept,
    "radius": pushed,
    "objects": pressed,
    "objects on each other": stacked,
    "bullet": shot,
    "side by side": side_by_side,
    "blade": cut_by_a_blade,
}


def run(given: dict[str, Any], ranks: int, steps: int = STEPS, **options: Any) -> ops.Solver:
    solver = ops.Solver(**given, ranks=ranks, **options)
    solver.advance(steps=steps)
    return solver


def assert_same_state(have: ops.Solver, want: ops.Solver) -> None:
    for name in STATE:
        value = getattr(want, name)
        if value is not None:
            assert torch.equal(getattr(have, name), value), name
    assert torch.equal(have.impulse, want.impulse)
    assert torch.equal(have.colliders, want.colliders)


def assert_equal(have: ops.Solver, want: ops.Solver) -> None:
    assert_same_state(have, want)
    assert have.clock() == want.clock()


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize("name", CASES)
def test_bits_do_not_hang_on_the_cut(name: str, dtype: torch.dtype) -> None:
    given = CASES[name](dtype)
    one = run(given, 1)
    if "objects" not in given:  # whose points meet, not their nodes
        assert (one.counters()["contact_nodes"] > 0) == (int(given["body"].max()) > 0)
    for ranks in (2, 3, 8):
        several = run(given, ranks)
        assert_equal(several, one)
        parts = several.rank_counts()
        assert sum(part["points"] > 0 for part in parts) > 1
        assert sum(part["shared"] for part in parts) > 0


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_any_number_of_ranks_gives_the_bits_of_one_through_many_builds(dtype: torch.dtype) -> None:
    given = small("all", dtype)
    one = run(given, 1, 120)
    assert one.counters()["builds"] >= 10
    for ranks in (*range(2, 9), 64):
        several = run(given, ranks, 120)
        assert_equal(several, one)
        parts = several.rank_counts()
        assert len(parts) == ranks
        assert sum(part["points"] for part in parts) == one.count
        assert sum(part["homes"] for part in parts) == one.counters()["homes"]
        assert max(part["points"] for part in parts) < one.count
    empty = [part for part in parts if part["points"] == 0]
    assert empty and all(part["slots"] == 0 for part in empty)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("parent", [[0, 1, 2], [0, 0, 1], [0, 0, 0]], ids=str)
def test_sparse_points_that_drift_keep_the_bits(parent: list[int], seed: int) -> None:
    """What a home reaches is its own affair; which fields meet or move as one is everybody's."""
    given = dust(torch.float32, seed)
    given["parent"] = torch.tensor(parent, dtype=torch.int32)
    given["cut"] = torch.zeros(3, dtype=torch.int32)
    if seed == 2:
        given["objects"], given["radius"] = given["parent"], torch.full((300,), 0.5 * DX)
    one = run(given, 1, 50)
    assert (one.counters()["contact_nodes"] > 0) == (len(set(parent)) > 1) or seed == 2
    for ranks in (2, 7):
        assert_equal(run(given, ranks, 50), one)


def test_a_point_counts_at_a_shared_block_that_its_home_does_not_reach() -> None:
    """It comes next to a block that only another rank's points need, and two fields meet there."""
    given = small("elastic")
    here = [[0.95, y, 1.5] for y in (1.2, 1.5, 1.8)]  # in cells; goes to the right
    there = [[5.05, 1.3, 1.4], [5.05, 1.6, 1.4], [5.08, 1.4, 1.7], [5.08, 1.7, 1.7]]
    speed = torch.tensor([[2.0, 0.0, 0.0]] * 3 + [[-2.0, 0.0, 0.0]] * 2 + [[-2.6, 0.0, -0.5]] * 2)
    few = {name: value[:7] if isinstance(value, torch.Tensor) and value.shape[0] > 7 else value
           for name, value in given.items()} | {
        "position": DX * (torch.tensor(here + there, dtype=torch.float64) + 0.5),
        "velocity": speed.double(), "strain": torch.zeros(7, 6, dtype=torch.float64),
        "body": torch.tensor([0] * 5 + [1] * 2, dtype=torch.int32),
        "colliders": None, "gravity": (0.0, 0.0, 0.0), "frame": (0.0, 0.0, 0.0),
    }  # fmt: skip
    one, two = (run(few, ranks, 6, dt=1e-3) for ranks in (1, 2))
    assert [part["points"] for part in two.rank_counts()] == [3, 4]
    assert two.counters()["builds"] == 1 and two.counters()["contact_nodes"] > 0
    assert_equal(two, one)


def test_two_bodies_that_meet_at_the_cut_are_held_by_a_rank_each() -> None:
    given = side_by_side(torch.float32)
    two = run(given, 2)
    half = two.count // 2
    # but for points that share a block with the other body
    assert all(abs(part["points"] - half) < 8 for part in two.rank_counts())
    assert two.counters()["contact_nodes"] > 0


def test_points_push_those_of_another_rank() -> None:
    given = pressed(torch.float32)
    two = run(given, 2)
    assert all(abs(part["points"] - two.count // 2) < 64 for part in two.rank_counts())
    given["objects"] = torch.zeros(2, dtype=torch.int32)
    assert not torch.equal(run(given, 2).velocity, two.velocity)


def test_the_cut_is_across_the_longest_axis() -> None:
    """A column shares the same few blocks whichever way it stands."""
    given = small("elastic", torch.float32) | {"colliders": None, "gravity": (0.0, 0.0, 0.0)}
    step = 5 * DX * torch.arange(6, dtype=torch.float64)[:, None, None]
    for name in ("velocity", "mass", "volume", "alpha", "material", "strain", "body"):
        given[name] = given[name].repeat(6, *[1] * (given[name].dim() - 1))
    shared = []
    for axis in range(3):
        away = step * torch.eye(3, dtype=torch.float64)[axis]
        column = (given["position"] + away).reshape(-1, 3)
        two = run(given | {"position": column}, 2, 1)
        shared.append(two.rank_counts()[0]["shared"])
        assert shared[-1] < 0.35 * two.counters()["slots"]
    assert max(shared) < 1.5 * min(shared)


def test_a_build_cuts_anew() -> None:
    given = small("two bodies", torch.float32)
    solver = run(given, 3, 1)
    before = solver.rank_counts()
    solver.advance(steps=80)
    assert solver.rank_counts() != before


def test_order_of_points_and_threads_leave_no_trace() -> None:
    given = scene(cells=8, bodies=2, laws=(0, 1), dtype=torch.float32)
    mixed, order = shuffled(given)
    one = run(given, 1, 20)
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        several = run(mixed, 5, 20)
    finally:
        torch.set_num_threads(before)
    assert torch.equal(several.position, one.position[order])
    assert torch.equal(several.impulse, one.impulse)


def test_room_for_blocks_grows_and_going_back_leave_no_trace() -> None:
    given = small("two bodies", torch.float32)
    one = run(given, 1)
    tight = ops.Solver(**given, ranks=3)
    tight._whole.reserve_blocks(int(tight.clock()["homes"]), 1, 2)
    start = tight.snapshot()
    for _ in range(2):
        tight.advance(steps=STEPS)
        assert torch.equal(tight.position, one.position)
        assert torch.equal(tight.velocity, one.velocity)
        tight.restore(start)


def test_the_same_failure_at_the_same_step() -> None:
    given = small("two bodies", torch.float32)
    told = []
    for ranks in (1, 4):
        with pytest.raises(ops.SolverError) as failure:
            run(given, ranks, dt=6e-3)
        told.append(str(failure.value))
    assert told[0] == told[1]


@pytest.mark.parametrize("ranks", [0, -1, 65, 2.0, True, "2"])
def test_a_number_of_ranks_that_is_none_is_refused(ranks: Any) -> None:
    with pytest.raises(InputError, match="ranks must be a whole number of 1 to 64"):
        ops.Solver(**small("elastic"), ranks=ranks)


@pytest.mark.parametrize(
    "named, why",
    [
        (["cpu", "cpu"], "devices must be CUDA devices, got cpu"),
        (["moon"], "'moon' is no device"),
        ([], "devices is empty"),
        (["cuda:99"], "cuda:99 is not there; this machine has"),
    ],
)
def test_devices_that_are_none_are_refused(named: list[str], why: str) -> None:
    with pytest.raises(InputError, match=why):
        ops.Solver(**small("elastic"), devices=named)


def test_devices_that_cannot_reach_each_other_are_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pair, home = ["cuda:0", "cuda:1"], torch.device("cuda:0")
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 3)
    monkeypatch.setattr(torch.cuda, "can_device_access_peer", lambda a, b: True)
    monkeypatch.delenv("PYTORCH_CUDA_ALLOC_CONF", raising=False)
    assert solver_ranks.check_devices(pair, home) == [torch.device(name) for name in pair]
    with pytest.raises(InputError, match="the points lie on cuda:2"):
        solver_ranks.check_devices(pair, torch.device("cuda:2"))
    monkeypatch.setattr(torch.cuda, "can_device_access_peer", lambda a, b: False)
    with pytest.raises(InputError, match="cuda:0 cannot reach the memory of cuda:1"):
        solver_ranks.check_devices(pair, home)
    monkeypatch.setenv("PYTORCH_CUDA_ALLOC_CONF", "expandable_segments:True")
    with pytest.raises(InputError, match="expandable segments"):
        solver_ranks.check_devices(pair, home)


def test_what_ranks_do_not_know_is_refused_by_name() -> None:
    row = parameters(1e5, 0.3, 1.0, c2=1.0, c3=0.04, c4=0.02, c5=PHASE_CODES[0])
    given = of_law(9, row)(torch.float32)
    with pytest.raises(InputError, match=r"2 ranks do not know law phase_field \(9\) yet"):
        ops.Solver(**given, ranks=2)
    ops.Solver(**given, ranks=1)


@pytest.mark.parametrize(
    "answer, why",
    [
        (False, "no step on cuda:0, cuda:1 was finished in 0"),
        (RuntimeError("gone"), "failed: gone"),
    ],
)
def test_a_device_that_does_not_answer_is_an_error(
    answer: Any, why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    solver = ops.Solver(**small("elastic"))
    parts = object.__new__(solver_ranks.Parts)
    parts.whole, parts.devices = solver._whole, (torch.device("cuda:0"), torch.device("cuda:1"))
    event = MagicMock()
    event.query.side_effect = itertools.repeat(answer) if answer is False else answer
    monkeypatch.setattr(torch.cuda, "Event", lambda: event)
    for name in ("Stream", "stream", "current_stream"):
        monkeypatch.setattr(torch.cuda, name, MagicMock())
    monkeypatch.setattr(solver_ranks, "PATIENCE", 0.0)
    with pytest.raises(GsfluentError, match=why):
        parts._wait()


def test_nothing_is_cut_before_a_step() -> None:
    with pytest.raises(InputError, match="before a step"):
        ops.Solver(**small("elastic"), ranks=2).rank_counts()


@pytest.mark.parametrize("name", ["free", "two bodies", "relaxing", "flip", "objects"])
def test_points_that_come_and_go_some_at_a_time_keep_the_bits(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = CASES[name](torch.float32)
    whole = [run(given, ranks) for ranks in (1, 3)]
    monkeypatch.setattr(layout, "CHUNK", 37)
    for ranks, want in zip((1, 3), whole, strict=True):
        some = ops.Solver(**given, ranks=ranks)
        assert torch.equal(some._whole.id, ops.Solver(**given)._whole.id)
        some.advance(steps=STEPS)
        assert_equal(some, want)
        for value in ("position", "body", "stress", "alpha", "peak"):
            assert torch.equal(getattr(some, value), getattr(want, value)), value
    seen = torch.cat([index for index, _ in some.chunks("position")])
    assert torch.equal(seen.sort().values, torch.arange(some.count))
    with pytest.raises(InputError, match="there is no 'colour' here"):
        next(some.chunks("colour"))


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_each_device_gets_a_stretch_of_points_from_host_memory(
    dtype: torch.dtype, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As ranks on CUDA hold them, in planes, but on a CPU, where nothing steps them."""
    monkeypatch.setattr(layout, "CHUNK", 100)
    given = relaxing(dtype) | {"frame": (0.25, 0.0, -0.5), "colliders": None}
    want = ops.Solver(**given)
    solver = ops.Solver(**given)
    n, cpu = solver.count, torch.device("cpu")
    widths = {name: width for name, width in layout.ON_DEVICE.items() if name in want._widths}
    solver._widths = widths | layout.SCRATCH
    solver._whole.reserve_points(want._widths, 0)
    solver._whole.meta = solver._whole.slope = solver._whole.meta.new_zeros(0)
    parts = solver_ranks.Parts(
        solver._whole, [cpu] * 4, solver.fields, solver._widths, *solver._settings()
    )
    solver._parts = parts
    more = {name: given[name] for name in ("strain", "alpha", "viscous", "peak", "deformation")
            if given.get(name) is not None}  # fmt: skip
    rows = (want._rows(given.get("material"), given["mass"], given["volume"]))[0]
    solver._load(solver_points.Given(
        given["position"], given["velocity"], given["mass"], rows, given.get("body"), more,
        solver.frame, solver.dx,
    ))  # fmt: skip
    assert solver._whole.id.numel() == 0
    assert all(n / 4 <= part.id.numel() < 0.3 * n + 100 for part in parts.parts)
    assert [int(part.clock[layout.INDEX["homes"]]) for part in parts.parts] == [
        int((part.home_count0 > 0).sum()) for part in parts.parts
    ]
    for name in (*STATE, "viscous", "alpha", "peak", "body", "stress"):
        value = getattr(want, name)
        assert value is None or torch.equal(getattr(solver, name), value), name
    saved = solver.snapshot()
    for part in parts.parts:
        part.reserve_points(solver._widths, n)
        part.velocity.zero_()
    solver.restore(saved)
    assert torch.equal(solver.velocity, want.velocity)


def test_room_for_more_points_keeps_those_that_are_there() -> None:
    for width in (1, 4, 6, 9, 12):
        values = torch.arange(7 * width, dtype=torch.float32).view(7, width)
        flat, order = torch.zeros(7 * width), torch.randperm(7)
        layout.put_rows(flat, width, order, values[order])
        for count in (9, 7, 5):
            room = layout.more_room(flat, width, count)
            kept = min(7, count)
            assert torch.equal(layout.get_rows(room, width, 0, kept), values[:kept])


def test_each_rank_has_room_for_its_share_and_gets_what_it_wants() -> None:
    """On a device the clock of a rank says how many points and homes a cut would give it."""
    solver = ops.Solver(**small("two bodies", torch.float32))
    whole, n, cpu = solver._whole, solver.count, torch.device("cpu")
    widths = {"id": 1, "offset": 4, "velocity": 12, "strain": 6} | layout.SCRATCH
    for name in ("id", "offset", "velocity", "strain", "spare"):
        setattr(whole, name, getattr(whole, name).new_zeros(0))
    parts = solver_ranks.Parts(whole, [cpu] * 4, solver.fields, widths, *solver._settings())
    homes = int(solver.clock()["homes"])
    for part in parts.parts:
        part.reserve_points(widths, parts.room(n // 4))
    parts.reserve(homes, [homes // 4, homes // 4, 200, 0])
    assert all(n // 4 <= part.id.numel() < 0.3 * n + 100 for part in parts.parts)
    assert parts.parts[2].home_start0.numel() == 200  # listed, though not its share
    assert parts.parts[3].home_start0.numel() < 100
    first, second = parts.parts[:2]
    first.id += 7
    clock = first.clock
    clock[layout.INDEX["cursor"]], clock[layout.INDEX["wanted_homes"]] = n // 2, 300
    clock[layout.INDEX["grow"]] = 1
    before, homes = second.id.numel(), first.home_start0.numel()
    assert homes < 300
    parts.grow()
    assert first.id.numel() >= n // 2 and first.offset.numel() == 4 * first.id.numel()
    assert bool((first.id[:before] == 7).all())
    assert first.home_start0.numel() >= 300 and first.neighbour.shape[0] >= 300
    assert second.id.numel() == before
    assert int(first.clock[layout.INDEX["grow"]]) == 0
