"""Labels of voxels, the largest of many fields, the nearest points: against tables of all pairs.

Sums over boxes, value noise and distances: against their references, bit by bit.
"""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from gsfluent import geometry, ops
from gsfluent.ops.reference import spatial as reference
from gsfluent.spatial.neighbours import grid_search

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


def celled(points: Tensor, low: Tensor, cell: float) -> tuple[Tensor, Tensor, Tensor]:
    x, y, z = (((points - low) / cell).long() + 1).unbind(dim=1)
    key, order = (((x << 20) + y << 20) + z).sort(stable=True)
    keys, counts = torch.unique_consecutive(key, return_counts=True)
    return order, torch.cat([counts.new_zeros(1), counts.cumsum(0)]), keys


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("count", [1, 5, 40])
def test_the_nearest_points_of_the_cells_around(device: str, count: int) -> None:
    points = torch.rand(150, 3, generator=draw(4), dtype=torch.float64)
    points[:60] = (8.0 * points[:60]).round() / 8.0  # ties, and points in the same place
    queries = torch.cat([points[:40], torch.rand(40, 3, generator=draw(5), dtype=torch.float64)])
    low, cell = torch.zeros(3, dtype=torch.float64), 0.17
    parts = [part.to(device) for part in (points, queries, *celled(points, low, cell))]
    got = ops.nearest_in_cells(*parts, low.tolist(), cell, count)
    same(got, reference.nearest_in_cells(points, queries, low.tolist(), cell, count))


@pytest.mark.parametrize("device", DEVICES)
def test_rows_that_are_none_are_left_out(device: str) -> None:
    """Whatever the tensors of the cells hold, nothing is read beyond the points."""
    points = torch.rand(20, 3, generator=draw(6), dtype=torch.float64)
    order, start, keys = celled(points, torch.zeros(3, dtype=torch.float64), 0.5)
    order[3], order[7], start[-1] = 1 << 40, -5, 1 << 50
    parts = [part.to(device) for part in (points, points, order, start, keys)]
    square, rows = ops.nearest_in_cells(*parts, [0.0, 0.0, 0.0], 0.5, 30)
    assert bool(((rows >= 0) & (rows < 20)).all())
    assert int(square.isinf().sum()) >= 20 * 12
    far = torch.tensor([[torch.nan, 0.0, 0.0], [-9e9, 0.0, 0.0], [1e300, 0.0, 0.0]])
    parts[1] = far.double().to(device)
    assert bool(ops.nearest_in_cells(*parts, [0.0, 0.0, 0.0], 0.5, 2)[0].isinf().all())


@pytest.mark.parametrize("device", DEVICES)
def test_a_search_by_cells_finds_what_a_table_finds(device: str) -> None:
    points = torch.rand(200, 3, generator=draw(7), dtype=torch.float64)
    queries = 3.0 * torch.rand(60, 3, generator=draw(8), dtype=torch.float64) - 1.0
    distance, rows = grid_search(points.to(device), queries.to(device), 4, 0.01)
    wanted, expected = torch.cdist(queries, points).sort(dim=1)
    assert torch.allclose(distance.cpu(), wanted[:, :4], atol=1e-12)
    assert torch.equal(rows.cpu(), expected[:, :4])


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
        ops.nearest_in_cells(place, place, rank, rank[:1], rank[:0], [0.0] * 3, 0.0, 1)
    with pytest.raises(ValueError, match="count"):
        ops.nearest_in_cells(place, place, rank, rank[:1], rank[:0], [0.0] * 3, 1.0, 0)
    with pytest.raises(ValueError, match="start"):
        ops.nearest_in_cells(place, place, rank, rank, rank[:0], [0.0] * 3, 1.0, 1)


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
