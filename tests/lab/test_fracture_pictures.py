"""The true pictures that judge a fracture: geometry that can be worked out by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from gsfluent import geometry
from gsfluent.data import Camera, Gaussians
from gsfluent.draw import draw
from gsfluent.lab.truth.fracture_pictures import TrueSolid
from gsfluent.lab.truth.true_pieces import partition, rigid_fit
from gsfluent.metrics import psnr
from gsfluent.spatial.zbuffer import nearest_points

EDGE = 0.2
STEP = 0.02
AXIS_TURN = geometry.quaternion_to_matrix(torch.tensor([0.9, 0.2, -0.4, 0.3]))


def grid() -> torch.Tensor:
    line = (torch.arange(10) + 0.5) * STEP
    rest = torch.stack(torch.meshgrid(line, line, line, indexing="ij"), -1).reshape(-1, 3)
    shake = torch.rand(rest.shape, generator=torch.Generator().manual_seed(0)) - 0.5
    return rest + 0.4 * STEP * shake


def stripes(points: torch.Tensor) -> torch.Tensor:
    """Red below half the height, blue above."""
    low = (points[:, 2] < 0.5 * EDGE).double()
    return torch.stack([low, torch.zeros_like(low), 1 - low], 1)


def cut(unit: torch.Tensor) -> TrueSolid:
    corners = torch.zeros(3, dtype=torch.float64), torch.full((3,), EDGE, dtype=torch.float64)
    inside = lambda p: ((p > 0) & (p < EDGE)).all(1)  # noqa: E731
    return TrueSolid(inside, stripes, corners, EDGE / 60, grid(), unit, STEP)


@pytest.fixture(scope="module")
def halves() -> TrueSolid:
    return cut((grid()[:, 0] > 0.5 * EDGE).long())


def far_camera(size: int = 120) -> Camera:
    """Looks along +y from so far off that perspective hardly shows; 0.4 m across."""
    return Camera.look_at(
        (0.1, -40.0, 0.1), (0.1, 0.1, 0.1), width=size, height=size,
        fov=2 * math.degrees(math.atan(0.2 / 40.0)),
    )  # fmt: skip


def parted(gap: float) -> torch.Tensor:
    """The points of the two halves, the right one a gap away."""
    rest = grid()
    return rest + (rest[:, :1] > 0.5 * EDGE) * torch.tensor([gap, 0.0, 0.0])


def covered(solid: TrueSolid, position: torch.Tensor) -> torch.Tensor:
    return solid.draw(solid.moved(position), far_camera()).alpha


def test_the_whole_block_has_its_own_silhouette_and_colours(halves):
    picture = halves.draw(halves.moved(grid()), far_camera())
    assert float(picture.alpha.sum()) * (0.4 / 120) ** 2 == pytest.approx(EDGE**2, rel=0.03)
    middle = picture.image[:, 60]
    assert torch.allclose(middle[45], torch.tensor([0.0, 0.0, 1.0]), atol=1e-5)
    assert torch.allclose(middle[75], torch.tensor([1.0, 0.0, 0.0]), atol=1e-5)
    assert torch.allclose(picture.image[2, 2], torch.ones(3))
    assert float(picture.depth[60, 60]) == pytest.approx(40.0, abs=0.01)


def test_a_piece_that_turns_has_no_gap(halves):
    turn = geometry.quaternion_to_matrix(torch.tensor([math.cos(0.15), 0.0, math.sin(0.15), 0.0]))
    alpha = covered(halves, (grid() - 0.1) @ turn.T + 0.1)
    assert float(alpha.sum()) * (0.4 / 120) ** 2 == pytest.approx(EDGE**2, rel=0.03)
    assert float(alpha[45:75, 45:75].min()) == 1.0


def test_two_pieces_leave_a_gap_as_wide_as_they_part(halves):
    row = covered(halves, parted(0.05))[60]
    gap = float((1 - row[48:90]).sum()) * 0.4 / 120
    # voxels are drawn 0.4 too large on both sides
    assert gap == pytest.approx(0.05 - 0.8 * halves.voxel, abs=0.002)


def test_the_cut_is_flat_where_the_points_are_not_and_volumes_are_theirs(halves):
    assert float(halves.volumes.sum()) == pytest.approx(EDGE**3, rel=1e-9)
    count = torch.bincount((grid()[:, 0] > 0.5 * EDGE).long()).numpy()
    assert np.allclose(halves.volumes / EDGE**3, count / count.sum(), rtol=0.01)
    left = halves.rest[halves.label == 0]
    inner = ((left[:, 1:] - 0.5 * EDGE).abs() < 0.25 * EDGE).all(1)
    y_z = (left[inner, 1:] / halves.voxel).round().long()
    column = y_z[:, 0] * 1000 + y_z[:, 1]
    last = torch.zeros(int(column.max()) + 1).scatter_reduce(0, column, left[inner, 0], "amax")
    last = last[last > 0]
    assert float(last.max() - last.min()) < 0.35 * STEP


def test_a_displacement_moves_the_cut():
    labels = np.where(np.arange(48)[:, None, None] < 24, 0, 1) * np.ones((1, 20, 20), int)
    shift = np.zeros((3, 48, 20, 20), np.float32)
    shift[0, :, 10:] = 2.0
    sizes = np.array([150, 150])
    flat, moved = (partition(labels.astype(np.int32), sizes, 6.0, s) for s in (None, shift))
    assert (flat == labels).all()
    face = (moved == 0).sum(axis=0)
    # volumes are kept, so that the step of two voxels goes half to each side
    assert set(face[:10].ravel()) == {25} and set(face[10:].ravel()) == {23}


def test_chips_keep_their_volume():
    near = grid() - grid().mean(0)
    chip = near.norm(dim=1) < 1.5 * STEP
    solid = cut(torch.where(chip, 5, 9))
    assert 5 < int(chip.sum()) < 40
    assert solid.volumes[0] == pytest.approx(EDGE**3 * int(chip.sum()) / 1000, rel=0.05)


def test_dust_goes_where_it_lay():
    unit = (grid()[:, 0] > 0.5 * EDGE).long()
    unit[::7] = -1
    unit[1] = 77  # a single point is dust as well
    assert len(cut(unit).volumes) == 2


def test_a_fit_is_rigid_and_leaves_out_what_has_strayed():
    rest, turn = grid().double().numpy(), AXIS_TURN.double().numpy()
    now = rest @ turn.T + 0.3
    now[::9] += np.array([1.0, -2.0, 0.5])
    rotation, move = rigid_fit(rest, now, STEP)
    assert np.allclose(rotation, turn, atol=1e-6) and np.allclose(move, 0.3, atol=1e-6)
    flat = rest * [1.0, 1.0, 0.0]
    assert np.linalg.det(rigid_fit(flat, flat, STEP)[0]) == pytest.approx(1.0)


def test_clean_pieces_are_judged_better_than_beads(halves):
    """Two halves drawn as they are, and the same with the band of the crack left as beads."""
    position, camera = parted(0.06), far_camera(160)
    truth = halves.draw(halves.moved(position), camera).image
    white = torch.ones(3)

    def seen(centers: torch.Tensor, size: float, colors: torch.Tensor) -> float:
        sizes = torch.full((len(centers),), size)
        splats = Gaussians.from_colors(centers, sizes, colors.float(), opacities=0.99)
        image = draw(splats, camera, background=white, near=0.01).image
        return float(psnr(image.clamp(0, 1), truth))

    colors = stripes(halves.rest.double())
    clean = seen(halves.moved(position), 0.35 * halves.voxel, colors)
    band = (grid()[:, 0] - 0.5 * EDGE).abs() < 2.0 * STEP
    firm = ((halves.rest[:, 0] - 0.5 * EDGE).abs() > 2.0 * STEP).nonzero()[:, 0]
    shake = torch.rand(int(band.sum()), 3, generator=torch.Generator().manual_seed(1)) - 0.5
    centers = torch.cat([halves.moved(position)[firm], position[band] + 2.0 * STEP * shake])
    beads = seen(
        centers, 0.4 * STEP, torch.cat([colors[firm], stripes(grid()[band].double())])
    )  # fmt: skip
    assert clean > 20.0
    assert beads < clean - 6.0


def test_the_nearest_point_hides_the_others():
    camera = Camera.look_at((0, -2, 0), (0, 0, 0), width=20, height=20, fov=40)
    points = torch.tensor([[0.0, 0.5, 0.0], [0.0, -0.5, 0.0], [0.0, -3.0, 0.0], [9.0, 0.0, 0.0]])
    rows = nearest_points(points, 0.15, camera)
    assert int(rows[10, 10]) == 1  # not the one behind, nor the one behind the camera
    assert set(rows.unique().tolist()) == {-1, 1}
