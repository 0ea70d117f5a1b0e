"""The resident solver refuses restitution at nodes: in a lasting contact it makes energy."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from gsfluent import ops
from gsfluent.lab.world.shapes import ball, parameters

E, RADIUS, SPEED = torch.float64, 3.0, 0.05


def ball_on_plane(**options: Any) -> ops.Solver:
    points = ball([0.0, 0.0, RADIUS + 0.5], RADIUS, 0.5)
    volume = torch.full((len(points),), 0.125, dtype=E)
    down = torch.tensor([0.0, 0.0, -SPEED], dtype=E).expand(len(points), 3).contiguous()
    return ops.Solver(
        points, down, volume, volume, dx=1.0, law=torch.zeros(1, dtype=torch.int32),
        params=parameters(0.9, 0.2, 1.0).reshape(1, 8).to(E), gravity=(0.0, 0.0, 0.0), **options,
    )  # fmt: skip


def plane(restitution: float = 0.0) -> torch.Tensor:
    return ops.collider_row("plane", mode="separate", restitution=restitution)[None]


def test_contact_between_fields_has_no_restitution() -> None:
    with pytest.raises(ValueError, match="restitution of contact must be 0"):
        ball_on_plane(restitution=0.5)


def test_colliders_have_no_restitution() -> None:
    with pytest.raises(ValueError, match="restitution of a collider must be 0"):
        ball_on_plane(colliders=plane(0.2))
    solver = ball_on_plane(colliders=plane())
    with pytest.raises(ValueError, match="restitution of a collider must be 0"):
        solver.set_colliders(plane(0.2))


def test_an_elastic_ball_bounces_by_itself_and_no_faster_than_it_came() -> None:
    solver = ball_on_plane(colliders=plane())
    solver.advance(60.0)
    back = float(solver.velocity[:, 2].mean()) / SPEED
    assert 0.8 < back <= 1.0  # with restitution 0.2 at nodes: 1.1 to 1.5
