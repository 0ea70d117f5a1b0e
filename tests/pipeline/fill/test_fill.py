"""Fill: what is inside an analytic shell, with everything that real splat files get wrong."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from interior_shapes import RADII, ellipsoid_shell, ellipsoid_truth, iou

from gsfluent import demo
from gsfluent.data import INTERIOR, SURFACE, Camera, Capture, Gaussians, Solid
from gsfluent.errors import InputError
from gsfluent.io import load_capture
from gsfluent.io.images import load_view
from gsfluent.pipeline.fill.stage import Fill
from gsfluent.pipeline.render.cuts import cut_view
from gsfluent.pipeline.solid.inside import DIRECTIONS, cast_votes, find_leaks
from gsfluent.spatial.density import GridBox, density_field


def _bottom_missing(points: torch.Tensor) -> torch.Tensor:
    return points[:, 2] > -0.5


@pytest.fixture(scope="module")
def solid() -> Solid:
    # discs overhang: their drawn outline is wider than the surface that they lie on
    return Fill(40, match_masks=False)(ellipsoid_shell())


def test_density_equals_direct_sum() -> None:
    gaussians = ellipsoid_shell(60, (1.0, 0.9, 0.8))
    box = GridBox((-1.3, -1.3, -1.3), 0.1, (26, 26, 26))
    field = density_field(
        gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, box
    )
    grid = torch.stack(torch.meshgrid(*[torch.arange(26)] * 3, indexing="ij"), -1).reshape(-1, 3)
    x = torch.tensor(box.origin).double() + (grid + 0.5) * box.voxel
    rotation = _matrices(gaussians)
    sigma = gaussians.scales.double().clamp(0.5 * box.voxel, 8 * box.voxel)
    precision = torch.einsum("nij,nj,nkj->nik", rotation, sigma**-2, rotation)
    offset = x[:, None] - gaussians.means.double()[None]
    power = torch.einsum("mni,nij,mnj->mn", offset, precision, offset)
    direct = (torch.exp(-0.5 * power) * gaussians.opacities.double()).sum(1).view(26, 26, 26)
    # the kernel is cut where it has fallen to exp(-3.1) = 0.044; a few tails overlap
    assert float((field - direct).abs().max()) < 0.15
    assert float((field - direct).abs().mean()) < 5e-3


def _matrices(gaussians: Gaussians) -> torch.Tensor:
    from gsfluent.geometry import quaternion_to_matrix

    return quaternion_to_matrix(gaussians.quats.double())


def test_what_hangs_free_beside_the_rest_is_filled_too() -> None:
    """Without matter it would be carried by the rest, and hover; a floater gets none."""
    ball = ellipsoid_shell(3000, (1.0, 1.0, 1.0))
    parts = [ball]
    for size, place in ((0.36, 1.8), (0.12, -1.8)):
        means = size * ball.means + torch.tensor([place, 0.0, 0.0])
        parts.append(ball.replace(means=means, scales=size * ball.scales))
    solid = Fill(48, match_masks=False)(Gaussians.cat(parts))
    centers = solid.voxel * (solid.occupancy.nonzero() + 0.5) + solid.origin
    hand, floater = centers[:, 0] > 1.3, centers[:, 0] < -1.3
    assert float(hand.sum()) / float((~hand).sum()) == pytest.approx(0.36**3, rel=0.35)
    assert not floater.any()


def test_closed_shell_is_filled(solid: Solid) -> None:
    assert iou(solid.occupancy.numpy(), ellipsoid_truth(solid)) > 0.97
    report = solid.report
    assert report["volume"] == pytest.approx(4 / 3 * np.pi * np.prod(RADII), rel=0.03)
    assert report["leaks"] == 0
    assert report["closed_side"] is None


def test_depth_is_distance_to_surface() -> None:
    ball = Fill(40, match_masks=False)(ellipsoid_shell(2500, (1.0, 1.0, 1.0)))
    centers = ball.voxel_centers()
    depth = ball.depth[ball.occupancy]
    error = (depth - (1.0 - centers.norm(dim=1))).abs()
    assert float(error.mean()) < 0.6 * ball.voxel
    assert float(error.max()) < 2.0 * ball.voxel


def test_missing_underside_is_closed_and_reported() -> None:
    filled = Fill(40, match_masks=False)(ellipsoid_shell(keep=_bottom_missing))
    truth = ellipsoid_truth(filled)
    z = float(filled.origin[2]) + (np.arange(truth.shape[2]) + 0.5) * filled.voxel
    truth &= (z > -0.5)[None, None]
    assert iou(filled.occupancy.numpy(), truth) > 0.94
    report = filled.report
    assert report["closed_side"] == [0.0, 0.0, -1.0]
    assert report["leaks"] == 1
    assert report["leaking_voxels"] > 1000
    # and it has a skin: without one it would be seen as deep as its inside begins
    g = filled.gaussians
    under = (g.labels == SURFACE) & (g.means[:, :2].norm(dim=1) < 0.3) & (g.means[:, 2] < 0.0)
    assert float(under.sum()) * filled.voxel**2 > 0.8 * np.pi * 0.3**2
    flat = g.select(under)
    assert float((flat.means[:, 2] + 0.5).abs().max()) < 1.5 * filled.voxel
    assert float(flat.scales[:, 2].max()) < 0.2 * filled.voxel
    assert not bool(((g.labels == SURFACE) & (g.means[:, 2] < -0.5 - 2.0 * filled.voxel)).any())


def test_bare_flood_fill_would_have_lost_the_object() -> None:
    from scipy import ndimage

    gaussians = ellipsoid_shell(keep=_bottom_missing)
    filled = Fill(40, match_masks=False)(gaussians)
    box = GridBox(
        tuple(float(v) for v in filled.origin), filled.voxel, tuple(filled.occupancy.shape)
    )
    shell = (
        density_field(
            gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, box
        ).numpy()
        >= 0.5
    )
    labels, _ = ndimage.label(~shell)
    flooded = labels == labels[0, 0, 0]
    assert iou(~flooded, ellipsoid_truth(filled)) < 0.5


def test_underside_stays_open_when_told() -> None:
    shell = ellipsoid_shell(keep=_bottom_missing)
    filled = Fill(32, match_masks=False, close_underside=False)(shell)
    closed = Fill(32, match_masks=False)(shell)
    assert filled.volume < 0.9 * closed.volume


def test_down_direction_closes_an_oblique_underside() -> None:
    down = torch.tensor([0.6, 0.0, -0.8])
    filled = Fill(40, match_masks=False, down=(0.6, 0.0, -0.8))(
        ellipsoid_shell(keep=lambda p: p @ down.double() < 0.45)
    )
    truth = ellipsoid_truth(filled)
    grid = np.stack(np.meshgrid(*(np.arange(s) for s in truth.shape), indexing="ij"), -1)
    points = filled.origin.numpy() + (grid + 0.5) * filled.voxel
    truth &= points @ down.numpy() < 0.45
    assert iou(filled.occupancy.numpy(), truth) > 0.88


def test_degenerate_splats_and_floaters_change_little(solid: Solid) -> None:
    clean = ellipsoid_shell()
    junk = Gaussians.from_colors(
        torch.tensor([[0.0, 0, 0.7], [0.5, 0, 0.4], [40.0, 3, 1], [-60.0, 0, 0]]),
        torch.tensor([[1e-15, 1e-15, 1e-15], [1e-9, 30.0, 1e-9], [1.0, 1, 1], [5.0, 5, 5]]),
        torch.full((4, 3), 0.5),
        opacities=torch.tensor([0.9, 0.02, 0.9, 0.9]),
    )
    dirty = clean.replace(quats=clean.quats * torch.linspace(0.2, 3.0, clean.count)[:, None])
    filled = Fill(40, match_masks=False)(Gaussians.cat([dirty, junk]))
    assert iou(filled.occupancy.numpy(), ellipsoid_truth(filled)) > 0.95
    # far away, or as large as the object
    assert filled.report["stray_gaussians"] + filled.report["unusable_gaussians"] == 2


def test_crevice_stays_open() -> None:
    """Two balls a gap apart: what lies between them is not inside."""
    ball = ellipsoid_shell(1500, (0.5, 0.5, 0.5))
    shifted = ball.replace(means=ball.means + torch.tensor([1.15, 0.0, 0.0]))
    filled = Fill(60, match_masks=False)(Gaussians.cat([ball, shifted]))
    assert filled.occupancy.any()
    middle = torch.tensor([[0.575, 0.0, 0.0], [0.575, 0.2, 0.1]])
    assert not bool(filled.contains(middle).any())
    centers = torch.tensor([[0.0, 0.0, 0.0], [1.15, 0.0, 0.0]])
    assert bool(filled.contains(centers).all())


def test_thin_sheet_survives_trimming() -> None:
    grid = torch.linspace(-1, 1, 60)
    points = torch.stack(torch.meshgrid(grid, grid, indexing="ij"), -1).reshape(-1, 2)
    means = torch.cat([points, torch.zeros(len(points), 1)], 1)
    sheet = Gaussians.from_colors(means, torch.full((len(means),), 0.02), torch.ones(len(means), 3))
    filled = Fill(48, match_masks=False, close_underside=False)(sheet)
    layers = filled.occupancy.any(2)
    inner = layers[6:-6, 6:-6]
    assert float(inner.float().mean()) > 0.99
    assert int(filled.occupancy.sum(2).max()) <= 3


def test_interior_gaussians_fill_without_spilling(solid: Solid) -> None:
    inner = solid.gaussians.select(solid.gaussians.labels == INTERIOR)
    outer = solid.gaussians.select(solid.gaussians.labels == SURFACE)
    assert inner.count == solid.report["interior_gaussians"] > 3000
    assert outer.count == 2500
    assert torch.equal(outer.means, ellipsoid_shell().means)
    reach = ((inner.means / torch.tensor(RADII)) ** 2).sum(1).sqrt().max()
    assert float(reach) < 1.0
    # evenly spread: every inner voxel a few voxels below the skin has one nearby
    deep = solid.voxel_centers((solid.depth > 3 * solid.voxel).nonzero())
    assert float(torch.cdist(deep[::50], inner.means).min(1).values.max()) < 2.2 * solid.voxel


def test_hollow_wall() -> None:
    filled = Fill(48, match_masks=False, hollow=0.15)(ellipsoid_shell(2500, (1.0, 1.0, 1.0)))
    radius = filled.voxel_centers().norm(dim=1)
    assert float(radius.min()) > 0.8
    expected = 1 - (1 - 0.85**3)
    assert filled.report["hollow_fraction"] == pytest.approx(expected, abs=0.06)
    solid_again = Fill(48, match_masks=False)(ellipsoid_shell(2500, (1.0, 1.0, 1.0)))
    assert solid_again.report["hollow_fraction"] == 0.0


def test_same_seed_same_solid() -> None:
    a, b = Fill(24, seed=5)(ellipsoid_shell(800)), Fill(24, seed=5)(ellipsoid_shell(800))
    assert torch.equal(a.gaussians.means, b.gaussians.means)
    assert torch.equal(a.occupancy, b.occupancy)
    c = Fill(24, seed=6)(ellipsoid_shell(800))
    assert not torch.equal(a.gaussians.means, c.gaussians.means)


def test_votes_of_a_box_and_of_a_cup() -> None:
    shell = np.zeros((14, 14, 14), bool)
    shell[2:12, 2:12, 2:12] = True
    shell[3:11, 3:11, 3:11] = False
    assert cast_votes(shell).score[7, 7, 7] == 1.0
    assert cast_votes(shell).score[0, 0, 0] < 0.4
    found = find_leaks(shell, cast_votes(shell).score > 0.8, np.zeros(3), 1.0)
    assert (found["leaks"], found["leaking_voxels"]) == (0, 0)
    cup = shell.copy()
    cup[3:11, 3:11, 11] = False
    vote = cast_votes(cup)
    assert vote.open_side == (0.0, 0.0, 1.0)
    assert vote.score[7, 7, 9] == 1.0
    found = find_leaks(cup, vote.score > 0.8, np.zeros(3), 1.0)
    assert found["leaks"] == 1 and found["leaking_voxels"] > 400
    assert len(DIRECTIONS) == 26


def _silhouettes(folder: Path, count: int = 8) -> Capture:
    from PIL import Image

    cameras = []
    for i in range(count):
        angle = 2 * np.pi * i / count
        eye = (3.5 * np.cos(angle), 3.5 * np.sin(angle), 1.2 * (-1) ** i)
        camera = Camera.look_at(eye, (0.0, 0.0, 0.0), width=120, height=120, fov=40)
        v, u = np.mgrid[:120, :120] + 0.5
        k = camera.K.numpy()
        ray = np.stack([(u - k[0, 2]) / k[0, 0], (v - k[1, 2]) / k[1, 1], np.ones_like(u)], -1)
        ray = ray @ camera.viewmat[:3, :3].numpy()
        o, d = np.array(eye) / RADII, ray / RADII
        hit = (o * d).sum(-1) ** 2 - (d * d).sum(-1) * ((o * o).sum() - 1) > 0
        pixels = np.zeros((120, 120, 4), np.uint8)
        pixels[..., :3] = 128
        pixels[..., 3] = 255 * hit
        path = folder / f"view_{i}.png"
        Image.fromarray(pixels).save(path)
        cameras.append(replace(camera, name=path.name, image_path=path))
    return Capture(cameras, torch.zeros(0, 3).double(), torch.zeros(0, 3), folder, load_view)


def test_masks_remove_what_is_not_the_object(tmp_path: Path) -> None:
    capture = _silhouettes(tmp_path)
    lump = ellipsoid_shell(400, (0.3, 0.3, 0.3))
    stray = lump.replace(means=lump.means + torch.tensor([0.0, 1.0, 0.0]))
    both = Gaussians.cat([ellipsoid_shell(), stray])
    hull = Fill(40, method="hull", refine_views=0)(both, capture)
    vote = Fill(40, method="vote")(both)
    assert hull.report["closed_by"] == "hull and vote"
    assert iou(hull.occupancy.numpy(), ellipsoid_truth(hull)) > 0.93
    assert iou(vote.occupancy.numpy(), ellipsoid_truth(vote)) < iou(
        hull.occupancy.numpy(), ellipsoid_truth(hull)
    )


def test_capture_prunes_and_reports(tmp_path: Path) -> None:
    filled = Fill(24, refine_views=4, refine_image_size=48)(
        ellipsoid_shell(800), _silhouettes(tmp_path)
    )
    assert filled.report["closed_by"] == "hull and vote"
    assert filled.report["seen_after"] <= filled.report["seen_before"]
    inner = int((filled.gaussians.labels == INTERIOR).sum())
    assert inner == filled.report["interior_gaussians"]
    assert filled.report["leaks"] == 0


def test_cut_view_shows_interior_and_skin(solid: Solid) -> None:
    color = torch.zeros((*solid.occupancy.shape, 3))
    color[..., 0] = 1.0
    red = replace(solid, color=color)
    image = cut_view(red, "x", size=64)
    assert max(image.shape[:2]) == 64 and image.dtype == np.float32
    middle = image[image.shape[0] // 2, image.shape[1] // 2]
    assert np.allclose(middle, [1.0, 0.0, 0.0], atol=1e-3)
    assert np.allclose(image[0, 0], 1.0)
    # beyond the matter the plane cuts nothing: only skin is seen
    skin = cut_view(red, 0, offset=float(solid.origin[0]), size=64)
    assert np.allclose(skin[32, 32], skin[32, 32, 0])


def test_errors() -> None:
    shell = ellipsoid_shell(400)
    with pytest.raises(InputError, match="means"):
        Fill(24)(shell.replace(means=shell.means.index_fill(0, torch.tensor([3]), float("nan"))))
    with pytest.raises(InputError, match="at least 16"):
        Fill(24)(shell.select(torch.arange(5)))
    with pytest.raises(InputError, match="method"):
        Fill(24, method="flood")
    with pytest.raises(InputError, match="resolution"):
        Fill(4)
    with pytest.raises(InputError, match="hollow"):
        Fill(24, match_masks=False, hollow="maybe")
    with pytest.raises(InputError, match="masks"):
        Fill(24, method="hull")(shell)
    with pytest.raises(InputError, match="thinner than a voxel"):
        Fill(24, match_masks=False, hollow=1e-4)(shell)
    with pytest.raises(InputError, match="no voxel reaches"):
        Fill(24)(shell.replace(opacities=shell.opacities * 1e-3))
    filled = Fill(24)(shell)
    with pytest.raises(ValueError, match="axis"):
        cut_view(filled, "w")


@pytest.mark.data
def test_real_plush_dog(data_root: Path) -> None:
    from gsfluent.io import load_splats

    path = data_root / "splats" / "plush_dog" / "point_cloud_29999_clean.ply"
    dog = load_splats(path)
    filled = Fill(40)(dog)
    report = filled.report
    assert report["interior_gaussians"] > 2000
    box = torch.tensor([float(v) for v in filled.occupancy.shape]).prod() * filled.voxel**3
    assert 0.05 < report["volume"] / float(box) < 0.8
    # a body, not a shell: the deepest point is many voxels below the surface
    assert float(filled.depth.max()) > 6 * filled.voxel


def test_masks_say_how_far_the_skin_lies_from_the_centres_of_the_splats(tmp_path: Path) -> None:
    paths = demo.make_capture("watermelon", tmp_path, views=12, size=96)
    capture = load_capture(paths.root)
    truth = demo.make_object("watermelon", 0)
    lower, upper = truth.bounds()
    half, middle = 0.5 * (upper - lower), 0.5 * (upper + lower)
    # splats a twentieth below the true skin, as training leaves them
    shell = ellipsoid_shell(4000, (1.0, 1.0, 1.0))
    place = (middle + 0.95 * half * shell.means.double()).float()
    sunk = shell.replace(means=place, scales=shell.scales * 0.95 * float(half.mean()))
    points = lower + (upper - lower) * torch.rand(
        50_000, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)
    )
    true = truth.inside(points)
    shares = {}
    for photographs in (None, capture):
        known = photographs is not None
        solid = Fill(36, match_masks=known, refine_views=0)(sunk, photographs)
        guess = solid.contains(points.float())
        shares[photographs is None] = float((guess & true).sum() / (guess | true).sum())
    assert solid.report["skin_offset"] > 0.2
    assert shares[False] > shares[True] + 0.05 and shares[False] > 0.9
