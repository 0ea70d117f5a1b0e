"""Labels of voxels, the largest of many fields, the nearest points: against tables of all pairs.

Sums over boxes, value noise and distances: against their references, bit by bit.
"""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from gsfluent import geometry, ops
from gsfluent.ops.reference import spatial as reference

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)]
SHAPE = (11, 9, 14)


def draw(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def same(got: tuple[Tensor, ...], wanted: tuple[Tensor, ...]) -> None:
    assert all(torch.equal(a.cpu(), b) for a, b in zip(got, wanted, strict=True))


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("radius", [0.0, 1.3, 4.4])
def test_voxels_have_the_label_of_their_nearest_point(device: str, radius: float) -> None:
    size = torch.tensor(SHAPE).double()
    place = torch.rand(90, 3, generator=draw(0), dtype=torch.float64) * (size + 6.0) - 3.0
    place[:30] = place[:30].round()  # many as near as others
    rank = torch.randint(0, 32000, (90,), generator=draw(1))
    got = ops.nearest_labels(place.to(device), rank.to(device), SHAPE, radius)
    assert torch.equal(got.cpu(), reference.nearest_labels(place, rank, SHAPE, radius))
    order = torch.randperm(90, generator=draw(2))
    again = ops.nearest_labels(place[order].to(device), rank[order].to(device), SHAPE, radius)
    assert torch.equal(got, again)


@pytest.mark.parametrize("device", DEVICES)
def test_points_that_are_nowhere_name_nothing(device: str) -> None:
    place = torch.tensor([[torch.nan, 1.0, 1.0], [1e300, 0.0, 0.0], [-1e12, 2.0, 2.0]])
    got = ops.nearest_labels(place.double().to(device), torch.arange(3).to(device), (4, 4, 4), 9.0)
    assert bool((got == -1).all())
    assert ops.nearest_labels(place[:0].double(), torch.arange(0), (0, 3, 3), 1.0).shape == (
        0,
        3,
        3,
    )


def some_fields(count: int) -> tuple[Tensor, Tensor]:
    """Boxes here and there, half of whose shares are nothing; the last four are no fields."""
    rows, parts, start = [], [], 0
    for n in range(count):
        low = torch.randint(-2, 8, (3,), generator=draw(10 + n)).tolist()
        size = torch.randint(1, 7, (3,), generator=draw(100 + n)).tolist()
        share = torch.rand(tuple(size), generator=draw(200 + n))
        share = torch.where(share < 0.5, 0.0, (16.0 * share).round() / 16.0)  # many are the same
        rows.append((*low, *size, start))
        parts.append(share.reshape(-1))
        start += share.numel()
    rows.append((0, 0, 0, 0, 0, 0, 0))
    rows.append((0, 0, 0, 9, 9, 9, start - 5))
    rows.append((0, 0, 0, 1 << 40, 1 << 40, 1 << 40, 3))
    rows.append((0, 0, 0, 2, 2, 2, -7))
    return torch.cat(parts), torch.tensor(rows)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("count", [1, 12, 300])
def test_the_two_largest_of_many_fields(device: str, count: int) -> None:
    shares, box = some_fields(count)
    got = ops.largest_shares(None, SHAPE, shares.to(device), box.to(device))
    same(got, reference.largest_shares(None, SHAPE, shares, box))
    place = 16.0 * torch.rand(700, 3, generator=draw(3)) - 3.0
    place[::7] = place[::7].round()
    place[5], place[6] = torch.nan, torch.inf
    got = ops.largest_shares(place.to(device), SHAPE, shares.to(device), box.to(device))
    same(got, reference.largest_shares(place, SHAPE, shares, box))


@pytest.mark.parametrize("device", DEVICES)
def test_no_fields_and_no_places(device: str) -> None:
    shares, box = some_fields(2)
    shares, box = shares.to(device), box.to(device)
    first, second, lead = ops.largest_shares(None, (2, 2, 2), shares[:0], box[:0])
    assert bool((first == -1).all() and (second == -1).all() and (lead == 0.0).all())
    got = ops.largest_shares(torch.zeros(0, 3, device=device), (2, 2, 2), shares, box)
    assert [part.shape for part in got] == [(0,)] * 3


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("count", [1, 5, 40, 200])
@pytest.mark.parametrize("cell", [1e-300, 0.01, 0.17, 30.0])
def test_the_nearest_points(device: str, count: int, cell: float) -> None:
    points = torch.rand(150, 3, generator=draw(4), dtype=torch.float64) - 0.5
    points[:60] = (8.0 * points[:60]).round() / 8.0  # ties, and points in the same place
    queries = 3.0 * torch.rand(40, 3, generator=draw(5), dtype=torch.float64) - 1.0
    queries = torch.cat([points[:40], queries, 1e9 * queries[:5]])
    given = [x.to(device) for x in (points, queries)]
    same(ops.nearest_points(*given, count, cell), reference.nearest_points(points, queries, count))
    group, asked = torch.arange(150) % 7 - 2, torch.arange(85) % 9 - 3
    some = {"group": group, "asked": asked, "reach": 0.6}
    there = {k: v.to(device) if torch.is_tensor(v) else v for k, v in some.items()}
    got = ops.nearest_points(*given, count, cell, **there)
    wanted = reference.nearest_points(points, queries, count, **some)
    assert bool((wanted[1] >= 0).any()) and bool((wanted[1] < 0).any())
    same(got, wanted)


@pytest.mark.parametrize("device", DEVICES)
def test_what_is_no_place_is_not_found_and_finds_nothing(device: str) -> None:
    points = torch.rand(20, 3, generator=draw(6), dtype=torch.float64, device="cpu")
    points[3], points[7, 1], points[9, 2] = torch.nan, torch.inf, -torch.inf
    queries = torch.tensor([[torch.nan, 0.0, 0.0], [0.0, torch.inf, 0.0], [0.5, 0.5, 0.5]])
    given = [x.double().to(device) for x in (points, queries)]
    away, rows = (x.cpu() for x in ops.nearest_points(*given, 20, 0.1))
    assert bool(away[:2].isinf().all()) and bool((rows[:2] == -1).all())
    assert sorted(rows[2, :17].tolist()) == [k for k in range(20) if k not in (3, 7, 9)]
    assert rows[2, 17:].tolist() == [-1] * 3
    none = ops.nearest_points(given[0][:0], given[1], 2, 0.1)
    assert bool(none[0].isinf().all()) and bool((none[1] == -1).all())
    assert ops.nearest_points(given[0], given[1][:0], 2, 0.1)[0].shape == (0, 2)


def test_arguments_that_fit_nothing_are_refused() -> None:
    place, rank = torch.zeros(2, 3, dtype=torch.float64), torch.zeros(2, dtype=torch.int64)
    with pytest.raises(ValueError, match="radius"):
        ops.nearest_labels(place, rank, (2, 2, 2), float("nan"))
    with pytest.raises(ValueError, match="three sizes"):
        ops.nearest_labels(place, rank, (2, 2), 1.0)
    with pytest.raises(TypeError, match="rank"):
        ops.nearest_labels(place, rank.float(), (2, 2, 2), 1.0)
    with pytest.raises(ValueError, match="at most 32767"):
        ops.largest_shares(None, (1, 1, 1), torch.zeros(1), torch.zeros(40000, 7).long())
    with pytest.raises(ValueError, match="cell"):
        ops.nearest_points(place, place, 1, 0.0)
    with pytest.raises(ValueError, match="count"):
        ops.nearest_points(place, place, 0, 1.0)
    with pytest.raises(ValueError, match="reach"):
        ops.nearest_points(place, place, 1, 1.0, reach=float("nan"))
    with pytest.raises(ValueError, match="go together"):
        ops.nearest_points(place, place, 1, 1.0, group=rank)
    with pytest.raises(ValueError, match="asked"):
        ops.nearest_points(place, place, 1, 1.0, group=rank, asked=rank[:1])


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("shape", [(11, 9, 14), (1, 1, 1), (2, 40, 3), (0, 3, 3)])
@pytest.mark.parametrize(("width", "times"), [(1, 3), (3, 1), (5, 2), (9, 3)])
def test_a_box_counts_what_it_holds(
    device: str, shape: tuple[int, int, int], width: int, times: int
) -> None:
    held = torch.rand(shape, generator=draw(5)) < 0.6
    got = ops.box_blur(held.to(device), width, times)
    assert torch.equal(got.cpu(), reference.box_blur(held, width, times))


def test_the_count_of_a_full_box_is_its_volume() -> None:
    got = ops.box_blur(torch.ones(30, 30, 30, dtype=torch.bool), 9)
    assert int(got[15, 15, 15]) == int(got.max()) == 9**9


@pytest.mark.parametrize("device", DEVICES)
def test_value_noise_rounds_alike_everywhere(device: str) -> None:
    voxels = torch.randint(-5000, 5000, (4000, 3), generator=draw(6))
    voxels[:50] = torch.cartesian_prod(torch.arange(50), torch.arange(1), torch.arange(1))
    given = [48.0, 3.0, 1.5], [0.37, -0.74, 1.11], [1.0, 0.3, 0.111]
    got = ops.value_noise(voxels.to(device), *given)
    assert torch.equal(got.cpu(), reference.value_noise(voxels, *given))
    assert float(got.abs().max()) <= 1.411 and float(got.mean().abs()) < 0.02
    nowhere = torch.tensor([[2**62, -(2**62), 0]], device=device)
    assert bool(torch.isfinite(ops.value_noise(nowhere, *given)).all())
    assert ops.value_noise(voxels[:0], [], [], []).shape == (0, 3)


def test_boxes_and_noise_say_what_is_wrong() -> None:
    held, voxels = torch.ones(3, 3, 3, dtype=torch.bool), torch.zeros(2, 3, dtype=torch.int64)
    for width in (0, 4, 11):
        with pytest.raises(ValueError, match="width must be odd"):
            ops.box_blur(held, width)
    with pytest.raises(ValueError, match="times must be 1 to 3"):
        ops.box_blur(held, 3, 4)
    with pytest.raises(TypeError, match="indicator"):
        ops.box_blur(held.int(), 3)
    with pytest.raises(ValueError, match="as many"):
        ops.value_noise(voxels, [1.0], [0.0, 0.0], [1.0])
    with pytest.raises(ValueError, match="positive"):
        ops.value_noise(voxels, [0.0], [0.0], [1.0])
    torch.library.opcheck(torch.ops.gsfluent.box_blur.default, (held.int(), 3, 3))
    torch.library.opcheck(torch.ops.gsfluent.value_noise.default, (voxels, [2.0], [0.0], [1.0]))


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("share", [0.3, 0.9, 0.99, 1.0])
@pytest.mark.parametrize("shape", [(7, 9, 5), (20, 3, 34), (1, 1, 17), (33, 1, 2), (18, 17, 16)])
def test_distances_to_the_nearest_empty_voxel(
    device: str, share: float, shape: tuple[int, int, int]
) -> None:
    occupied = torch.rand(shape, generator=draw(3)) < share
    wanted = reference.distance_transform(occupied)
    same(ops.distance_transform(occupied.to(device), indices=True), wanted)
    squared, none = ops.distance_transform(occupied.to(device))
    assert torch.equal(squared.cpu(), wanted[0])
    assert none.numel() == 0


@pytest.mark.parametrize("device", DEVICES)
def test_distances_of_large_grids_and_of_none(device: str) -> None:
    occupied = torch.ones(3, 300, 8192, dtype=torch.bool)
    occupied[2, 299, 8191] = False
    squared, index = ops.distance_transform(occupied.to(device), indices=True)
    assert int(squared[0, 0, 0]) == 2**2 + 299**2 + 8191**2
    assert bool((index == occupied.numel() - 1).all())
    empty, _ = ops.distance_transform(occupied[:0].to(device))
    assert empty.shape == (0, 300, 8192)


def test_distances_say_what_is_wrong() -> None:
    with pytest.raises(TypeError, match="occupied"):
        ops.distance_transform(torch.ones(3, 3, 3))
    with pytest.raises(ValueError, match="shape"):
        ops.distance_transform(torch.ones(3, 3, dtype=torch.bool))
    with pytest.raises(ValueError, match="8192"):
        ops.distance_transform(torch.ones(1, 1, 8193, dtype=torch.bool))
    held = torch.ones(4, 3, 5, dtype=torch.bool)
    for indices in (False, True):
        torch.library.opcheck(torch.ops.gsfluent.distance_transform.default, (held, indices))


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_values_between_those_of_a_grid(device: str, dtype: torch.dtype) -> None:
    grid = torch.randn(SHAPE, generator=draw(4), dtype=dtype)
    size = torch.tensor(SHAPE)
    place = torch.rand(5000, 3, generator=draw(5), dtype=dtype) * (size + 4) - 2.5
    place[:200] = place[:200].round()
    place[200:205] = torch.tensor([-1.0, -0.5, 1e8, -1e8, 3e9], dtype=dtype)[:, None]
    wanted = geometry.trilinear(grid, place)
    got = ops.trilinear(grid.to(device), place.to(device)).cpu()
    assert torch.equal(got, wanted)  # rounded alike
    nowhere = torch.full((3, 3), 1.0, dtype=dtype)
    nowhere[0, 1], nowhere[1, 2], nowhere[2, 0] = torch.nan, torch.inf, -torch.inf
    assert bool(ops.trilinear(grid.to(device), nowhere.to(device)).isnan().all())
    assert ops.trilinear(grid.to(device), place[:0].to(device)).shape == (0,)
    empty = ops.trilinear(grid[:0].to(device), place.nan_to_num().to(device)).cpu()
    assert torch.equal(empty, torch.zeros_like(empty))


def test_trilinear_says_what_is_wrong() -> None:
    grid, place = torch.zeros(3, 4, 5), torch.zeros(2, 3)
    with pytest.raises(TypeError, match="grid"):
        ops.trilinear(grid.long(), place)
    with pytest.raises(TypeError, match="place"):
        ops.trilinear(grid, place.double())
    with pytest.raises(ValueError, match="place"):
        ops.trilinear(grid, place[:, :2])
    torch.library.opcheck(torch.ops.gsfluent.trilinear.default, (grid, place))
