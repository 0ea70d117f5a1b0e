"""Filling on a GPU against filling on the CPU."""

from __future__ import annotations

import pytest
import torch

from gsfluent.data import Gaussians
from gsfluent.pipeline import Fill
from gsfluent.spatial.density import choose_grid, density_field

pytestmark = [
    pytest.mark.cuda,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"),
]


def _shell(count: int) -> Gaussians:
    """Splats of all sizes and turns on an ellipsoid, a few degenerate ones among them."""
    generator = torch.Generator().manual_seed(3)
    direction = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator))
    means = direction * torch.tensor([1.0, 0.8, 0.7])
    scales = torch.exp(torch.randn(count, 3, generator=generator) - 4.0)
    quats = torch.randn(count, 4, generator=generator)
    scales[:3] = torch.tensor([[1e-15, 1e-15, 1e-15], [1e9, 1e-9, 1.0], [1.0, 1e-20, 1e-20]])
    opacities = 0.2 + 0.7 * torch.rand(count, generator=generator)
    colors = torch.rand(count, 3, generator=generator)
    return Gaussians.from_colors(means, scales, colors, opacities=opacities, quats=quats)


def _density(gaussians: Gaussians) -> torch.Tensor:
    box, _ = choose_grid(gaussians.means, gaussians.opacities, 64)
    return density_field(
        gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, box
    )


def test_density_on_the_gpu_is_that_on_the_cpu_and_the_same_every_time() -> None:
    gaussians = _shell(30_000)
    expected = _density(gaussians)
    moved = gaussians.to("cuda")
    first, second = _density(moved), _density(moved)
    assert first.device.type == "cuda"
    assert torch.equal(first, second)
    torch.testing.assert_close(first.cpu(), expected, rtol=1e-4, atol=1e-4)


def test_a_solid_filled_on_the_gpu_is_the_one_filled_on_the_cpu() -> None:
    gaussians = _shell(12_000)
    solid = Fill(resolution=48)(gaussians)
    moved = Fill(resolution=48)(gaussians.to("cuda"))
    assert moved.occupancy.device.type == "cuda"
    assert moved.gaussians.device.type == "cuda"
    same = moved.occupancy.cpu() == solid.occupancy
    assert float((~same).sum()) <= 1e-4 * float(solid.occupancy.sum())
