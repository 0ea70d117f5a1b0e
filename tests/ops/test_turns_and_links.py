"""Quaternions and matrices by one call each, and what of the links between points has parted."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from gsfluent import geometry
from gsfluent.ops import link_states
from gsfluent.ops.reference import deform as reference

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)]
DTYPES = [(torch.float32, 3e-6), (torch.float64, 1e-14)]


def rand(*shape: int, seed: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def by_torch(function: Any, *values: Tensor) -> Tensor:
    """What is worked out where a gradient is wanted: operation by operation."""
    out: Tensor = function(*(v.clone().requires_grad_() for v in values))
    assert out.requires_grad
    return out.detach()


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(("dtype", "bar"), DTYPES)
def test_turns_are_those_of_torch(device: str, dtype: torch.dtype, bar: float) -> None:
    quats = rand(6, 50, 4, seed=1)
    quats[0] *= 1e-4
    quats[1, 0] = torch.tensor([-1.0, 0.0, 0.0, 0.0])
    quats[1, 1:5] = torch.eye(4)  # the half turns, in which w is nothing
    quats = quats.to(device, dtype)
    for given in (quats, quats.transpose(0, 1), quats[2, 3], quats[:0]):
        matrix, want = (
            geometry.quaternion_to_matrix(given),
            by_torch(geometry.quaternion_to_matrix, given),
        )
        assert matrix.shape == want.shape and matrix.dtype == dtype
        torch.testing.assert_close(matrix, want, atol=bar, rtol=0)
        back, want = (
            geometry.matrix_to_quaternion(matrix),
            by_torch(geometry.matrix_to_quaternion, matrix),
        )
        assert back.shape == want.shape and back.dtype == dtype
        torch.testing.assert_close(back, want, atol=bar, rtol=0)
        other = given.flip(-1)
        both, want = (
            geometry.quaternion_multiply(given, other),
            by_torch(geometry.quaternion_multiply, given, other),
        )
        torch.testing.assert_close(both, want, atol=20 * bar, rtol=0)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("bad", [0.0, float("nan"), 1e-40])
def test_a_quaternion_without_direction_turns_nothing(device: str, bad: float) -> None:
    quats = torch.tensor([[1.0, 1.0, 0.0, 0.0], [bad, 0.0, 0.0, 0.0]], device=device)
    got, want = (
        geometry.quaternion_to_matrix(quats),
        by_torch(geometry.quaternion_to_matrix, quats),
    )
    assert torch.equal(got[1].cpu(), torch.eye(3)) and torch.equal(got[1], want[1])
    assert not torch.equal(got[0].cpu(), torch.eye(3))


def links(points: int = 300, later: int = 20) -> dict[str, Any]:
    """Points in four pieces and in none that have moved, and how they were at the last look."""
    rest = rand(points, 3, seed=2)
    near = torch.cdist(rest, rest).topk(6, largest=False).indices
    apart = (rest[near] - rest[:, None]).norm(dim=2)
    position = torch.cat([rest, rand(later, 3, seed=3)])
    position[:points] += 0.2 * rand(points, 3, seed=4)
    piece = torch.arange(points + later) % 5 - 1
    piece[: points // 2] = 0
    chance = torch.Generator().manual_seed(5)
    flags = torch.rand(4, points, 6, generator=chance) < 0.3
    return {
        "position": position, "apart": apart, "near": near, "piece": piece.int(), "none": flags[0],
        "broken": torch.rand(points + later, generator=chance) < 0.2,
        "before": (flags[1], flags[1] & flags[2]),
        "together": 2.0, "loose": 1.5, "open": 1.1, "back": 0.93,
    }  # fmt: skip


def on(values: dict[str, Any], device: str, dtype: torch.dtype) -> dict[str, Any]:
    def moved(value: Any) -> Any:
        if isinstance(value, tuple):
            return tuple(moved(part) for part in value)
        if not isinstance(value, Tensor):
            return value
        return value.to(device, dtype) if value.is_floating_point() else value.to(device)

    return {name: moved(value) for name, value in values.items()}


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("without", [(), ("before",), ("broken",), ("broken", "before")])
def test_links_part_as_defined(device: str, dtype: torch.dtype, without: tuple[str, ...]) -> None:
    given = {name: value for name, value in links().items() if name not in without}
    want = reference.link_states(**on(given, "cpu", dtype))
    got = link_states(**on(given, device, dtype))
    for flags, right in zip(got[:2], want[:2], strict=True):
        assert torch.equal(flags.cpu(), right) and 0.05 < right.float().mean() < 0.95
    torch.testing.assert_close(got[2].cpu(), want[2], atol=0.0, rtol=1e-5)
    assert (got[2][:, 0] == 1.0).all()  # a point and itself


@pytest.mark.parametrize("device", DEVICES)
def test_a_neighbour_that_is_no_row_counts_as_the_point(device: str) -> None:
    given = on(links(), device, torch.float64)
    given["near"][::2, 1:] = torch.tensor([-1, 300, 1 << 40, -(1 << 40), 1 << 60], device=device)
    parted, _, ratio = link_states(**given)
    assert (ratio[::2] == 1.0).all()
    assert torch.equal(parted[::2], given["none"][::2])
    assert (ratio[1::2, 1:] != 1.0).any()


def test_errors_empty_sets_and_registration() -> None:
    given = links(6, 0)
    with pytest.raises(ValueError, match="piece"):
        link_states(**given | {"piece": given["piece"][:5]})
    with pytest.raises(ValueError, match="position has 5 rows for 6 points"):
        link_states(**given | {"position": given["position"][:5]})
    with pytest.raises(TypeError, match="before"):
        link_states(**given | {"before": (given["none"], given["none"].int())})
    none = on(links(6, 0), "cpu", torch.float32)
    empty = {name: none[name][:0] for name in ("apart", "near", "none")}
    assert link_states(**none | empty | {"before": None})[2].shape == (0, 6)
    lib, names = torch.ops.gsfluent, ("test_schema", "test_faketensor")
    flat = (
        *(given[name] for name in ("position", "apart", "near", "piece", "broken")),
        *given["before"], given["none"], 1.2, 1.5, 1.1, 0.9,
    )  # fmt: skip
    torch.library.opcheck(lib.link_states.default, flat, test_utils=names)
    quats = rand(5, 4, seed=6)
    torch.library.opcheck(lib.quats_to_matrices.default, (quats,), test_utils=names)
    torch.library.opcheck(lib.matrices_to_quats.default, (rand(5, 3, 3, seed=7),), test_utils=names)
    torch.library.opcheck(lib.quat_products.default, (quats, quats), test_utils=names)
    with pytest.raises(NotImplementedError, match="no gradient"):
        lib.quats_to_matrices(quats.requires_grad_()).sum().backward()
