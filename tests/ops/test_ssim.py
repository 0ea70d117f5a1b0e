"""ssim and photometric_loss against their definitions, their laws, and their error messages."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.ops.reference import losses as reference

DTYPES = (torch.float32, torch.float64)
FORWARD = {torch.float32: 1e-6, torch.float64: 1e-12}
BACKWARD = {torch.float32: 1e-5, torch.float64: 1e-12}
# square and not, one to five channels, one window only, more than one strip of columns
SIZES = ((11, 11, 1), (15, 19, 3), (23, 40, 5), (14, 640, 3))


def pair(height: int, width: int, channels: int, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    a, b = torch.rand(2, height, width, channels, dtype=torch.float64)
    return a.to(dtype), (0.7 * a + 0.3 * b).to(dtype)


def far(a: Tensor, b: Tensor) -> float:
    """Largest difference relative to the largest value of ``b``."""
    return float((a.double() - b.double()).abs().max() / b.abs().max())


def extras(height: int, width: int, channels: int, dtype: torch.dtype) -> dict[str, Any]:
    valid = torch.rand(height, width, dtype=dtype)
    valid[:2] = 0.0
    return {
        "valid": valid,
        "alpha": torch.rand(height, width, dtype=dtype),
        "mask": torch.rand(height, width, dtype=dtype).round(),
        "backdrop": torch.rand(channels, dtype=dtype),
        "mask_weight": 2.0,
        "ssim_weight": 0.3,
    }


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("padding", ["valid", "same"])
@pytest.mark.parametrize("size", SIZES)
def test_map_and_its_gradients_match_the_definition(
    dtype: torch.dtype, padding: str, size: tuple[int, int, int]
) -> None:
    x, y = (t.requires_grad_() for t in pair(*size, dtype))
    xd, yd = (t.detach().double().requires_grad_() for t in (x, y))
    got = ops.ssim(x, y, padding=padding, reduction="none")
    want = reference.ssim(xd, yd, padding=padding, reduction="none")
    assert got.dtype == dtype and got.shape == want.shape
    assert float((got - want).detach().abs().max()) < FORWARD[dtype]
    weight = torch.randn_like(got)
    (got * weight).sum().backward()
    (want * weight).sum().backward()
    assert x.grad is not None and y.grad is not None and xd.grad is not None
    assert far(x.grad, xd.grad) < BACKWARD[dtype]
    assert yd.grad is not None and far(y.grad, yd.grad) < BACKWARD[dtype]


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("padding", ["valid", "same"])
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("full", [False, True])
def test_loss_and_its_gradients_match_the_definition(
    dtype: torch.dtype, padding: str, size: tuple[int, int, int], full: bool
) -> None:
    x, y = pair(*size, dtype)
    given = extras(*size, dtype) if full else {}
    doubles = {k: v.double() if isinstance(v, Tensor) else v for k, v in given.items()}
    leaves = [x.requires_grad_()]
    wide = [x.detach().double().requires_grad_()]
    if full:
        leaves.append(given["alpha"].requires_grad_())
        doubles["alpha"] = given["alpha"].detach().double().requires_grad_()
        wide.append(doubles["alpha"])
    got = ops.photometric_loss(x, y, padding=padding, **given)
    want = reference.photometric_loss(wide[0], y.double(), padding=padding, **doubles)
    for a, b in zip(got, want, strict=True):
        assert a.dtype == dtype and abs(a.item() - b.item()) < FORWARD[dtype]
    (3.0 * got.loss).backward()
    (3.0 * want[0]).backward()
    for leaf, exact in zip(leaves, wide, strict=True):
        assert leaf.grad is not None and exact.grad is not None
        assert far(leaf.grad, exact.grad) < BACKWARD[dtype]


def test_images_smaller_than_the_window_work_with_zeros_around() -> None:
    x, y = pair(3, 1, 2, torch.float64)
    want = reference.ssim(x, y, padding="same", reduction="none")
    got = ops.ssim(x, y, padding="same", reduction="none")
    assert float((got - want).abs().max()) < 1e-12


@pytest.mark.parametrize("padding", ["valid", "same"])
def test_gradcheck(padding: str) -> None:
    x, y = pair(12, 13, 2, torch.float64)
    e = extras(12, 13, 2, torch.float64)
    e["alpha"].requires_grad_()

    def loss(image: Tensor, alpha: Tensor) -> Tensor:
        return ops.photometric_loss(image, y, padding=padding, **e | {"alpha": alpha}).loss

    assert torch.autograd.gradcheck(loss, (x.requires_grad_(), e["alpha"]), fast_mode=True)
    assert torch.autograd.gradcheck(
        lambda a, b: ops.ssim(a, b, padding=padding, reduction="none"),
        (x, y.requires_grad_()),
        fast_mode=True,
    )
    assert torch.autograd.gradcheck(
        lambda a, b: ops.ssim(a, b, padding=padding), (x, y), fast_mode=True
    )


@pytest.mark.parametrize("dtype", DTYPES)
def test_equal_images_have_one_and_no_slope(dtype: torch.dtype) -> None:
    x, _ = pair(20, 31, 3, dtype)
    x[:, :12] = 0.25  # flat, where the variance is rounding alone
    for padding in ("valid", "same"):
        assert bool((ops.ssim(x, x, padding=padding, reduction="none") == 1.0).all())
        leaf = x.clone().requires_grad_()
        value = ops.ssim(leaf, x, padding=padding)
        value.backward()
        assert value.item() == 1.0 and leaf.grad is not None
        assert float(leaf.grad.abs().max()) == 0.0


def test_symmetric_bit_by_bit() -> None:
    x, y = pair(20, 31, 3, torch.float32)
    a, b = (ops.ssim(*p, reduction="none") for p in ((x, y), (y, x)))
    assert torch.equal(a, b)
    assert bool((a < 1.0).any()) and bool((a >= -1.0).all())


def test_shifting_both_images_shifts_the_map() -> None:
    x, y = pair(30, 44, 3, torch.float32)
    full = ops.ssim(x, y, reduction="none")
    part = ops.ssim(x[4:, 7:], y[4:, 7:], reduction="none")
    assert torch.equal(part, full[4:, 7:])
    turned = ops.ssim(x.flip(0, 1), y.flip(0, 1), reduction="none").flip(0, 1)
    assert float((turned - full).abs().max()) < 1e-6
    across = ops.ssim(x.transpose(0, 1), y.transpose(0, 1), reduction="none").transpose(0, 1)
    assert float((across - full).abs().max()) < 1e-6


def test_flat_images_follow_the_luminance_alone() -> None:
    # no variance: ssim = (2 a b + C1) / (a^2 + b^2 + C1)
    a, b = 0.3, 0.7
    value = ops.ssim(torch.full((12, 12, 1), a), torch.full((12, 12, 1), b))
    expected = (2 * a * b + 1e-4) / (a * a + b * b + 1e-4)
    # the variance of a flat window is rounding, 1e-8, beside C2 = 9e-4
    assert value.item() == pytest.approx(expected, abs=1e-4)
    wide = ops.ssim(torch.full((12, 12, 1), a).double(), torch.full((12, 12, 1), b).double())
    assert wide.item() == pytest.approx(expected, abs=1e-7)


def test_any_number_of_threads_gives_the_same_bits() -> None:
    x, y = pair(130, 90, 3, torch.float32)
    e = extras(130, 90, 3, torch.float32)
    before = torch.get_num_threads()
    results = []
    try:
        for threads in (1, 2, 3, 7):
            torch.set_num_threads(threads)
            leaf, alpha = x.clone().requires_grad_(), e["alpha"].clone().requires_grad_()
            out = ops.photometric_loss(leaf, y, **e | {"alpha": alpha})
            out.loss.backward()
            results.append((*(t.detach() for t in out), leaf.grad, alpha.grad))
    finally:
        torch.set_num_threads(before)
    for other in results[1:]:
        for a, b in zip(results[0], other, strict=True):
            assert a is not None and b is not None and torch.equal(a, b)


def test_nan_and_infinity_reach_their_windows_and_no_further() -> None:
    x, y = pair(40, 50, 3, torch.float32)
    clean = ops.ssim(x, y, reduction="none")
    for bad in (float("nan"), float("inf")):
        x[20, 25, 1] = bad
        value = ops.ssim(x, y, reduction="none")
        hit = torch.zeros_like(value, dtype=torch.bool)
        hit[10:21, 15:26, 1] = True
        assert bool(value[hit].isnan().all()) and torch.equal(value[~hit], clean[~hit])
        leaf = x.clone().requires_grad_()
        loss = ops.photometric_loss(leaf, y).loss
        loss.backward()
        assert not bool(loss.isfinite()) and leaf.grad is not None
        assert bool(leaf.grad[..., 0].isfinite().all())


def test_views_that_are_not_contiguous_are_read_right() -> None:
    x, y = pair(30, 24, 3, torch.float32)
    got = ops.ssim(x.permute(1, 0, 2), y.permute(1, 0, 2))
    want = ops.ssim(x.permute(1, 0, 2).contiguous(), y.permute(1, 0, 2).contiguous())
    assert torch.equal(got, want)
    offset = torch.rand(30 * 24 * 3 + 1)[1:].view(30, 24, 3)  # not aligned to a vector
    assert torch.equal(ops.ssim(offset, x), ops.ssim(offset.clone(), x))


def test_no_gradient_is_computed_where_none_is_wanted() -> None:
    x, y = pair(16, 16, 3, torch.float32)
    assert not ops.photometric_loss(x, y).loss.requires_grad
    leaf = x.clone().requires_grad_()
    out = ops.photometric_loss(leaf, y)
    assert out.loss.requires_grad and not any(t.requires_grad for t in out[1:])
    with torch.no_grad():
        assert torch.equal(ops.photometric_loss(leaf, y).loss, out.loss)


def test_second_derivatives_are_refused_and_never_left_out() -> None:
    x, y = pair(12, 12, 1, torch.float64)
    x.requires_grad_()
    weight = torch.rand(2, 2, 1, dtype=torch.float64, requires_grad=True)
    value = (ops.ssim(x, y, reduction="none") * weight).sum()
    (slope,) = torch.autograd.grad(value, x, create_graph=True)
    with pytest.raises(NotImplementedError, match="once"):
        slope.sum().backward()
    with pytest.raises(NotImplementedError, match="once"):
        torch.autograd.grad(ops.photometric_loss(x, y).loss.square(), x, create_graph=True)
    (slope,) = torch.autograd.grad(ops.ssim(x, y), x, create_graph=True)
    assert not slope.requires_grad


def test_registration() -> None:
    x, y = pair(13, 15, 3, torch.float32)
    e = extras(13, 15, 3, torch.float32)
    planes = (e["valid"], e["alpha"].requires_grad_(), e["mask"], e["backdrop"])
    torch.library.opcheck(torch.ops.gsfluent.ssim.default, (x.clone().requires_grad_(), y, True))
    torch.library.opcheck(torch.ops.gsfluent.ssim.default, (x, y.clone().requires_grad_(), False))
    grad = torch.rand(3, 5, 3)
    torch.library.opcheck(torch.ops.gsfluent.ssim_backward.default, (grad, x, y, True))
    weights = (0.2, 0.8, -0.2, 2.0)
    call = torch.ops.gsfluent.photometric_loss.default
    torch.library.opcheck(call, (x.requires_grad_(), y, *planes, *weights, True, True, True))
    nothing = (None, None, None, None)
    torch.library.opcheck(call, (x.detach(), y, *nothing, *weights, False, True, False))
    compiled = torch.compile(ops.photometric_loss, fullgraph=True, backend="aot_eager")
    for got, want in zip(compiled(x, y), ops.photometric_loss(x, y), strict=True):
        assert torch.equal(got, want)
    leaf = x.detach().clone().requires_grad_()
    compiled(leaf, y).loss.square().backward()
    (want,) = torch.autograd.grad(ops.photometric_loss(leaf, y).loss.square(), leaf)
    assert leaf.grad is not None and torch.equal(leaf.grad, want)


def test_errors_name_the_argument() -> None:
    x = torch.rand(16, 16, 3)
    plane = torch.rand(16, 16)
    loss: Any = ops.photometric_loss
    similarity: Any = ops.ssim
    with pytest.raises(TypeError, match="image must be float32 or float64, got float16"):
        similarity(x.half(), x.half())
    with pytest.raises(TypeError, match="target must be a torch"):
        similarity(x, None)
    with pytest.raises(TypeError, match="target must be float32"):
        similarity(x, x.double())
    with pytest.raises(ValueError, match=r"same shape .* \[16, 16, 3\] and \[16, 15, 3\]"):
        similarity(x, x[:, :15])
    with pytest.raises(ValueError, match=r"11 to 32768 pixels.*same.*\[10, 16, 3\]"):
        similarity(x[:10], x[:10])
    with pytest.raises(ValueError, match="1 to 32768 pixels"):
        similarity(x[:0], x[:0], padding="same")
    with pytest.raises(ValueError, match="1 to 32 channels"):
        similarity(torch.rand(12, 12, 33), torch.rand(12, 12, 33))
    with pytest.raises(ValueError, match=r"image must have shape \[H, W, C\]"):
        similarity(plane, plane)
    with pytest.raises(ValueError, match="padding must be"):
        similarity(x, x, padding="reflect")
    with pytest.raises(ValueError, match="reduction must be"):
        similarity(x, x, reduction="sum")
    with pytest.raises(ValueError, match=r"ssim_weight must lie in 0\.\.1, got nan"):
        loss(x, x, ssim_weight=float("nan"))
    with pytest.raises(ValueError, match="mask_weight must be finite"):
        loss(x, x, mask_weight=-1.0)
    with pytest.raises(ValueError, match="alpha and mask"):
        loss(x, x, alpha=plane)
    with pytest.raises(ValueError, match="backdrop needs alpha"):
        loss(x, x, backdrop=torch.rand(3))
    with pytest.raises(ValueError, match=r"valid must have shape \[16, 16\], got \[16, 15\]"):
        loss(x, x, valid=plane[:, :15])
    with pytest.raises(NotImplementedError, match=r"target.detach\(\)"):
        loss(x, x.clone().requires_grad_())
