"""Occupancy and density normals: the kernels against plain PyTorch, laws, bad input."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from gsfluent.ops import density_normals, occupancy, splat_bulk
from gsfluent.ops.reference import density as reference

NODES = 32
CUDA = pytest.param("cuda", marks=pytest.mark.cuda)
DEVICES = [
    ("cpu", torch.float32, 2e-5),
    ("cpu", torch.float64, 1e-12),
    pytest.param("cuda", torch.float32, 2e-5, marks=pytest.mark.cuda),
    pytest.param("cuda", torch.float64, 1e-12, marks=pytest.mark.cuda),
]


def splats(count: int = 6000) -> tuple[Tensor, Tensor, Tensor]:
    """A ball of radius 1 with some far strays; every third splat is flat. float64."""
    g = torch.Generator().manual_seed(3)
    means = torch.randn(count, 3, generator=g, dtype=torch.float64)
    radius = torch.rand(count, 1, generator=g, dtype=torch.float64) ** (1 / 3)
    means = radius * means / means.norm(dim=1, keepdim=True)
    means[::97] *= 4.0
    quats = torch.randn(count, 4, generator=g, dtype=torch.float64)
    scales = 0.02 + 0.02 * torch.rand(count, 3, generator=g, dtype=torch.float64)
    scales[::3, 1] = 0.004
    return means, quats, scales


def frame(cell: float = 0.09) -> Tensor:
    low = -0.5 * NODES * cell
    return torch.tensor([low + 0.01, low, low - 0.02, cell], dtype=torch.float64)


@pytest.mark.parametrize(("device", "dtype", "bar"), DEVICES)
def test_kernels_equal_reference(device: str, dtype: torch.dtype, bar: float) -> None:
    means, quats, scales = splats()
    want = reference.occupancy(means, frame(), NODES, full=0.8)
    moved = [t.to(device, dtype) for t in (means, quats, scales)]
    place = frame().to(device, dtype)
    got = occupancy(moved[0], place, NODES, full=0.8)
    assert (got.cpu().double() - want).abs().max() < bar
    want_normals = reference.density_normals(means, quats, scales, want, frame(), NODES)
    normals = density_normals(*moved, want.to(device, dtype), place, NODES).cpu().double()
    eye = torch.tensor([3.0, -2.0, 1.0], dtype=torch.float64)
    seen = density_normals(*moved, want.to(device, dtype), place, NODES, eye=eye.to(device, dtype))
    want_seen = reference.density_normals(means, quats, scales, want, frame(), NODES, eye=eye)
    assert not torch.equal(want_seen, want_normals)
    normals = torch.cat([normals, seen.cpu().double()])
    want_normals = torch.cat([want_normals, want_seen])
    error = (normals - want_normals).abs().amax(1)
    # in float32 a splat at a threshold may fall on its other side
    assert error.quantile(0.99) < 10 * bar
    if dtype == torch.float64:
        assert error.max() < bar


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_cpu_sums_do_not_depend_on_threads(threads: int) -> None:
    means = splats()[0].float()
    want = occupancy(means, frame().float(), NODES, full=0.8)
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        assert torch.equal(occupancy(means, frame().float(), NODES, full=0.8), want)
    finally:
        torch.set_num_threads(before)


@pytest.mark.cuda
def test_gpu_sums_have_no_order() -> None:
    """The same bits in every run, and of occupancy for any order of the splats."""
    means, _, scales = (t.float().cuda() for t in splats(150_000))
    order = torch.randperm(len(means), generator=torch.Generator().manual_seed(5)).cuda()
    place = frame().float().cuda()
    want, bulk = occupancy(means, place, NODES, full=0.8), splat_bulk(means, scales)
    for _ in range(4):
        assert torch.equal(occupancy(means, place, NODES, full=0.8), want)
        assert torch.equal(occupancy(means[order], place, NODES, full=0.8), want)
        assert splat_bulk(means, scales) == bulk


def test_every_level_holds_the_same_matter() -> None:
    means, _, _ = splats()
    means = means[(means.abs() < 1.3).all(dim=1)]  # the outermost cell centres stand at 1.39
    values = occupancy(means, frame(), NODES, full=1e4)  # never cut off
    for level in range(5):
        mass = float(reference.level_of(values, NODES, level).sum()) * 8**level * 1e4
        assert abs(mass - means.shape[0]) < 1e-6 * mass


@pytest.mark.parametrize("device", ["cpu", CUDA])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_bulk_is_that_of_the_finite_splats(device: str, dtype: torch.dtype) -> None:
    means, _, scales = (t.to(dtype) for t in splats(150_000))
    means[7, 1], scales[11, 0], means[13, 2] = float("nan"), float("inf"), float("-inf")
    good = torch.isfinite(means).all(1) & torch.isfinite(scales).all(1)
    want = means[good].double()
    bulk = splat_bulk(means.to(device), scales.to(device))
    away = (want - want.mean(0)).norm(dim=1)
    assert torch.tensor(bulk.center).sub(want.mean(0)).abs().max() < 1e-6
    assert bulk.spread == pytest.approx(float(away.square().mean().sqrt()), rel=1e-6)
    assert bulk.reach == pytest.approx(float(away.max()), rel=1e-6)
    assert bulk.size == pytest.approx(float(scales[good].double().mean()), rel=1e-6)
    nothing = splat_bulk(means[:0].to(device), scales[:0].to(device))
    assert nothing == ((0.0, 0.0, 0.0), 0.0, 0.0, 0.0)


def test_normals_of_a_ball_point_outward() -> None:
    means, quats, scales = splats(60000)
    values = occupancy(means, frame(), NODES, full=0.8 * 60000 / (4.19 / 0.09**3))
    normals = density_normals(means, quats, scales, values, frame(), NODES)
    skin = (means.norm(dim=1) > 0.93) & (means.norm(dim=1) < 1.01) & (scales[:, 1] > 0.01)
    outward = means[skin] / means[skin].norm(dim=1, keepdim=True)
    cosine = (torch.nn.functional.normalize(normals[skin], dim=1) * outward).sum(1)
    assert torch.rad2deg(cosine.clamp(-1, 1).acos()).mean() < 3.0
    flat = (scales[:, 1] < 0.01) & (normals.norm(dim=1) > 0.999)
    assert flat.any()


@pytest.mark.parametrize("device", ["cpu", CUDA])
def test_the_far_side_of_a_solid_stays_there(device: str) -> None:
    """Turned to the eye it would be black wherever a splat sticks out over an outline. A sheet has
    no such side: one sees it from within."""
    means, quats, scales = splats(60000)
    skin = (means.norm(dim=1) > 0.93) & (means.norm(dim=1) < 1.01) & (scales[:, 1] > 0.01)
    eye = torch.tensor([4.0, 0.0, 0.0], dtype=torch.float64)
    outward = means[skin] / means[skin].norm(dim=1, keepdim=True)
    far = ((eye - means[skin]) * outward).sum(dim=1) < 0.0
    full = 0.8 * 60000 / (4.19 / 0.09**3)

    def turned(kept: torch.Tensor) -> float:
        """Of the skin's far side, how much is turned to the eye."""
        values = occupancy(means[kept], frame(), NODES, full=full)
        given = [t.to(device) for t in (means[skin], quats[skin], scales[skin], values, frame())]
        seen = density_normals(*given, NODES, eye=eye.to(device)).cpu()
        return float(((seen * outward).sum(dim=1) < 0.0)[far].double().mean())

    assert turned(torch.ones_like(skin)) < 0.02
    assert turned(means.norm(dim=1) > 0.93) > 0.2


@pytest.mark.parametrize("device", ["cpu", CUDA])
def test_a_sheet_seen_edge_on_has_one_side(device: str) -> None:
    """A rough film on something, seen along it: no splat of it may face down, unlit."""
    g = torch.Generator().manual_seed(5)
    means = 2.0 * torch.rand(400, 3, generator=g, dtype=torch.float64) - 1.0
    tilt = 0.2 * torch.rand(400, 2, generator=g, dtype=torch.float64) - 0.1
    quats = torch.cat([torch.ones_like(tilt[:, :1]), tilt, torch.zeros_like(tilt[:, :1])], dim=1)
    scales = torch.tensor([0.04, 0.04, 0.01], dtype=torch.float64).repeat(400, 1)
    values = torch.zeros(sum((NODES >> level) ** 3 for level in range(reference.LEVELS)))
    ramp = 0.5 - 0.01 * torch.arange(NODES)
    values[: NODES**3] = ramp[:, None, None].expand(NODES, NODES, NODES).flatten()
    eye = torch.tensor([30.0, 0.0, 0.2], dtype=torch.float64)
    given = [t.to(device) for t in (means, quats, scales, values.double(), frame())]
    seen = density_normals(*given, NODES, eye=eye.to(device)).cpu()
    assert float(seen[:, 2].min()) > 0.8
    across = ((eye - means) * seen).sum(dim=1) < 0.0
    assert 0.2 < float(across.double().mean()) < 0.8  # the eye alone would tell half of them apart


@pytest.mark.parametrize("device", ["cpu", CUDA])
@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf"), 3e38])
def test_bad_numbers_stay_in_their_memory(device: str, bad: float) -> None:
    means, quats, scales = (t.float().to(device) for t in splats(500))
    place = frame().float().to(device)
    values = occupancy(means, place, NODES, full=0.8)
    for spoilt in (means, quats, scales):
        kept = spoilt.clone()
        spoilt.view(-1)[::5] = bad
        assert torch.isfinite(occupancy(means, place, NODES, full=0.8)).all()
        assert density_normals(means, quats, scales, values, place, NODES).shape == (500, 3)
        spoilt.copy_(kept)
    for k in range(4):
        broken = place.clone()
        broken[k] = bad
        occupancy(means, broken, NODES, full=0.8)
        density_normals(means, quats, scales, values, broken, NODES)
    values[::3] = bad
    density_normals(means, quats, scales, values, place, NODES)


def test_nothing_and_errors() -> None:
    nothing = torch.zeros(0, 3)
    place = frame().float()
    values = occupancy(nothing, place, NODES, full=1.0)
    assert float(values.abs().sum()) == 0.0
    none = density_normals(nothing, torch.zeros(0, 4), nothing, values, place, NODES)
    assert none.shape == (0, 3)
    with pytest.raises(ValueError, match="nodes must be a multiple of 16"):
        occupancy(nothing, place, 33, full=1.0)
    with pytest.raises(ValueError, match="full must be positive"):
        occupancy(nothing, place, NODES, full=0.0)
    with pytest.raises(ValueError, match="values must have shape"):
        density_normals(nothing, torch.zeros(0, 4), nothing, values[:-1], place, NODES)
    with pytest.raises(TypeError, match="frame"):
        occupancy(nothing, place.double(), NODES, full=1.0)


def test_registration() -> None:
    means, quats, scales = splats(50)
    values = occupancy(means, frame(), NODES, full=0.8)
    tests = ("test_schema", "test_faketensor")
    torch.library.opcheck(
        torch.ops.gsfluent.occupancy.default, (means, frame(), NODES, 0.8), test_utils=tests
    )
    torch.library.opcheck(torch.ops.gsfluent.splat_bulk.default, (means, scales), test_utils=tests)
    torch.library.opcheck(
        torch.ops.gsfluent.density_normals.default,
        (means, quats, scales, values, frame(), NODES, None),
        test_utils=tests,
    )
