"""Distances are those of scipy; rays by doubling are the sweeps."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy import ndimage

from gsfluent.pipeline.solid.inside import DIRECTIONS, _blocked, blocked_by_doubling
from gsfluent.spatial.voxels import distance_transform, nearest_empty

SHAPES = [(7, 9, 5), (30, 41, 22), (1, 1, 17), (64, 3, 3)]


def _occupied(shape: tuple[int, ...], share: float) -> np.ndarray:
    random = np.random.default_rng(0).random(shape) < share
    random[(0,) * len(shape)] = False
    return random


@pytest.mark.parametrize("shape", [*SHAPES, (12, 17)])
def test_distances_are_those_of_scipy(shape: tuple[int, ...]) -> None:
    occupied = _occupied(shape, 0.97)
    expected = ndimage.distance_transform_edt(occupied)
    np.testing.assert_allclose(distance_transform(occupied), expected, rtol=1e-7)
    distance, index = nearest_empty(occupied)
    np.testing.assert_array_equal(distance, distance_transform(occupied))
    assert index.shape == (len(shape), *shape)
    assert not occupied[tuple(index)].any()
    away = index - np.indices(shape)
    np.testing.assert_allclose(np.sqrt((away**2).sum(0)), expected, rtol=1e-7)


@pytest.mark.parametrize("shape", SHAPES)
def test_rays_by_doubling_are_the_sweeps(shape: tuple[int, int, int]) -> None:
    hit = ~_occupied(shape, 0.97)
    for direction in DIRECTIONS:
        swept = _blocked(hit, direction)
        doubled = blocked_by_doubling(torch.from_numpy(hit), direction)
        np.testing.assert_array_equal(doubled.numpy(), swept)
