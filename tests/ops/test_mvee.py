"""mvee and mvee_lens: known ellipsoids, closed form against sampling, degenerate and bad input."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from gsfluent.ops import mvee, mvee_lens
from gsfluent.ops.reference import mvee as reference
from gsfluent.ops.reference.mvee_dense import mvee_lens_dense

DTYPES = [torch.float32, torch.float64]


def reach(points: Tensor, center: Tensor, shape: Tensor) -> Tensor:
    """Largest (x - c)^T S^-1 (x - c) of each set."""
    offset = (points - center[:, None]).double()
    return (offset @ torch.linalg.inv(shape.double()) * offset).sum(2).amax(1)


def volume(shape: Tensor) -> Tensor:
    return torch.linalg.det(shape.double()).clamp(min=0.0).sqrt()


def clouds(batch: int = 12, count: int = 40) -> Tensor:
    mix = torch.randn(batch, 3, 3, dtype=torch.float64)
    return torch.randn(batch, count, 3, dtype=torch.float64) @ mix + 5.0


def test_a_tolerance_float32_cannot_reach_ends_at_its_best() -> None:
    generator = torch.Generator().manual_seed(14)
    points = torch.rand(100, 32, 3, generator=generator)
    _, shape = mvee(points, tolerance=1e-9, max_iterations=20000)
    _, want = mvee(points.double(), tolerance=1e-10, max_iterations=20000)
    ratio = volume(shape) / volume(want)
    assert ratio.min() > 1.0
    assert ratio.max() < 1.0 + 2e-4


@pytest.mark.parametrize("dtype", DTYPES)
def test_matches_the_reference(dtype: torch.dtype) -> None:
    points = clouds().to(dtype)
    center, shape = mvee(points, tolerance=1e-4, max_iterations=5000)
    want_center, want_shape = reference.mvee(points.double())
    size = volume(want_shape) ** (1.0 / 3.0)
    assert (volume(shape) / volume(want_shape) - 1.0).abs().max() < 1e-3
    assert ((center.double() - want_center).norm(dim=1) / size).max() < 2e-2
    assert reach(points.double(), center, shape).max() < 1.0 + 1e-4


@pytest.mark.parametrize("dtype", DTYPES)
def test_cube_corners_give_their_ball(dtype: torch.dtype) -> None:
    corners = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0], dtype=dtype)] * 3)
    center, shape = mvee(corners[None] + 2.0)
    assert (center - 2.0).abs().max() < 2e-3  # the tolerance of the fit
    assert (shape[0] - 3.0 * torch.eye(3, dtype=dtype)).abs().max() < 1e-2


@pytest.mark.parametrize("dtype", DTYPES)
def test_every_point_is_inside_even_when_stopped_early(dtype: torch.dtype) -> None:
    points = clouds(30, 60).to(dtype)
    for iterations in (0, 3, 1000):
        center, shape = mvee(points, max_iterations=iterations)
        assert reach(points.double(), center, shape).max() < 1.0 + 1e-4


def test_more_iterations_make_it_smaller_down_to_the_smallest() -> None:
    points = clouds(10, 60)
    volumes = [volume(mvee(points, max_iterations=i, tolerance=1e-6)[1]) for i in (0, 20, 2000)]
    assert (volumes[0] > volumes[1]).all()
    assert (volumes[1] > 0.999999 * volumes[2]).all()


def test_affine_equivariance() -> None:
    points = clouds()
    a = torch.randn(3, 3, dtype=torch.float64) + 2.0 * torch.eye(3)
    shift = torch.tensor([100.0, -20.0, 3.0], dtype=torch.float64)
    center, shape = mvee(points, tolerance=1e-5, max_iterations=2000)
    moved_center, moved_shape = mvee(points @ a.mT + shift, tolerance=1e-5, max_iterations=2000)
    want = a @ shape @ a.mT
    assert (moved_shape - want).abs().max() < 1e-3 * want.abs().max()
    assert (moved_center - (center @ a.mT + shift)).abs().max() < 1e-2


@pytest.mark.parametrize(("dtype", "thin"), [(torch.float32, 3e-2), (torch.float64, 1e-5)])
def test_nearly_flat_sets_keep_their_smallest_volume(dtype: torch.dtype, thin: float) -> None:
    generator = torch.Generator().manual_seed(4)
    turn = rotations(generator, 20)
    round_set = torch.randn(20, 64, 3, generator=generator, dtype=torch.float64)
    squeeze = torch.tensor([1.0, thin**0.5, thin], dtype=torch.float64)
    points = (round_set * squeeze @ turn.mT).to(dtype)
    center, shape = mvee(points)
    assert reach(points.double(), center, shape).max() < 1.0 + 1e-5
    # Volumes go along with the squeeze, so that the truth is that of the set before it.
    before = (points.double() @ turn) / squeeze
    want = volume(mvee(before, tolerance=1e-8)[1]) * squeeze.prod()
    assert (volume(shape) / want).max() < 1.0 + 1e-3
    assert (volume(shape) / want).min() > 1.0 - 1e-6


@pytest.mark.parametrize("dtype", DTYPES)
def test_degenerate_sets_get_their_own_dimension(dtype: torch.dtype) -> None:
    square = torch.tensor([[1, 1, 0], [-1, 1, 0], [1, -1, 0], [-1, -1, 0]], dtype=dtype)
    center, shape = mvee(square[None] + 3.0)  # circle of radius sqrt(2), flat
    assert (center - 3.0).abs().max() < 2e-3
    semi = torch.linalg.eigvalsh(shape.double()[0]).sqrt()
    assert semi[1:] == pytest.approx([2.0**0.5] * 2, rel=1e-3)
    assert 0.0 < semi[0] < 1e-3

    segment = torch.tensor([[0, 0, 0], [2, 2, 2], [1, 1, 1]], dtype=dtype)
    center, shape = mvee(segment[None])
    assert (center - 1.0).abs().max() < 1e-4
    semi = torch.linalg.eigvalsh(shape.double()[0]).clamp(min=0).sqrt()
    assert float(semi[2]) == pytest.approx(3.0**0.5, rel=1e-3)
    assert semi[1] < 1e-3

    for count in (1, 5):
        center, shape = mvee(torch.full((1, count, 3), 7.0, dtype=dtype))
        assert (center - 7.0).abs().max() < 1e-5
        assert torch.linalg.eigvalsh(shape.double()[0]).min() > 0.0
        assert shape.abs().max() < 1e-6


def test_far_from_the_origin_in_float32() -> None:
    points = clouds(4, 40)
    points = (points - points.mean(1, keepdim=True)) / points.std() + 1000.0
    center, shape = mvee(points.float())
    _, want = reference.mvee(points.float().double(), tolerance=1e-3)
    assert (volume(shape) / volume(want) - 1.0).abs().max() < 2e-2
    assert reach(points.float().double(), center, shape).max() < 1.01


def test_empty_batch() -> None:
    center, shape = mvee(torch.zeros(0, 5, 3))
    assert (center.shape, shape.shape) == ((0, 3), (0, 3, 3))
    mean, cov, overlap = mvee_lens(*[torch.zeros(0, 3), torch.zeros(0, 6)] * 2)
    assert (mean.shape, cov.shape, overlap.shape) == ((0, 3), (0, 6), (0,))


def balls(r1: float, r2: float, d: float, dtype: torch.dtype) -> tuple[Tensor, ...]:
    """Two Gaussians whose radius-sigma ellipsoids are balls, r1 at 0 and r2 at d."""
    axis = torch.tensor([0.6, -0.64, 0.48], dtype=torch.float64)
    eye = torch.eye(3, dtype=torch.float64)[None]
    args = (0.0 * axis[None], eye * (r1 / 2.0) ** 2, d * axis[None], eye * (r2 / 2.0) ** 2)
    return tuple(a.to(dtype) for a in args)


# (r1, r2, d): symmetric and mild lenses (case 1), unequal caps (case 2), ball itself (case 3)
LENSES = [(1, 1, 1), (1, 1, 0.2), (1, 0.8, 0.6), (1, 0.6, 0.7), (0.6, 1, 0.8), (1, 0.5, 0.55),
          (1, 0.9, 0.2), (0.5, 1, 0.6)]  # fmt: skip


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(("r1", "r2", "d"), LENSES)
def test_ball_lens_closed_form_is_the_smallest(
    r1: float, r2: float, d: float, dtype: torch.dtype
) -> None:
    args = balls(r1, r2, d, dtype)
    mean, cov, overlap = mvee_lens(*args)
    assert bool(overlap.all())
    wide = tuple(a.double() for a in args)
    points, _ = reference.lens_points(*wide, radius=2.0, count=4000)
    assert reach(points, mean, 4.0 * cov).max() < 1.0 + 1e-4  # contains the true lens
    # Khachiyan's fit of the samples is no smaller than the samples' own smallest ellipsoid.
    _, want = mvee(points, tolerance=1e-4, max_iterations=3000)
    assert float(volume(want / 4.0) / volume(cov)) == pytest.approx(1.0, abs=5e-3)


def test_nested_and_disjoint_balls() -> None:
    mean, cov, overlap = mvee_lens(*balls(1.0, 0.2, 0.5, torch.float64))
    assert bool(overlap)
    assert mean.norm() == pytest.approx(0.5)
    assert cov[0, 0, 0] == pytest.approx(0.01)
    mean, cov, overlap = mvee_lens(*balls(0.2, 1.0, 0.5, torch.float64))
    assert mean.norm() == pytest.approx(0.0)
    mean, cov, overlap = mvee_lens(*balls(1.0, 1.0, 0.0, torch.float64))
    assert cov[0, 0, 0] == pytest.approx(0.25)
    mean, cov, overlap = mvee_lens(*balls(1.0, 1.0, 2.5, torch.float64))
    assert not bool(overlap)
    assert cov.abs().max() == 0.0
    assert mean.norm() == pytest.approx(1.25)


def test_vanishing_lens_is_not_a_disc() -> None:
    _, cov, overlap = mvee_lens(*balls(1.0, 1.0, 1.9999, torch.float64), flat=0.15)
    semi = torch.linalg.eigvalsh(cov[0]).sqrt()
    assert bool(overlap)
    assert float(semi[0] / semi[2]) == pytest.approx(0.15, rel=1e-6)


def pairs(batch: int, same_shape: bool) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    torch.manual_seed(1)
    a = torch.randn(batch, 3, 3, dtype=torch.float64)
    cov_a = 0.05 * a @ a.mT + 0.02 * torch.eye(3)
    b = torch.randn(batch, 3, 3, dtype=torch.float64)
    cov_b = 1.7 * cov_a if same_shape else 0.05 * b @ b.mT + 0.02 * torch.eye(3)
    mean_a = torch.randn(batch, 3, dtype=torch.float64)
    mean_b = mean_a + 0.3 * torch.randn(batch, 3, dtype=torch.float64)
    return mean_a, cov_a, mean_b, cov_b


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("same_shape", [True, False])
def test_ellipsoid_lens_contains_the_overlap(same_shape: bool, dtype: torch.dtype) -> None:
    args = tuple(a.to(dtype) for a in pairs(60, same_shape))
    wide = tuple(a.double() for a in args)
    mean, cov, overlap = mvee_lens(*args)
    points, want_overlap = reference.lens_points(*wide, radius=2.0, count=3000)
    assert torch.equal(overlap, want_overlap)
    assert int(overlap.sum()) > 40
    assert reach(points[overlap], mean[overlap], 4.0 * cov[overlap]).max() < 1.0 + 2e-5
    # No smaller than the smallest around some of its points.
    ratio = volume(4.0 * cov[overlap]) / volume(mvee(points[overlap][:, ::10], tolerance=1e-6)[1])
    assert ratio.min() > 1.0 - 1e-3


def rotations(generator: torch.Generator, batch: int) -> Tensor:
    draw = torch.randn(batch, 3, 3, generator=generator, dtype=torch.float64)
    return torch.linalg.qr(draw)[0]


def hard_pairs(batch: int, ratio: float, part: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Axis ratios up to `ratio`, centres apart by `part` of the distance at which they touch."""
    generator = torch.Generator().manual_seed(5)
    covs = []
    for _ in range(2):
        turn = rotations(generator, batch)
        draw = torch.rand(batch, 1, 3, generator=generator, dtype=torch.float64)
        covs.append(turn * ratio ** (-2.0 * draw) @ turn.mT)
    mean = torch.randn(batch, 3, generator=generator, dtype=torch.float64)
    away = torch.randn(batch, 3, generator=generator, dtype=torch.float64)
    near, far = torch.zeros(batch, dtype=torch.float64), torch.full((batch,), 30.0).double()
    for _ in range(40):
        middle = 0.5 * (near + far)
        meets = mvee_lens(mean, covs[0], mean + middle[:, None] * away, covs[1])[2]
        near, far = torch.where(meets, middle, near), torch.where(meets, far, middle)
    return mean, covs[0], mean + part * near[:, None] * away, covs[1]


# Ordinary, needles and plates, barely overlapping, nearly concentric.
HARD = [(4.0, 0.5), (40.0, 0.5), (8.0, 0.98), (40.0, 0.01)]


@pytest.mark.parametrize(("ratio", "part"), HARD)
def test_lens_is_within_a_thousandth_of_the_dense_optimum(ratio: float, part: float) -> None:
    # Numbers that float32 holds, so that both types solve the same problem.
    args = tuple(a.float().double() for a in hard_pairs(3, ratio, part))
    _, shape, excess, points = mvee_lens_dense(*args, rays=500, rounds=5)
    tight = excess < 5e-4  # where the sampling itself has found the optimum
    assert int(tight.sum()) >= 2
    for dtype in DTYPES:
        mean, cov, overlap = mvee_lens(*(a.to(dtype) for a in args))
        assert bool(overlap.all())
        assert reach(points, mean, 4.0 * cov).max() < 1.0 + 2e-5
        ratio_of_volumes = volume(4.0 * cov)[tight] / volume(shape)[tight]
        assert ratio_of_volumes.max() < 1.0 + 1e-3 + 1.5 * 5e-4  # what the sampling lacks
        assert ratio_of_volumes.min() > 1.0 - 1e-3


def test_one_inside_the_other_is_the_inner_one() -> None:
    mean, cov, _, _ = hard_pairs(5, 4.0, 0.0)
    shift = 0.05 * torch.linalg.eigvalsh(cov)[:, :1].sqrt() * torch.ones(3, dtype=torch.float64)
    turn = rotations(torch.Generator().manual_seed(2), 5)
    inner = 0.01 * turn @ cov @ turn.mT * torch.linalg.eigvalsh(cov)[:, :1, None]
    for swapped in (False, True):
        first, second = (mean, cov), (mean + shift, inner)
        got_mean, got, overlap = mvee_lens(*(second + first if swapped else first + second))
        assert bool(overlap.all())
        assert (got_mean - mean - shift).abs().max() < 1e-12
        assert ((got - inner).abs().amax((1, 2)) / inner.abs().amax((1, 2))).max() < 1e-9


def test_any_covariance_ends_in_finite_numbers() -> None:
    generator = torch.Generator().manual_seed(9)
    count = 300
    axes = 10.0 ** (-6.0 * torch.rand(2, count, 1, 3, generator=generator))
    axes[:, ::3, :, 0] = 0.0  # flat
    turn = [rotations(generator, count).float() for _ in range(2)]
    cov_a, cov_b = (turn[k] * axes[k] @ turn[k].mT for k in range(2))
    mean = torch.randn(count, 3, generator=generator)
    near = mean + 10.0 ** (-4.0 * torch.rand(count, 1, generator=generator))
    for dtype in DTYPES:
        got = mvee_lens(*(a.to(dtype) for a in (mean, cov_a, near, cov_b)))
        assert all(bool(torch.isfinite(g).all()) for g in got)
        assert (torch.linalg.eigvalsh(got[1].double())[:, 2][got[2]] > 0.0).all()


def test_flat_thickens_only_what_is_thin() -> None:
    args = hard_pairs(20, 4.0, 0.7)
    plain, thick = mvee_lens(*args)[1], mvee_lens(*args, flat=0.15)[1]
    assert (volume(thick) >= volume(plain) * (1.0 - 1e-9)).all()
    again = mvee_lens(*args, flat=1e-6)[1]
    assert (again - plain).abs().max() < 1e-9 * plain.abs().max()


def test_packed_and_full_covariances_agree() -> None:
    mean_a, cov_a, mean_b, cov_b = pairs(10, False)

    def pack(c: Tensor) -> Tensor:
        return c.reshape(-1, 9)[:, [0, 4, 8, 1, 2, 5]]

    mean, cov, overlap = mvee_lens(mean_a, cov_a, mean_b, cov_b)
    packed_mean, packed, packed_overlap = mvee_lens(mean_a, pack(cov_a), mean_b, pack(cov_b))
    assert torch.equal(mean, packed_mean)
    assert torch.equal(overlap, packed_overlap)
    assert torch.equal(pack(cov), packed)


def test_registration() -> None:
    torch.library.opcheck(torch.ops.gsfluent.mvee.default, (torch.randn(3, 9, 3), 1e-2, 100))
    mean_a, cov_a, mean_b, cov_b = (a.float() for a in pairs(4, False))
    packed = [c.reshape(-1, 9)[:, [0, 4, 8, 1, 2, 5]] for c in (cov_a, cov_b)]
    torch.library.opcheck(
        torch.ops.gsfluent.mvee_lens.default, (mean_a, packed[0], mean_b, packed[1], 2.0, 0.0)
    )
    compiled = torch.compile(mvee, fullgraph=True, backend="aot_eager")
    points = torch.randn(3, 9, 3)
    assert torch.equal(compiled(points)[1], mvee(points)[1])


def test_gradients_are_refused() -> None:
    with pytest.raises(NotImplementedError, match="no gradient"):
        mvee(torch.randn(1, 9, 3, requires_grad=True))[1].sum().backward()
    mean_a, cov_a, mean_b, cov_b = pairs(2, False)
    with pytest.raises(NotImplementedError, match="no gradient"):
        mvee_lens(mean_a.requires_grad_(), cov_a, mean_b, cov_b)[0].sum().backward()


def test_errors_name_the_argument() -> None:
    points = torch.randn(3, 9, 3)
    with pytest.raises(TypeError, match="points must be float32 or float64"):
        mvee(points.half())
    with pytest.raises(ValueError, match="points must have shape"):
        mvee(points[..., :2])
    with pytest.raises(ValueError, match="at least one point per set"):
        mvee(points[:, :0])
    with pytest.raises(ValueError, match="tolerance must be positive"):
        mvee(points, tolerance=0.0)
    for bad in (float("nan"), float("inf")):
        wrong = points.clone()
        wrong[1, 2, 0] = bad
        with pytest.raises(ValueError, match="points must be finite, got NaN or infinity in row 1"):
            mvee(wrong)
    mean_a, cov_a, mean_b, cov_b = pairs(3, False)
    with pytest.raises(ValueError, match="mean_b must have shape"):
        mvee_lens(mean_a, cov_a, mean_b[:2], cov_b)
    with pytest.raises(ValueError, match="flat must lie in"):
        mvee_lens(mean_a, cov_a, mean_b, cov_b, flat=1.5)
    with pytest.raises(ValueError, match="radius must be positive"):
        mvee_lens(mean_a, cov_a, mean_b, cov_b, radius=0.0)
    with pytest.raises(ValueError, match="cov_b must be finite"):
        mvee_lens(mean_a, cov_a, mean_b, cov_b * float("nan"))
    with pytest.raises(ValueError, match="cov_a must be positive definite, row 0 is not"):
        mvee_lens(mean_a, -cov_a, mean_b, cov_b)
    with pytest.raises(ValueError, match="mean_a must be finite"):
        mvee_lens(mean_a * float("inf"), cov_a, mean_b, cov_b)


@pytest.mark.cuda
@pytest.mark.parametrize("dtype", DTYPES)
def test_cuda_matches_cpu(dtype: torch.dtype) -> None:
    points = clouds().to(dtype)
    center, shape = mvee(points)
    cuda_center, cuda_shape = mvee(points.cuda())
    # Sums in another order may choose other pivots: equal to the tolerance of the fit.
    assert (volume(cuda_shape.cpu()) / volume(shape) - 1.0).abs().max() < 5e-3
    assert (cuda_center.cpu() - center).abs().max() < 0.1
    assert reach(points.double(), cuda_center.cpu(), cuda_shape.cpu()).max() < 1.0 + 1e-4
    for same_shape in (True, False):
        args = tuple(a.to(dtype) for a in pairs(30, same_shape))
        mean, cov, overlap = mvee_lens(*args)
        got = mvee_lens(*(a.cuda() for a in args))
        assert torch.equal(got[2].cpu(), overlap)
        assert (volume(got[1].cpu()[overlap]) / volume(cov[overlap]) - 1.0).abs().max() < 2e-3
        assert (got[0].cpu() - mean).abs().max() < 0.05
