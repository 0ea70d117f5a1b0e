"""PSNR and SSIM against plain definitions."""

from __future__ import annotations

import math

import pytest
import torch

from gsfluent.metrics import psnr, ssim


def _plain_ssim(a: torch.Tensor, b: torch.Tensor) -> float:
    """Wang et al. 2004 pixel by pixel."""
    offset = torch.arange(11, dtype=torch.float64) - 5
    line = torch.exp(-(offset**2) / (2 * 1.5**2))
    window = torch.outer(line, line)
    window /= window.sum()
    values = []
    for c in range(a.shape[2]):
        for i in range(a.shape[0] - 10):
            for j in range(a.shape[1] - 10):
                x, y = a[i : i + 11, j : j + 11, c], b[i : i + 11, j : j + 11, c]
                mx, my = (window * x).sum(), (window * y).sum()
                vx = (window * (x - mx) ** 2).sum()
                vy = (window * (y - my) ** 2).sum()
                cov = (window * (x - mx) * (y - my)).sum()
                top = (2 * mx * my + 1e-4) * (2 * cov + 9e-4)
                values.append(top / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4)))
    return float(torch.stack(values).mean())


def test_ssim_equals_the_plain_definition() -> None:
    a, b = torch.rand(2, 15, 19, 3, dtype=torch.float64)
    b = 0.6 * a + 0.4 * b
    assert float(ssim(a, b)) == pytest.approx(_plain_ssim(a, b), abs=1e-12)
    assert float(ssim(a, b)) == pytest.approx(float(ssim(b, a)), abs=1e-12)
    assert float(ssim(a, a)) == pytest.approx(1.0)


def test_ssim_gradient() -> None:
    a, b = torch.rand(2, 13, 14, 2, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda x: ssim(x, b), a.requires_grad_(), fast_mode=True)


def test_psnr_of_known_error_and_mask() -> None:
    a = torch.zeros(4, 4, 3)
    b = torch.full((4, 4, 3), 0.1)
    assert psnr(a, b) == pytest.approx(20.0, abs=1e-4)
    b[0] = 0.0
    mask = torch.zeros(4, 4)
    mask[1:] = 1
    assert psnr(a, b, mask) == pytest.approx(20.0, abs=1e-4)
    assert math.isinf(psnr(a, b, 1 - mask))


def test_bad_shapes_are_named() -> None:
    with pytest.raises(ValueError, match="same shape"):
        psnr(torch.zeros(4, 4, 3), torch.zeros(4, 5, 3))
    with pytest.raises(ValueError, match="11"):
        ssim(torch.zeros(8, 20, 3), torch.zeros(8, 20, 3))
    with pytest.raises(ValueError, match="positive sum"):
        psnr(torch.zeros(4, 4, 3), torch.zeros(4, 4, 3), torch.zeros(4, 4))
    with pytest.raises(ValueError, match=r"\[21, 20, 3\] and \[20, 20, 3\]"):
        ssim(torch.zeros(21, 20, 3), torch.zeros(20, 20, 3))
