"""The resident solver refuses what it cannot run, before it runs."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from solver_scenes import scene

from gsfluent import ops
from gsfluent.errors import InputError

NAN = math.nan


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"friction": NAN}, "friction"),
        ({"restitution": 1.5}, "restitution"),
        ({"contact_gap": -1.0}, "contact_gap"),
        ({"gradient_limit": 0.0}, "gradient_limit"),
        ({"epsilon": 1.0}, "epsilon"),
        ({"k": -1.0}, "k must"),
        ({"frame": (0.0, NAN, 0.0)}, "frame must be three finite"),
        ({"frame": (1.0, 0.0, 0.0)}, "frame must be 0 where there are colliders"),
        ({"colliders": torch.full((1, 32), NAN)}, "colliders row 0"),
        ({"params": torch.tensor([[NAN, 1.0, 0, 0, 0, 0, 1e3, 0]])}, "mu"),
        ({"params": torch.tensor([[1e4, -1.0, 0, 0, 0, 0, 1e3, 0]])}, "kappa"),
        ({"params": torch.tensor([[1e4, 1e4, 0, 0, 0, 0, 0.0, 0]])}, "density"),
    ],
)
def test_arguments_out_of_range_are_refused(change: dict[str, Any], match: str) -> None:
    given = scene(cells=2, dtype=torch.float32)
    with pytest.raises(ValueError, match=match):
        ops.Solver(**(given | change))


def test_the_grid_goes_along_with_the_heaviest_body_and_the_state_is_the_observers() -> None:
    given = scene(cells=4) | {"colliders": None, "gravity": (0.0, 0.0, 0.0)}
    half = torch.arange(len(given["mass"])) < len(given["mass"]) // 8  # a light body of its own
    given["body"] = (~half).int()
    given["velocity"] = torch.zeros_like(given["velocity"])
    given["velocity"][:, 1] = 2.0
    given["velocity"][half, 0] = 30.0
    solver = ops.Solver(**given)
    light, heavy = (float(given["mass"][rows].sum()) for rows in (half, ~half))
    share = light**2 / (light**2 + heavy**2)
    assert solver.frame.tolist() == pytest.approx([30.0 * share, 2.0, 0.0], rel=1e-6)
    mixed = torch.randperm(len(half), generator=torch.Generator().manual_seed(0))
    other = {
        k: v[mixed] if isinstance(v, torch.Tensor) and len(v) == len(half) else v
        for k, v in given.items()
    }
    assert torch.equal(ops.Solver(**other).frame, solver.frame)
    torch.testing.assert_close(solver.velocity, given["velocity"])
    still = ops.Solver(**given, frame=(0.0, 0.0, 0.0))
    for each in (solver, still):
        each.advance(1e-4)
    torch.testing.assert_close(solver.position, still.position, atol=1e-3 * solver.dx, rtol=0)
    moved = (given["mass"][:, None] * (solver.velocity - given["velocity"])).sum(dim=0)
    assert float(moved.abs().max()) < 1e-12 * heavy


def test_the_largest_field_runs_and_the_next_is_refused() -> None:
    given = scene(cells=2, dtype=torch.float32)
    given["body"] = given["body"] + 4093
    ops.Solver(**given).advance(steps=1)
    given["body"] = given["body"] + 1
    with pytest.raises(ValueError, match="body must lie in 0 to 4093"):
        ops.Solver(**given)


@pytest.mark.parametrize("value", [0.0, -1.0, NAN, math.inf])
def test_a_time_step_scale_that_is_none_is_refused(value: float) -> None:
    solver = ops.Solver(**scene(cells=2, dtype=torch.float32))
    with pytest.raises(ValueError, match="dt_scale"):
        solver.dt_scale = value


def test_a_sphere_that_is_none_is_refused_between_calls() -> None:
    solver = ops.Solver(**scene(cells=2, dtype=torch.float32))
    rows = solver.colliders
    rows[0, 0] = 1.0  # a sphere without a radius
    with pytest.raises(ValueError, match="set_colliders"):
        solver.set_colliders(rows)


def test_values_of_one_look_are_those_of_many() -> None:
    given = scene(cells=4)
    solver = ops.Solver(**given)
    solver.advance(steps=5)
    names = ("position", "body", "velocity", "affine", "strain", "alpha", "peak", "stress")
    for name, value in zip(names, solver.values(*names), strict=True):
        assert solver.holds(name) and torch.equal(value, getattr(solver, name)), name
    assert not torch.equal(solver.values("position")[0], given["position"])
    assert not solver.holds("deformation") and not solver.holds("colour")
    with pytest.raises(InputError, match="deformation"):
        solver.values("position", "deformation")
    assert solver.values() == ()


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
@pytest.mark.parametrize("kind", ["one row", "rows without points", "two masses in a row"])
def test_rows_found_without_a_sort_move_points_alike(
    device: str, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = scene(cells=3, bodies=2, laws=(0, 1), dtype=torch.float32, device=device)
    if kind == "one row":
        given |= {"material": None, "law": given["law"][1:], "params": given["params"][1:]}
    elif kind == "rows without points":
        given["law"] = given["law"].repeat_interleave(3)
        given["params"] = given["params"].repeat_interleave(3, 0)
        given["material"] = 3 * given["material"] + 1
    else:
        given["mass"][::2] *= 0.5
    found = []
    for sorts in (False, True):
        if sorts:
            monkeypatch.setattr(ops.Solver, "_alike", lambda *given: None)
        solver = ops.Solver(**given)
        solver.advance(steps=20)
        rows = solver._rows(given["material"], given["mass"], given["volume"])
        found.append((*solver.values("position", "velocity", "strain", "alpha"), *rows))
    for one, other in zip(*found, strict=True):
        assert torch.equal(one, other)
