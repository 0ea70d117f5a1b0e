"""The distance transform without scipy is the one of scipy."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gsfluent.pipeline.solid.inside import DIRECTIONS, _blocked, blocked_by_doubling
from gsfluent.spatial.voxels import _separable, distance_transform, nearest_empty

SHAPES = [(7, 9, 5), (30, 41, 22), (1, 1, 17), (64, 3, 3)]


def _occupied(shape: tuple[int, int, int], share: float) -> np.ndarray:
    random = np.random.default_rng(0).random(shape) < share
    random[0, 0, 0] = False
    return random


@pytest.mark.parametrize("share", [0.3, 0.97, 1.0])
@pytest.mark.parametrize("shape", SHAPES)
def test_separable_minima_are_exact(shape: tuple[int, int, int], share: float) -> None:
    occupied = _occupied(shape, share)
    squared, flat = _separable(torch.from_numpy(occupied))
    distance, _ = nearest_empty(occupied)
    np.testing.assert_allclose(squared.float().sqrt().numpy(), distance, rtol=1e-6)
    found = np.stack(np.unravel_index(flat.numpy(), shape))
    assert not occupied[tuple(found)].any()
    here = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"))
    np.testing.assert_array_equal(((found - here) ** 2).sum(0), squared.numpy())


@pytest.mark.parametrize("shape", SHAPES)
def test_rays_by_doubling_are_the_sweeps(shape: tuple[int, int, int]) -> None:
    hit = ~_occupied(shape, 0.97)
    for direction in DIRECTIONS:
        swept = _blocked(hit, direction)
        doubled = blocked_by_doubling(torch.from_numpy(hit), direction)
        np.testing.assert_array_equal(doubled.numpy(), swept)


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_on_a_gpu_the_distances_are_the_same() -> None:
    occupied = _occupied((60, 70, 50), 0.99)
    device = torch.device("cuda")
    expected = distance_transform(occupied)
    np.testing.assert_allclose(distance_transform(occupied, device), expected, rtol=1e-6)
    distance, index = nearest_empty(occupied, device)
    np.testing.assert_allclose(distance, expected, rtol=1e-6)
    assert not occupied[tuple(index)].any()
