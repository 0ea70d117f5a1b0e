"""The true pictures that judge a fracture: geometry that can be worked out by hand."""

from __future__ import annotations

import math

import pytest
import torch

from gsfluent import geometry
from gsfluent.data import Camera
from gsfluent.lab.truth.fracture_pictures import TrueCloud
from gsfluent.spatial.zbuffer import nearest_points

EDGE = 0.2
STEP = 0.02


def grid() -> torch.Tensor:
    line = (torch.arange(10) + 0.5) * STEP
    return torch.stack(torch.meshgrid(line, line, line, indexing="ij"), -1).reshape(-1, 3)


def stripes(points: torch.Tensor) -> torch.Tensor:
    """Red below half the height, blue above."""
    low = (points[:, 2] < 0.5 * EDGE).double()
    return torch.stack([low, torch.zeros_like(low), 1 - low], 1)


@pytest.fixture(scope="module")
def block() -> TrueCloud:
    corners = torch.zeros(3, dtype=torch.float64), torch.full((3,), EDGE, dtype=torch.float64)
    inside = lambda p: ((p > 0) & (p < EDGE)).all(1)  # noqa: E731
    return TrueCloud(inside, stripes, corners, EDGE / 60, grid(), STEP)


def far_camera(size: int = 120) -> Camera:
    """Looks along +y from so far off that perspective hardly shows; 0.4 m across."""
    return Camera.look_at(
        (0.1, -40.0, 0.1), (0.1, 0.1, 0.1), width=size, height=size,
        fov=2 * math.degrees(math.atan(0.2 / 40.0)),
    )  # fmt: skip


def state(block: TrueCloud) -> dict[str, torch.Tensor]:
    count = len(block.rest)
    return {
        "position": block.rest.clone(),
        "deformation": torch.eye(3).repeat(count, 1, 1),
        "fragments": torch.zeros(count, dtype=torch.int32),
    }


def area(block: TrueCloud, moved: dict[str, torch.Tensor]) -> float:
    """Silhouette [m^2]."""
    picture = block.draw(block.exposed(**moved), far_camera())
    return float(picture.alpha.sum()) * (0.4 / 120) ** 2


def test_the_whole_block_has_its_own_silhouette_and_colours(block):
    picture = block.draw(block.exposed(**state(block)), far_camera())
    assert area(block, state(block)) == pytest.approx(EDGE**2, rel=0.03)
    middle = picture.image[:, 60]
    assert torch.allclose(middle[45], torch.tensor([0.0, 0.0, 1.0]), atol=1e-5)
    assert torch.allclose(middle[75], torch.tensor([1.0, 0.0, 0.0]), atol=1e-5)
    assert torch.allclose(picture.image[2, 2], torch.ones(3))
    assert float(picture.depth[60, 60]) == pytest.approx(40.0, abs=0.01)


def test_a_piece_that_turns_and_stretches_has_no_gap(block):
    moved = state(block)
    angle = 0.3
    turn = geometry.quaternion_to_matrix(
        torch.tensor([math.cos(angle / 2), 0.0, math.sin(angle / 2), 0.0])
    )
    map_ = turn @ torch.diag(torch.tensor([1.3, 1.0, 1.0]))
    moved["position"] = (block.rest - 0.1) @ map_.T + 0.1
    moved["deformation"] = map_.expand(len(block.rest), 3, 3).contiguous()
    assert area(block, moved) == pytest.approx(1.3 * EDGE**2, rel=0.03)
    # opaque throughout: no pixel of the middle lets anything through
    alpha = block.draw(block.exposed(**moved), far_camera()).alpha
    assert float(alpha[45:75, 45:75].min()) == 1.0


def test_two_pieces_leave_a_gap_as_wide_as_they_part(block):
    moved = state(block)
    right = block.rest[:, 0] > 0.1
    moved["fragments"][right] = 1
    moved["position"][right] += torch.tensor([0.05, 0.0, 0.0])
    alpha = block.draw(block.exposed(**moved), far_camera()).alpha
    assert area(block, moved) == pytest.approx(
        EDGE**2, rel=0.04
    )  # points are a third of a pixel too large
    row = alpha[60]
    gap = float((1 - row[48:90]).sum()) * 0.4 / 120
    assert gap == pytest.approx(0.05, abs=0.003)


def test_crumbs_hold_together_until_they_have_parted(block):
    moved = state(block)
    loose = block.rest[:, 0] > 0.1
    moved["fragments"][loose] = -1
    for stretch, whole in ((1.3, True), (1.9, False)):
        moved["position"] = block.rest.clone()
        moved["position"][loose, 0] = 0.1 + stretch * (block.rest[loose, 0] - 0.1)
        alpha = block.draw(block.exposed(**moved), far_camera()).alpha
        covered = float(alpha[60, 62:80].mean())
        assert (covered > 0.99) == whole
    # alone from the start: 0.02 of every 0.026 m, and voxels are drawn 0.4 too large on each side
    alone = TrueCloud.__new__(TrueCloud)
    alone.__dict__ = block.__dict__ | {"parted": 1.0}
    moved["position"][loose, 0] = 0.1 + 1.3 * (block.rest[loose, 0] - 0.1)
    alpha = alone.draw(alone.exposed(**moved), far_camera(480)).alpha
    wanted = (1 + 0.8 * block.voxel / STEP) / 1.3
    assert float(alpha[240, 256:312].mean()) == pytest.approx(wanted, abs=0.05)


def test_places_follow_a_rigid_motion_exactly(block):
    moved = state(block)
    turn = geometry.quaternion_to_matrix(torch.tensor([0.9, 0.2, -0.4, 0.3]))
    moved["position"] = block.rest @ turn.T + 0.3
    moved["deformation"] = turn.expand(len(block.rest), 3, 3).contiguous()
    moved["fragments"][::3] = -1
    points = torch.rand(500, 3, generator=torch.Generator().manual_seed(1)) * EDGE
    places, maps = block.follow(points, block.owners(points), **moved)
    assert torch.allclose(places, points @ turn.T + 0.3, atol=2e-6)
    assert torch.allclose(maps, turn.expand(500, 3, 3), atol=2e-6)


def test_the_nearest_point_hides_the_others():
    camera = Camera.look_at((0, -2, 0), (0, 0, 0), width=20, height=20, fov=40)
    points = torch.tensor([[0.0, 0.5, 0.0], [0.0, -0.5, 0.0], [0.0, -3.0, 0.0], [9.0, 0.0, 0.0]])
    rows = nearest_points(points, 0.15, camera)
    assert int(rows[10, 10]) == 1  # not the one behind, nor the one behind the camera
    assert set(rows.unique().tolist()) == {-1, 1}
