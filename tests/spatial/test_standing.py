"""Which way a thing stands."""

from __future__ import annotations

import math

import numpy as np
import pytest
import trimesh

from gsfluent.spatial.standing import upright

Y, Z = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])


def points_of(mesh: trimesh.Trimesh, count: int = 4000) -> np.ndarray:
    return np.asarray(trimesh.sample.sample_surface(mesh, count, seed=1)[0])


def cone() -> np.ndarray:
    """A flat cone on its base; on its side it would roll over its rim."""
    return points_of(trimesh.creation.cone(radius=1.0, height=0.6))


def test_what_stands_keeps_its_convention() -> None:
    slab = points_of(trimesh.creation.box((2.0, 2.0, 0.7)))
    for axis in (Y, Z, -Z):
        up, turned = upright(slab, [axis, Z])
        assert up is axis and not turned


def test_what_would_fall_over_stands_on_the_next_axis() -> None:
    up, turned = upright(cone(), [Y, Z])
    assert up is Z and turned


@pytest.mark.parametrize("seed", range(4))
def test_where_no_axis_serves_the_hull_decides_in_any_frame(seed: int) -> None:
    rotation = trimesh.transformations.random_rotation_matrix(
        np.random.default_rng(seed).random(3)
    )[:3, :3]
    found = upright(cone() @ rotation.T, [rotation @ Y])
    assert found[1] and found[0] @ (rotation @ Z) > math.cos(math.radians(6))


def test_a_side_too_far_from_the_convention_is_not_taken() -> None:
    up, turned = upright(cone(), [Y], most=math.radians(45))
    assert up is Y and not turned


def test_points_in_a_plane_tell_nothing() -> None:
    flat = np.random.default_rng(0).random((50, 3)) * [1, 1, 0]
    assert upright(flat, [Y]) == (Y, False)
