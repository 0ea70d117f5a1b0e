"""Colours of a side that nobody photographed are looked up part by part, with the same result."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gsfluent.data import SURFACE, Gaussians
from gsfluent.pipeline.solid import colors as fill_colors


def test_the_size_of_the_parts_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    generator = torch.Generator().manual_seed(3)
    means = torch.rand(400, 3, generator=generator)
    means[:, 2] *= 0.01  # a sheet
    colors = torch.rand(400, 3, generator=generator)
    splats = Gaussians.from_colors(means, torch.full((400, 3), 0.02), colors, label=SURFACE)
    points = np.random.default_rng(0).uniform(0.0, 1.0, (101, 3))
    far = points[:, 2] > 0.1
    assert 50 < far.sum() < 101  # most are farther than two widths from the sheet
    whole = fill_colors.surface_colors(splats, points, 0.02)
    monkeypatch.setattr(fill_colors, "_CHUNK", 7)
    parts = fill_colors.surface_colors(splats, points, 0.02)
    np.testing.assert_array_equal(whole, parts)
    assert float(whole[far].std()) < float(whole[~far].std())  # a wider surrounding is more even
