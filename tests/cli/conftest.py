"""A small closed shell of splats and a shot around it: the cheapest input for every stage."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from ball_shot import write_shot

from gsfluent.data import SURFACE, Gaussians
from gsfluent.io import save_splats

AXES = (1.0, 0.45, 0.45)  # slender, so that the fixed number of cells along it holds few points


def shell(count: int = 1500) -> Gaussians:
    """Splats over an ellipsoid 2 m long, striped so that there is a texture to look at."""
    index = torch.arange(count) + 0.5
    polar = torch.acos(1 - 2 * index / count)
    turn = math.pi * (1 + math.sqrt(5)) * index
    unit = torch.stack([turn.cos() * polar.sin(), turn.sin() * polar.sin(), polar.cos()], dim=-1)
    scales = torch.full((count,), 0.6 * math.sqrt(4 * math.pi / count))
    stripe = (unit[:, :1] * 20).sin() > 0
    colors = torch.where(stripe, torch.tensor([0.1, 0.4, 0.1]), torch.tensor([0.5, 0.7, 0.3]))
    means = unit * torch.tensor(AXES)
    return Gaussians.from_colors(means, scales, colors, opacities=0.95, label=SURFACE)


@pytest.fixture(autouse=True, scope="module")
def _small(small_quality: None) -> None:
    """What runs from the command line does is not how fine it is."""


@pytest.fixture(scope="session")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The shell as a .ply file."""
    path = tmp_path_factory.mktemp("splat") / "ball.ply"
    save_splats(shell(), path)
    return path


@pytest.fixture
def shot(ball: Path, tmp_path: Path) -> Path:
    """A shot that drops the ball: a few seconds of work in all."""
    return write_shot(tmp_path / "shot.yaml", ball)
