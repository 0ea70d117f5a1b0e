"""Operators called with one argument spoilt: they answer or refuse, and never leave their arrays.

That they read and write only where they may is seen by the sanitizers (scripts/safety/sanitize.sh);
without them only a crash would end the tests.
"""

from __future__ import annotations

import math
import random
from typing import Any

import pytest
import torch
from test_collider import SDF, shape, somewhere
from test_mpm import DX, cloud, loaded, run_p2g
from test_plasticity import states, tables
from test_raster_registration import raw_arguments
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from gsfluent import ops

ROUNDS = 8  # of each argument
FLOATS = (math.nan, math.inf, -math.inf, 0.0, -1.0, 1e30, 1e-40)
INTS = (-(2**31), -(2**31) + 1, -1, 0, 1, 2**31 - 2, 2**31 - 1)
REFUSED = (RuntimeError, ValueError, TypeError, IndexError)
Call = tuple[Any, tuple[Any, ...]]


class Recorder(TorchDispatchMode):
    """Remembers the first call of each operator of gsfluent, with its arguments."""

    def __init__(self) -> None:
        super().__init__()
        self.calls: dict[str, Call] = {}

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func.namespace == "gsfluent":
            plain = tuple(a.detach().clone() if isinstance(a, Tensor) else a for a in args)
            self.calls.setdefault(func.name().split("::")[1], (func, plain))
        return func(*args, **(kwargs or {}))


@pytest.fixture(scope="module")
def calls() -> dict[str, Call]:
    """A valid call of each operator."""
    torch.manual_seed(0)
    lib = torch.ops.gsfluent
    with Recorder() as recorder:
        c = cloud(200, fields=2)
        c["position"].requires_grad_(True)
        blocks = ops.build_blocks(c["position"], DX)
        grid, moments = run_p2g(c, dx=DX, blocks=blocks, fields=2, contact=True, **loaded(c))
        rows = torch.stack([shape("sphere", mass=1.0, inertia=(1, 1, 1)), shape("box")])
        where = {"dx": DX, "dt": 0.1, "blocks": blocks}
        grid.square().sum().backward()
        grid, moments = grid.detach(), moments.detach()  # the definition's gradient is not followed
        v, *_ = ops.grid_update(grid, moments=moments, colliders=rows, sdf=SDF, **where)
        points, *_ = ops.g2p(v, c["position"], body=c["body"], velocity=c["velocity"], **where)
        points.sum().backward()
        s, t = states(30), tables()
        tail = (t["law"], t["params"], s["material"], 2.0, 0.1, True)
        e, alpha, stress, _ = lib.return_mapping(*s["args"], *tail)
        lib.return_mapping_adjoint(e, alpha, stress, alpha, *s["args"], *tail)
        lib.rasterize(*raw_arguments(12, True))[0].sum().backward()
        lib.collider_distance(somewhere(5), rows, SDF)
        lib.advance_colliders(rows, torch.randn(2, 6, dtype=torch.float64), 0.1, 0, 0, -9.81)
        lib.mvee(torch.randn(3, 9, 3), 1e-2, 100)
        nacc = torch.tensor([[1.0, 2.0, 1.5, 0.3, 5.0, 0.0, 1.0, 0.0]], dtype=torch.float64)
        lib.softening_paths(nacc, *nacc.new_tensor([[-0.1], [0.3], [0.01]]), 30)
        lib.polar_clamped(torch.randn(9, 3, 3), 0.5, 2.0)
        lib.covariance_axes(torch.rand(9, 6))
        near, opened = torch.randint(0, 7, (7, 4)), torch.rand(7, 4) < 0.5
        splat = (torch.randn(9, 3), torch.randn(9, 4), torch.rand(9, 3))
        lib.cut_at_cells(*splat, torch.randint(0, 7, (9,)), near, opened, torch.randn(7, 3), 0.1)
        planes = (torch.randn(12, 3), torch.randn(12), torch.rand(12))
        lib.cut_by_planes(splat[0], splat[0], torch.rand(9, 6), torch.arange(10), *planes)
        lib.quats_to_matrices(splat[1])
        lib.matrices_to_quats(torch.randn(9, 3, 3))
        lib.quat_products(splat[1], splat[1])
        flags = (opened, opened, opened)
        lib.link_states(
            splat[0], torch.rand(7, 4), near, torch.randint(-1, 3, (9,), dtype=torch.int32),
            torch.rand(9) < 0.5, *flags, 1.2, 1.5, 1.1, 0.9,
        )  # fmt: skip
        pair = (torch.randint(0, 5, (9,)), torch.randint(0, 5, (9,)))
        lib.margin_counts(torch.rand(9), *pair, torch.rand(5, dtype=torch.float64), 0.2)
        places = (torch.randn(9, 3), torch.randint(0, 7, (9,)), torch.rand(9), torch.randn(9, 3))
        faces = (*places, torch.rand(9), near, opened, torch.randn(7, 3), [0.5] * 9)
        lib.find_faces(torch.randint(0, 9, (12,)), *faces)
        lib.face_elements(torch.randint(0, 9, (12,)), torch.randint(0, 5, (12,)), *faces)
        lib.splat_bulk(torch.rand(50, 3), torch.rand(50, 3))
        picture = torch.rand(32, 32, 3)
        lib.ssim(picture, picture.flip(1), True)
    return recorder.calls


NAMES = (
    "build_blocks p2g grid_update g2p p2g_adjoint transfer_slope return_mapping "
    "return_mapping_adjoint rasterize rasterize_backward collider_distance advance_colliders mvee "
    "polar_clamped covariance_axes cut_at_cells cut_by_planes "
    "quats_to_matrices matrices_to_quats quat_products link_states "
    "margin_counts find_faces face_elements splat_bulk ssim softening_paths"
).split()


@pytest.mark.parametrize("name", NAMES)
def test_a_spoilt_argument_is_survived(name: str, calls: dict[str, Call]) -> None:
    func, args = calls[name]
    chance = random.Random(name)
    answered = refused = 0
    for place, given in enumerate(args):
        for _ in range(ROUNDS):
            spoilt = [a.clone() if isinstance(a, Tensor) else a for a in args]
            spoilt[place] = spoil(given, chance)
            try:
                func(*spoilt)
                answered += 1
            except REFUSED as error:
                assert str(error)
                refused += 1
    assert answered and refused
    func(*args)  # and what was good is good


def spoil(value: Any, chance: random.Random) -> Any:
    """Another value that a caller might give."""
    if isinstance(value, Tensor):
        return spoil_tensor(value, chance)
    if isinstance(value, bool) or value is None:
        return value
    if isinstance(value, int):  # no sizes that only fill the memory
        return chance.choice([-(2**31), -1, 0, 1, value + 1])
    if isinstance(value, float):
        return chance.choice(FLOATS)
    return [chance.choice([*INTS, each]) for each in value]


def spoil_tensor(value: Tensor, chance: random.Random) -> Tensor:
    kind = chance.choice(("some", "some", "all", "short", "none", "narrow", "strided", "type"))
    if value.numel() == 0 or value.ndim == 0:
        return value.new_zeros(3)
    if kind in ("some", "all"):
        bad = chance.choice(FLOATS if value.is_floating_point() else INTS)
        spoilt = value.clone().flatten()
        spoilt[:: 1 if kind == "all" else chance.randrange(1, 1 + spoilt.numel())] = bad
        return spoilt.view(value.shape)
    if kind == "strided":
        return torch.stack([value, value], dim=-1)[..., 0]
    if kind == "type":
        return value.to(torch.int32 if value.is_floating_point() else torch.int64)
    return {"short": value[:-1], "none": value[:0], "narrow": value[..., :-1]}[kind].clone()
