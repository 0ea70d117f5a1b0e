"""What must hold for any rasterizer: invariances, bounds, sibling semantics, bad input."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch
from raster_scene import HEIGHT, WIDTH, camera, relative_error, render, scene
from torch import Tensor

from gsfluent.ops import Rendered, rasterize


@pytest.fixture
def threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def float_scene(count: int, **options: int) -> dict[str, Tensor]:
    return {k: v.float() for k, v in scene(count, **options).items()}


def gradients(inputs: dict[str, Tensor], **options: object) -> tuple[Rendered, dict[str, Tensor]]:
    leaves = {k: v.clone().requires_grad_() for k, v in inputs.items()}
    out = render(rasterize, leaves, contribution=True, **options)
    (out.image.sum() + (out.alpha**2).sum() + out.depth.sum()).backward()
    return out, {k: v.grad for k, v in leaves.items() if v.grad is not None}


def test_alpha_lies_in_unit_interval_and_background_fills_the_rest() -> None:
    inputs = float_scene(400)
    out = render(rasterize, inputs)
    assert 0 <= out.alpha.min() and out.alpha.max() <= 1
    black = render(rasterize, {k: v for k, v in inputs.items() if k != "background"})
    filled = black.image + (1 - out.alpha)[..., None] * inputs["background"]
    torch.testing.assert_close(out.image, filled, atol=1e-5, rtol=0)


def test_order_of_gaussians_does_not_matter() -> None:
    inputs = float_scene(300)
    order = torch.randperm(300, generator=torch.Generator().manual_seed(2))
    shuffled = {k: v if k == "background" else v[order] for k, v in inputs.items()}
    a, b = (
        render(rasterize, inputs, contribution=True),
        render(rasterize, shuffled, contribution=True),
    )
    assert torch.equal(a.image, b.image)
    assert torch.equal(a.contribution[order], b.contribution)
    assert torch.equal(a.radii[order], b.radii)


def test_a_splat_is_the_same_wherever_it_stands_in_a_packet() -> None:
    inputs = {k: v for k, v in float_scene(21).items() if k != "background"}
    whole = render(rasterize, inputs)
    for count in (1, 7, 8, 9):
        for first in range(21 - count):
            rows = slice(first, first + count)
            some = render(rasterize, {k: v[rows] for k, v in inputs.items()})
            assert torch.equal(some.radii, whole.radii[..., rows])
            if count == 1:  # the opacity where nothing is before it
                alone = render(
                    rasterize, {k: v[rows].repeat_interleave(3, 0) for k, v in inputs.items()}
                )
                pair = torch.equal(alone.radii[..., :1].expand_as(alone.radii), alone.radii)
                assert pair and bool((alone.alpha >= some.alpha).all())


def test_contributions_sum_to_alpha() -> None:
    out = render(rasterize, float_scene(200), contribution=True)
    torch.testing.assert_close(out.contribution.sum(), out.alpha.sum(), rtol=1e-5, atol=0)


def test_results_are_bit_identical_for_any_number_of_threads(threads: None) -> None:
    inputs = float_scene(5000)
    torch.set_num_threads(1)
    one, one_grad = gradients(inputs)
    torch.set_num_threads(2)
    two, two_grad = gradients(inputs)
    for a, b in zip(one, two, strict=True):
        assert a is b is None or torch.equal(a, b)
    for key, grad in one_grad.items():
        assert torch.equal(grad, two_grad[key]), key


def test_antialiasing_keeps_the_energy_of_a_splat_smaller_than_a_pixel() -> None:
    viewmat, K = torch.eye(4), torch.tensor([[50.0, 0, 24], [0, 50.0, 24], [0, 0, 1]])
    sigma = 0.4  # px at z = 1: smaller than the pixel grid resolves, so the low-pass acts
    energy = {}
    for antialiased in (False, True):
        out = rasterize(
            torch.tensor([[0.0, 0.0, 1.0]]),
            torch.tensor([0.9]),
            viewmat,
            K,
            48,
            48,
            quats=torch.tensor([[1.0, 0, 0, 0]]),
            scales=torch.full((1, 3), sigma / 50),
            colors=torch.ones(1, 1),
            antialiased=antialiased,
        )
        energy[antialiased] = out.alpha.sum().item()
    exact = 0.9 * 2 * torch.pi * sigma**2
    assert abs(energy[True] - exact) < 0.05 * exact
    assert energy[False] > 1.5 * exact


def sibling_stack(groups: list[int]) -> Rendered:
    """Big splats behind each other on the axis, one colour channel each."""
    count = len(groups)
    means = torch.zeros(count, 3)
    means[:, 2] = torch.arange(count) + 2.0
    K = camera()[1]
    return rasterize(
        means,
        torch.full((count,), 0.3),
        torch.eye(4),
        K,
        WIDTH,
        HEIGHT,
        quats=torch.tensor([[1.0, 0, 0, 0]]).expand(count, 4),
        scales=torch.full((count, 3), 5.0),
        colors=torch.eye(count),
        groups=torch.tensor(groups, dtype=torch.int32),
        contribution=True,
    )


def test_only_the_nearest_sibling_contributes() -> None:
    seen = (sibling_stack([4, 4, -1, 4, -1, 7]).contribution > 0).tolist()
    assert seen == [True, False, True, False, True, True]


def test_ring_forgets_a_group_after_eight_others() -> None:
    remembered = sibling_stack([0, *range(1, 8), 0]).contribution
    forgotten = sibling_stack([0, *range(1, 9), 0]).contribution
    assert remembered[-1] == 0
    assert forgotten[-1] > 0


def test_ungrouped_splats_equal_no_groups() -> None:
    inputs = float_scene(100)
    plain = render(rasterize, inputs)
    grouped = render(rasterize, inputs, groups=torch.full((100,), -1, dtype=torch.int32))
    assert torch.equal(plain.image, grouped.image)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_bad_gaussians_are_left_out_with_zero_gradients(dtype: torch.dtype) -> None:
    nan, inf = float("nan"), float("inf")
    good = {k: v.to(dtype) for k, v in scene(60).items()}
    broken = [
        ("means", torch.tensor([nan, 0, 3.0])),
        ("means", torch.tensor([inf, 0, 3.0])),
        ("means", torch.tensor([0, 0, -3.0])),
        ("quats", torch.zeros(4)),
        ("quats", torch.full((4,), nan)),
        ("scales", torch.full((3,), nan)),
        ("scales", torch.full((3,), inf)),
        ("opacities", torch.tensor(nan)),
        ("opacities", torch.tensor(-1.0)),
        ("sh", torch.full((16, 3), nan)),
        ("normals", torch.full((3,), inf)),
        ("means2d_offset", torch.full((2,), nan)),
        ("means2d_offset", torch.full((2,), 1e30)),
    ]
    bad = {}
    for key, value in good.items():
        bad[key] = value if key == "background" else torch.cat([value, value[: len(broken)]])
    for row, (key, value) in enumerate(broken):
        bad[key][60 + row] = value.to(dtype)
    expected, expected_grad = gradients(good)
    result, grad = gradients(bad)
    assert torch.equal(result.image, expected.image)
    assert (result.radii[60:] == 0).all()
    for key, value in grad.items():
        if key == "background":
            continue
        assert torch.equal(value[:60], expected_grad[key]), key
        assert (value[60:] == 0).all(), key


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_extreme_splats_give_finite_images_and_gradients(dtype: torch.dtype) -> None:
    inputs = {k: v.to(dtype) for k, v in scene(64).items()}
    inputs["scales"][:8] = 0.0
    inputs["scales"][8:16] = 1e3
    inputs["scales"][16:24] = torch.tensor([1e3, 1e-6, 1e-6], dtype=dtype)
    inputs["scales"][24:32] = 1e12
    inputs["opacities"][32:40] = 5.0
    inputs["means"][40:48, 2] = 0.011 - 0.3
    out, grad = gradients(inputs)
    for value in (out.image, out.alpha, out.depth, *grad.values()):
        assert torch.isfinite(value).all()


def test_indefinite_covariances_do_not_crash() -> None:
    inputs = float_scene(50)
    rest = {k: inputs[k] for k in ("means", "opacities", "sh")}
    covars = torch.randn(50, 6, generator=torch.Generator().manual_seed(3)).requires_grad_()
    out = render(rasterize, rest | {"covars": covars})
    out.image.sum().backward()
    assert torch.isfinite(out.image).all() and torch.isfinite(covars.grad).all()


def test_no_gaussians_give_the_background() -> None:
    inputs = {k: v if k == "background" else v[:0] for k, v in float_scene(4).items()}
    out, grad = gradients(inputs)
    assert torch.equal(out.image, inputs["background"].expand(HEIGHT, WIDTH, 3))
    assert (out.alpha == 0).all() and (out.depth == 0).all()
    assert relative_error(grad["background"], torch.full((3,), float(WIDTH * HEIGHT))) < 1e-6


def test_inputs_need_not_be_contiguous() -> None:
    inputs = float_scene(80)
    strided = {k: v.t().contiguous().t() if v.dim() == 2 else v for k, v in inputs.items()}
    assert not strided["means"].is_contiguous()
    assert torch.equal(render(rasterize, inputs).image, render(rasterize, strided).image)
