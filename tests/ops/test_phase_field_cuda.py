"""Phase-field matter on a GPU: the resident solver against the CPU's and the composed operators."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from phase_scenes import assert_kept, meeting, on, plates, shuffled, stepped
from torch import Tensor

from gsfluent import has_cuda, ops
from gsfluent.errors import InputError

pytestmark = [
    pytest.mark.cuda,
    pytest.mark.skipif(not has_cuda(), reason="needs a GPU and gsfluent's CUDA kernels"),
]
DT = 2e-4
NAMES = ("position", "velocity", "strain", "alpha", "peak")
MODELS = [
    ("at1", "none", False),
    ("at1", "volumetric", True),
    ("at2", "spectral", False),
    ("at1", "rankine", False),
]


def error(have: Tensor, want: Tensor) -> float:
    return float((have.cpu().double() - want.double()).abs().max() / want.double().abs().max())


def run(given: dict[str, Any], steps: int, dt: float | None = DT) -> ops.Solver:
    solver = ops.Solver(**given, dt=dt)
    solver.advance(steps=steps)
    return solver


@pytest.mark.parametrize("dtype, bar", [(torch.float64, 1e-10), (torch.float32, 1e-5)])
@pytest.mark.parametrize(("model", "split", "more"), MODELS)
def test_the_solver_does_what_it_does_on_the_cpu(
    model: str, split: str, more: bool, dtype: torch.dtype, bar: float
) -> None:
    given = plates(dtype, model, split, more)
    want, have = run(given, 30), run(on("cuda", given), 30)
    assert float(want.peak.max()) > 0.0
    for name in NAMES:
        assert error(getattr(have, name), getattr(want, name)) <= bar, name


@pytest.mark.parametrize(("model", "split", "more"), MODELS)
def test_the_composed_operators_agree(model: str, split: str, more: bool) -> None:
    given = on("cuda", plates(torch.float64, model, split, more))
    want, have = stepped(given, DT, 30), run(given, 30)
    own = given["material"] == 0  # elastic points keep the alpha that they had
    for name, value in want.items():
        rows = own if name in ("alpha", "peak") else slice(None)
        assert error(getattr(have, name)[rows], value[rows].cpu()) <= 1e-9, name


@pytest.mark.parametrize("dtype, bar", [(torch.float64, 1e-9), (torch.float32, 1e-4)])
def test_bodies_that_touch_crack_each_for_itself(dtype: torch.dtype, bar: float) -> None:
    given = meeting(dtype)
    want, have = run(given, 40), run(on("cuda", given), 40)
    assert have.counters()["contact_nodes"] > 0 and have.counters()["builds"] > 1
    assert float(want.peak.max()) > 0.0
    for name in NAMES:
        assert error(getattr(have, name), getattr(want, name)) <= bar, name
    # its unit holds speeds of 8e6 m/s; sums of float32 stresses stand behind it
    assert error(have.impulse, want.impulse) <= max(1e-6, 0.1 * bar)


def test_no_damage_goes_through_contact() -> None:
    given = meeting(torch.float32)
    strong = given["params"].clone()
    strong[:, 2] *= 1e4  # its threshold
    given["params"] = torch.cat([given["params"], strong])
    given["law"], given["material"] = given["law"].repeat(2), given["body"]
    solver = run(on("cuda", given), 60)
    peak, upper = solver.peak.cpu(), given["body"] == 1
    assert solver.counters()["contact_nodes"] > 0
    assert float(peak[~upper].max()) > 0.0
    assert float(peak[upper].max()) == -1.0


def test_same_bits_for_any_run_and_any_order() -> None:
    given = on("cuda", meeting(torch.float32))
    first = run(given, 200, None)
    assert float(first.peak.max()) > 0.0
    order = torch.randperm(given["mass"].shape[0], generator=torch.Generator().manual_seed(3))
    for other, at in (
        (run(given, 200, None), slice(None)),
        (run(shuffled(given, order), 200, None), order.cuda()),
    ):
        for name in NAMES:
            assert torch.equal(getattr(other, name), getattr(first, name)[at]), name


def test_what_is_saved_goes_on_as_it_would_have() -> None:
    solver = run(on("cuda", meeting(torch.float32)), 60, None)
    saved = solver.snapshot()
    solver.advance(steps=60)
    want = {name: getattr(solver, name) for name in NAMES}
    solver.advance(steps=30)
    solver.restore(saved)
    solver.advance(steps=60)
    for name, value in want.items():
        assert torch.equal(getattr(solver, name), value), name


def test_rounds_leave_the_field_out_until_it_is_wanted() -> None:
    given = on("cuda", plates(torch.float64))
    strong = given | {"params": given["params"].clone()}
    strong["params"][:, 2] *= 1e4  # its threshold
    whole = run(strong, 30)
    assert whole.clock()["quiet"] and float(whole.peak.max()) == -1.0
    have, always = ops.Solver(**given, dt=DT), ops.Solver(**given, dt=DT)
    assert have.clock()["quiet"]
    always._write(quiet=0)
    for solver in (have, always):
        solver.advance(steps=40)
    assert not have.clock()["quiet"] and float(have.peak.max()) > 0.0
    assert have.counters()["step"] == always.counters()["step"] == 40
    for name in NAMES:
        assert error(getattr(have, name), getattr(always, name).cpu()) <= 1e-10, name


def test_room_for_blocks_grows_while_it_cracks() -> None:
    given = on("cuda", plates(torch.float32))
    tight = ops.Solver(**given, dt=DT)
    tight._whole.reserve_blocks(int(tight.clock()["homes"]), 3, 1)
    tight.advance(steps=40)
    assert torch.equal(tight.peak, run(given, 40).peak)


def test_a_break_keeps_momentum_and_makes_no_energy() -> None:
    assert_kept(on("cuda", plates(torch.float32, split="volumetric")))


def test_several_ranks_do_not_know_it() -> None:
    with pytest.raises(InputError, match="phase_field"):
        ops.Solver(**on("cuda", plates(torch.float32)), ranks=2)
