"""The partition of the rest solid: volumes, order, older faces, roughness, islands."""

from __future__ import annotations

import pytest
import torch
from partition_shapes import cube, points_of, slabs

from gsfluent.data import Frame
from gsfluent.geometry import trilinear
from gsfluent.ops import nearest_labels
from gsfluent.pipeline.matter.fragments import ranked
from gsfluent.pipeline.partition.blur import blur, box_width
from gsfluent.pipeline.partition.roughness import amplitude, displacement, displacements
from gsfluent.pipeline.partition.threshold import ISLAND, Labels, join_islands
from gsfluent.pipeline.partition.tree import Partition


def fresh(rest: torch.Tensor, spacing: float, rough: float = 0.15) -> Partition:
    return Partition(cube(), Frame.identity(), rest, spacing, 7, rough)


def test_a_blur_counts_what_its_box_holds() -> None:
    draw = torch.Generator().manual_seed(0)
    mask = torch.rand(9, 11, 10, generator=draw) < 0.4
    for width in (3, 5, 7):
        box = torch.ones(1, 1, width, width, width, dtype=torch.float64)
        wanted = mask.double()[None, None]
        for _ in range(3):
            wanted = torch.nn.functional.conv3d(wanted, box, padding=width // 2)
        assert torch.equal(blur(mask, width).double(), wanted[0, 0])
    assert [box_width(s) for s in (1.2, 1.5, 2.4, 3.6)] == [3, 3, 5, 7]
    with pytest.raises(ValueError, match="odd"):
        blur(mask, 4)


def test_trilinear_is_exact_on_what_is_linear() -> None:
    x, y, z = torch.meshgrid(*[torch.arange(6.0)] * 3, indexing="ij")
    place = 0.5 + 4.0 * torch.rand(50, 3, generator=torch.Generator().manual_seed(1))
    got = trilinear(2.0 * x - y + 0.5 * z, place)
    assert torch.allclose(got, place @ torch.tensor([2.0, -1.0, 0.5]), atol=1e-5)


def test_a_voxel_has_the_label_of_its_nearest_point() -> None:
    draw = torch.Generator().manual_seed(2)
    place = 12.0 * torch.rand(60, 3, generator=draw, dtype=torch.float64) - 1.0
    rank = torch.arange(60) % 5
    got = nearest_labels(place, rank, (10, 9, 11), 3.0)
    centers = torch.cartesian_prod(*[torch.arange(n).double() for n in (10, 9, 11)])
    apart = torch.cdist(centers, place)
    near, row = apart.min(dim=1)
    sure = (near - 3.0).abs() > 0.01  # squares are rounded to a thousandth
    wanted = torch.where(near <= 3.0, rank[row], -1)
    assert torch.equal(got.view(-1).long()[sure], wanted[sure])


@pytest.mark.parametrize("pieces", [2, 5])
def test_volumes_are_those_of_the_points_and_sum_exactly(pieces: int) -> None:
    rest, spacing = points_of(cube())
    _, rank = ranked(slabs(rest, pieces), rest)
    partition = fresh(rest, spacing)
    whole = partition.volume(7)
    ids = [7, *range(20, 19 + pieces)]
    split = partition.split(7, rest, rank, ids)
    volumes = torch.tensor([partition.volume(i) for i in ids]).double()
    assert int(volumes.sum()) == whole
    inside = partition.depth > 0.0
    assert [int((inside & (partition.region == i)).sum()) for i in ids] == volumes.tolist()
    share = torch.bincount(rank).double() / len(rank)
    assert float((volumes / whole / share - 1.0).abs().max()) < 0.01
    assert float(split.error.abs().max()) < 0.01


@pytest.mark.parametrize("radius", [0.9, 1.5])
def test_chips_keep_their_volume(radius: float) -> None:
    """A few points in the middle of a piece are a part of their own, with the volume they had."""
    rest, spacing = points_of(cube())
    chip = (rest - rest.mean(dim=0)).norm(dim=1) < radius * spacing
    assert 2 < int(chip.sum()) < 30
    partition = fresh(rest, spacing)
    whole = partition.volume(7)
    partition.split(7, rest, chip.long(), [7, 1])
    wanted = whole * int(chip.sum()) / len(rest)
    assert abs(partition.volume(1) - wanted) <= max(1.0, 0.01 * wanted)
    assert partition.volume(1) + partition.volume(7) == whole


def shape_of(partition: Partition, region: int) -> tuple[torch.Tensor, float]:
    """Eigenvalues of a region's second moments, and its largest radius over the mean one."""
    place = ((partition.region == region) & (partition.depth > 0.0)).nonzero().double()
    place = place - place.mean(dim=0)
    radius = place.norm(dim=1)
    return torch.linalg.eigvalsh(place.T @ place / len(place)), float(radius.max() / radius.mean())


def test_chips_are_angular_and_no_two_alike() -> None:
    """Balls of points at eight places: a ball's farthest voxel is 4/3 of the mean away."""
    rest, spacing = points_of(cube())
    places = 0.025 * (torch.cartesian_prod(*[torch.arange(2)] * 3) * 2 - 1)
    apart = torch.cdist(rest, places.to(rest))
    rank = torch.where(apart.amin(dim=1) < 1.6 * spacing, apart.argmin(dim=1) + 1, 0)
    partition = fresh(rest, spacing, rough=0.0)
    partition.split(7, rest, rank, [7, *range(1, 9)])
    shapes = [shape_of(partition, number) for number in range(1, 9)]
    sharp = torch.tensor([ratio for _, ratio in shapes])
    assert float(sharp.mean()) > 1.6 and float(sharp.min()) > 1.4
    assert len({round(float(axes[2] / axes[0]), 2) for axes, _ in shapes}) > 5


def test_long_chips_stay_long() -> None:
    rest, spacing = points_of(cube())
    rod = (rest[:, 0].abs() < 3.0 * spacing) & (rest[:, 1:].norm(dim=1) < 0.9 * spacing)
    partition = fresh(rest, spacing)
    partition.split(7, rest, rod.long(), [7, 1])
    axes, _ = shape_of(partition, 1)
    assert float(axes[2] / axes[1]) > 3.0


def test_dust_keeps_its_volume_and_its_lumps() -> None:
    """Single points all over a body are one label that no blur takes away."""
    rest, spacing = points_of(cube())
    dust = torch.zeros(len(rest), dtype=torch.int64)
    dust[::53] = 1
    partition = fresh(rest, spacing)
    whole = partition.volume(7)
    partition.split(7, rest, dust, [7, 1], dust=1)
    wanted = whole * int(dust.sum()) / len(rest)
    assert partition.volume(1) == pytest.approx(wanted, rel=0.02)
    assert partition.volume(1) + partition.volume(7) == whole
    place = partition.place(rest[::53]).round().long()
    assert float((partition.region[place.unbind(dim=1)] == 1).double().mean()) > 0.8


def test_the_order_of_the_points_does_not_matter() -> None:
    rest, spacing = points_of(cube())
    unit = slabs(rest, 4)
    mixed = torch.randperm(len(rest), generator=torch.Generator().manual_seed(3))
    found = []
    for order in (torch.arange(len(rest)), mixed):
        partition = fresh(rest[order], spacing)
        # a piece is named after a row, so its name changes with the order
        names = torch.tensor([int((unit[order] == u).nonzero()[0]) for u in range(4)])
        _, rank = ranked(names[unit[order]], rest[order])
        partition.split(7, rest[order], rank, [7, 1, 2, 3])
        found.append(partition.region)
    assert torch.equal(*found)


def test_older_faces_stay_when_a_piece_splits_again() -> None:
    rest, spacing = points_of(cube())
    right = (rest[:, 0] > 0.0).long()
    partition = fresh(rest, spacing)
    partition.split(7, rest, right, [7, 1])
    before, volume = partition.region.clone(), partition.volume(7)
    rows = right == 0
    partition.split(7, rest[rows], (rest[rows, 1] > 0.01).long(), [7, 2])
    after = partition.region
    untouched = before != 7
    assert torch.equal(before[untouched], after[untouched])
    assert bool(torch.isin(after[~untouched], torch.tensor([7, 2])).all())
    assert partition.volume(7) + partition.volume(2) == volume


def test_faces_are_smoother_than_the_points() -> None:
    """A flat cut through jittered points: voxels of the wrong side are few and near."""
    rest, spacing = points_of(cube())
    partition = fresh(rest, spacing, rough=0.0)
    partition.split(7, rest, (rest[:, 0] > 0.0).long(), [7, 1])
    x = partition.center(torch.arange(partition.shape[0])[:, None].repeat(1, 3))[:, 0]
    inside = partition.depth > 0.0
    side = (x > 0.0)[:, None, None].expand(partition.shape)
    wrong = inside & ((partition.region == 1) != side)
    nearest = nearest_labels(partition.place(rest), (rest[:, 0] > 0.0).long(), partition.shape, 5.0)
    raw = inside & ((nearest == 1) != side)
    assert int(wrong.sum()) < 0.75 * int(raw.sum())
    off = x[:, None, None].expand(partition.shape)[wrong].abs()
    assert float(off.max()) < 0.5 * spacing


def test_displacements_follow_the_law_of_crack_faces() -> None:
    """Structure function of heights from 2 voxels to 4 spacings (12 voxels), and their rms."""
    device = torch.device("cpu")
    heights = torch.cat(
        [displacement((531 * n, 0, 97 * n), (128, 128, 1), device)[..., 0] for n in range(32)]
    )
    assert 0.9 < float(heights.square().mean().sqrt()) < 1.1
    steps = [2, 3, 4, 6, 8, 12]
    change = []
    for r in steps:
        a = (heights[:, r:] - heights[:, :-r]).square().mean()
        b = (heights[:, :, r:] - heights[:, :, :-r]).square().mean()
        change.append(float((0.5 * (a + b)).sqrt()))
    x, y = torch.tensor(steps).log(), torch.tensor(change).log()
    slope = ((x - x.mean()) * (y - y.mean())).sum() / (x - x.mean()).square().sum()
    assert 0.7 < float(slope) < 0.9


def test_heights_of_a_face_are_those_of_the_material() -> None:
    """A flat cut: the face lies where the displacement puts it, by the amplitude."""
    rest, spacing = points_of(cube())
    rms = []
    for rough in (0.2, 0.4):
        flat, bumpy = (fresh(rest, spacing, rough=r) for r in (0.0, rough))
        for partition in (flat, bumpy):
            partition.split(7, rest, (rest[:, 0] > 0.0).long(), [7, 1])
        inner = slice(12, -12)
        # voxels of the left along x measure where the face is
        left = [((p.region == 7) & (p.depth > 0)).sum(dim=0)[inner, inner] for p in (flat, bumpy)]
        moved = (left[1] - left[0]).double()
        rms.append(float((moved - moved.mean()).square().mean().sqrt()) / (rough * 3.0))
    # one face of a few wavelengths, counted in whole voxels
    assert all(0.6 < r < 1.3 for r in rms)


def test_displacements_hang_on_the_place_alone() -> None:
    voxels = torch.cartesian_prod(torch.arange(3, 20), torch.arange(5), torch.arange(4, 9))
    low = torch.tensor([10, -20, 30])
    whole = displacement((10, -20, 30), (24, 12, 12), voxels.device)
    assert torch.equal(displacements(voxels + low), whole[:, *voxels.unbind(dim=1)].T)
    assert amplitude("glass") < amplitude("bone") < amplitude("fruit.apple") < amplitude("bread")


def test_islands_join_what_is_around() -> None:
    first = torch.zeros(12, 12, 12, dtype=torch.int16)
    first[:, :, 8:] = 1
    first[2:4, 2:4, 2:4] = 1  # 8 voxels
    first[6:9, 6:9, 2:5] = 1  # 27
    assert ISLAND == 27
    near = torch.ones_like(first).nonzero()
    labels = Labels(first, torch.full_like(first, -1), torch.ones(first.shape))
    done = join_islands(labels, near).first
    wanted = first.clone()
    wanted[2:4, 2:4, 2:4] = 0
    assert torch.equal(done, wanted)
    # all that there is of a label stays
    only = torch.zeros(8, 8, 8, dtype=torch.int16)
    only[3:5, 3:5, 3:5] = 1
    labels = Labels(only, torch.full_like(only, -1), torch.ones(only.shape))
    assert torch.equal(join_islands(labels, torch.ones_like(only).nonzero()).first, only)


@pytest.mark.cuda
def test_cpu_and_cuda_cut_alike() -> None:
    found = []
    for device in ("cpu", "cuda"):
        rest, spacing = points_of(cube())
        rest = rest.to(device)
        partition = Partition(cube(), Frame.identity(), rest, spacing, 0, 0.25)
        _, rank = ranked(slabs(rest, 5), rest)
        partition.split(0, rest, rank, list(range(5)))
        rows = rank == 0
        again = (rest[rows, 1] > 0.0).long()
        partition.split(0, rest[rows], again, [0, 5])
        found.append(partition.region.cpu())
    assert torch.equal(*found)
