"""Voxels that follow the cells of the simulation."""

from __future__ import annotations

import pytest
import torch

from gsfluent.data import Gaussians
from gsfluent.pipeline.fill.stage import VOXELS_PER_CELL, fill_resolution, visible_extent
from gsfluent.pipeline.simulate.stage import QUALITY


@pytest.mark.parametrize("cells", [*QUALITY.values(), 96, 128])
def test_two_voxels_per_cell_or_finer(cells: int) -> None:
    assert fill_resolution(0.3, 0.3, cells) >= VOXELS_PER_CELL * cells


@pytest.mark.parametrize("cells", [64, 96, 200])
def test_objects_of_a_scene_share_the_size_of_voxels(cells: int) -> None:
    whole = 1.0 / fill_resolution(1.0, 1.0, cells)
    half = 0.5 / fill_resolution(0.5, 1.0, cells)
    assert half == pytest.approx(whole, rel=0.02)


def test_bounds() -> None:
    assert fill_resolution(1e-6, 1.0, 64) == 32
    assert fill_resolution(1.0, 1.0, 10_000) == 512
    assert fill_resolution(0.0, 0.0, 20) == fill_resolution(1.0, 1.0, 20)


def test_stray_splats_do_not_stretch_the_object() -> None:
    points = torch.rand(1000, 3, generator=torch.Generator().manual_seed(0))
    points[:3] = 100.0
    gaussians = Gaussians.from_colors(points, torch.full((1000,), 0.01), torch.ones(1000, 3))
    assert visible_extent(gaussians) == pytest.approx(1.0, abs=0.02)
    assert visible_extent(gaussians.select(torch.zeros(1000, dtype=torch.bool))) == 0.0
