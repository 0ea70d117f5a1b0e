"""Interior Gaussians: where they sit, how large they are, and what photographs do to them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from gsfluent import demo
from gsfluent.data import INTERIOR, SURFACE, Camera, Capture, Gaussians, Solid
from gsfluent.draw import draw
from gsfluent.io import load_capture
from gsfluent.io.images import load_view
from gsfluent.pipeline.fill.interior import INTERIOR_OPACITY, interior_gaussians
from gsfluent.pipeline.fill.refine import asked_views, refine_opacity, witness
from gsfluent.pipeline.fill.stage import Fill
from gsfluent.pipeline.render.cuts import cut_view
from gsfluent.pipeline.solid.colors import keep_skin, skin_colors, stray_splats
from gsfluent.spatial.pieces import hilbert_code, small_pieces

SIZE = 40
RADIUS = 15.0
VOXEL = 0.1


def ball() -> tuple[torch.Tensor, torch.Tensor]:
    """Voxels of a ball and their depth [world units]."""
    line = torch.arange(SIZE) + 0.5 - 0.5 * SIZE
    radius = torch.stack(torch.meshgrid(line, line, line, indexing="ij"), -1).norm(dim=-1)
    inside = radius < RADIUS
    return inside, torch.where(inside, (RADIUS - radius) * VOXEL, 0.0)


def placed(**options: float):  # type: ignore[no-untyped-def]
    inside, depth = ball()
    given = {"skin": 0.6 * VOXEL, "core": 1.5 * VOXEL} | options
    return interior_gaussians(inside, depth, torch.zeros(3), VOXEL, **given)  # type: ignore[arg-type]


def distance_below(centers: torch.Tensor) -> torch.Tensor:
    return RADIUS * VOXEL - (centers - 0.5 * SIZE * VOXEL).norm(dim=1)


def test_hilbert_curve_visits_every_cell_by_steps_of_one() -> None:
    line = torch.arange(8)
    cells = torch.cartesian_prod(line, line, line)
    code = hilbert_code(cells, 3)
    assert torch.equal(code.sort().values, torch.arange(512))
    walk = cells[code.argsort()]
    assert torch.equal((walk[1:] - walk[:-1]).abs().sum(1), torch.ones(511, dtype=torch.int64))
    with pytest.raises(ValueError, match="bits"):
        hilbert_code(cells, 0)


def test_pieces_fill_their_voxels() -> None:
    index = torch.tensor([[1, 2, 3], [4, 5, 6]])
    point, row, volume = small_pieces(index, torch.tensor([3.0, 0.9]), seed=1)
    assert torch.equal(row.bincount(), torch.tensor([1, 8]))
    assert float(volume.sum()) == pytest.approx(2.0)
    assert torch.equal(point.floor().long(), index[row])


def test_nothing_outside_and_nothing_sticks_out() -> None:
    found = placed()
    depth = distance_below(found.centers)
    assert float(depth.min()) > 0
    # the depth is known to a quarter of a voxel (whole voxels, smoothed)
    assert float((found.sigmas - depth).max()) < 0.25 * VOXEL
    shallow = depth < 5.0 * VOXEL
    assert float((found.depths - depth)[shallow].abs().max()) < 0.25 * VOXEL


def test_as_fine_as_the_skin_where_they_meet_it_and_coarser_inward() -> None:
    found = placed()
    rank = found.depths.argsort()
    sigma = found.sigmas[rank]
    bands = torch.stack([part.mean() for part in sigma.tensor_split(12)])
    assert bool((bands[1:] >= bands[:-1] - 1e-9).all())
    assert float(sigma[-50:].mean() / sigma[:50].mean()) > 1.6
    assert float(sigma.max()) <= 0.5 * 1.5 * VOXEL * 1.0001


def test_one_gaussian_per_volume_of_its_spacing() -> None:
    # far from the skin: number times spacing cubed is the volume
    found = placed(skin=1.5 * VOXEL, core=1.5 * VOXEL)
    radius = (found.centers - 0.5 * SIZE * VOXEL).norm(dim=1)
    count = int((radius < 1.0).sum())
    assert count * (1.5 * VOXEL) ** 3 == pytest.approx(4.0 / 3.0 * np.pi, rel=0.05)


@pytest.mark.parametrize("bound", [300, 2000])
def test_count_is_bounded(bound: int) -> None:
    found = placed(max_count=bound)
    assert 0.9 * bound < len(found.centers) <= bound


def test_a_slab_through_the_cut_is_opaque() -> None:
    found = placed()
    middle = 0.5 * SIZE * VOXEL
    # five spacings of matter behind the plane, seen from the front
    slab = (found.centers[:, 0] >= middle) & (found.centers[:, 0] < middle + 0.75)
    splats = Gaussians.from_colors(
        found.centers[slab].float(),
        found.sigmas[slab].float(),
        torch.ones(int(slab.sum()), 3),
        opacities=INTERIOR_OPACITY,
    )
    eye = (middle - 30.0, middle, middle)
    camera = Camera.look_at(eye, (middle,) * 3, width=160, height=160, fov=6.5)
    alpha = draw(splats, camera, antialiased=True).alpha
    v, u = torch.meshgrid(torch.arange(160) + 0.5, torch.arange(160) + 0.5, indexing="ij")
    scale = 30.0 / float(camera.K[0, 0])
    radius = torch.hypot(u - camera.K[0, 2], v - camera.K[1, 2]) * scale
    inner = radius < (RADIUS - 1.5) * VOXEL
    assert float(alpha[inner].min()) > 0.99


def test_same_seed_same_places() -> None:
    first, again, other = placed(seed=3), placed(seed=3), placed(seed=4)
    assert torch.equal(first.centers, again.centers)
    assert torch.equal(first.sigmas, again.sigmas)
    assert first.centers.shape != other.centers.shape or not torch.equal(
        first.centers, other.centers
    )


def test_wrong_arguments() -> None:
    inside, depth = ball()
    with pytest.raises(ValueError, match="differ"):
        interior_gaussians(inside, depth[1:], torch.zeros(3), VOXEL, skin=0.1)
    with pytest.raises(ValueError, match="must be > 0"):
        placed(core=-1.0)
    nothing = interior_gaussians(inside & False, depth, torch.zeros(3), VOXEL, skin=0.1)
    assert nothing.centers.shape == (0, 3)


def watched(folder: Path, color: float, *, masks: bool = True) -> Capture:
    """Eight photographs of a ball of radius one and one colour."""
    from PIL import Image

    cameras = []
    for i in range(8):
        angle = 2 * np.pi * i / 8
        eye = (4.0 * np.cos(angle), 4.0 * np.sin(angle), 1.5 * (-1) ** i)
        camera = Camera.look_at(eye, (0.0, 0.0, 0.0), width=96, height=96, fov=40)
        v, u = np.mgrid[:96, :96] + 0.5
        k = camera.K.numpy()
        ray = np.stack([(u - k[0, 2]) / k[0, 0], (v - k[1, 2]) / k[1, 1], np.ones_like(u)], -1)
        ray = ray @ camera.viewmat[:3, :3].numpy()
        o = np.asarray(eye)
        hit = (ray @ o) ** 2 > (ray**2).sum(-1) * (o @ o - 1.0)
        picture = np.zeros((96, 96, 4 if masks else 3), np.uint8)
        picture[..., :3] = np.where(hit, 255 * color, 0)[..., None]
        if masks:
            picture[..., 3] = 255 * hit
        path = folder / f"{i}.png"
        Image.fromarray(picture).save(path)
        cameras.append(replace(camera, name=path.name, image_path=path))
    return Capture(cameras, torch.zeros(0, 3).double(), torch.zeros(0, 3), folder, load_view)


def shell(color: float, *, cap: bool = False) -> Gaussians:
    """An opaque ball of discs; with ``cap``, without its top."""
    count = 1500
    z = 1.0 - (2.0 * torch.arange(count) + 1.0) / count
    turn = torch.arange(count) * (np.pi * (3.0 - 5.0**0.5))
    ring = (1.0 - z * z).sqrt()
    points = torch.stack([ring * turn.cos(), ring * turn.sin(), z], 1) * 0.96
    if cap:
        points = points[points[:, 2] < 0.3]
    scales = torch.full((len(points), 3), 0.05)
    return Gaussians.from_colors(
        points, scales, torch.full((len(points), 3), color), opacities=0.95, label=SURFACE
    )


def with_inner(surface: Gaussians, places: list[list[float]], color: float) -> Gaussians:
    inner = Gaussians.from_colors(
        torch.tensor(places),
        torch.full((len(places),), 0.06),
        torch.full((len(places), 3), color),
        opacities=0.95,
        label=INTERIOR,
    )
    return Gaussians.cat([surface, inner])


SPILLED = [[0.0, 1.2, 0.0], [0.0, 0.0, 1.25], [0.8, -0.9, 0.1]]
HIDDEN = [[0.0, 0.0, 0.0], [0.3, 0.1, 0.0], [-0.4, 0.0, 0.1]]


@pytest.mark.parametrize("masks", [True, False])
def test_what_spills_goes_and_what_is_hidden_stays(tmp_path: Path, masks: bool) -> None:
    both = with_inner(shell(0.8), SPILLED + HIDDEN, 0.8)
    inner = both.labels == INTERIOR
    left, interior, report = refine_opacity(both, inner, watched(tmp_path, 0.8, masks=masks))
    assert report["pruned"] == 3 and left.count == both.count - 3
    assert torch.equal(left.means[interior], torch.tensor(HIDDEN))
    # nothing is raised, moved or recoloured
    assert torch.equal(
        left.opacities,
        both.opacities[torch.cat([torch.ones(1500), torch.zeros(3), torch.ones(3)]).bool()],
    )
    assert report["seen_after"] < 1e-3 < report["seen_before"]
    assert report["contradicted_before"] == 0.5 and report["contradicted_after"] == 0.0


def test_what_shows_through_a_hole_stays_when_its_colour_is_right(tmp_path: Path) -> None:
    capture = watched(tmp_path, 0.8)
    seen = [[0.0, 0.0, 0.7], [0.2, 0.0, 0.7]]
    for color, kept in ((0.8, 2), (0.1, 0)):
        both = with_inner(shell(0.8, cap=True), seen, color)
        _, interior, report = refine_opacity(both, both.labels == INTERIOR, capture)
        assert int(interior.sum()) == kept, report
        assert report["seen_before"] > 1e-3


def test_weights_are_those_of_the_rasterizer(tmp_path: Path) -> None:
    capture = watched(tmp_path, 0.8)
    both = with_inner(shell(0.8, cap=True), HIDDEN, 0.8)
    said = witness(both, asked_views(capture, 8, 96))
    total = torch.zeros(both.count)
    for camera in capture.cameras:
        contribution = draw(both, camera, contribution=True).contribution
        assert contribution is not None
        total += contribution
    assert torch.allclose(said.seen.float(), total, rtol=1e-3, atol=1e-3)
    assert bool((said.off <= said.seen + 1e-9).all())
    # nothing hides the only splat of a scene: what is seen of it is its size
    alone = with_inner(shell(0.8), [[0.0, 0.0, 0.0]], 0.8).select(torch.arange(1501) == 1500)
    said = witness(alone, asked_views(capture, 8, 96))
    assert float(said.seen / said.size) == pytest.approx(1.0, abs=0.1)


def test_photographs_of_a_filled_melon_stay_what_they_are(tmp_path: Path) -> None:
    paths = demo.make_capture("watermelon", tmp_path, views=12, size=96)
    capture = load_capture(paths.root)
    melon = demo.make_object("watermelon", 0)
    generator = torch.Generator().manual_seed(0)
    way = torch.randn(6000, 3, generator=generator, dtype=torch.float64)
    start = melon.center + 3.0 * max(melon.axes) * way / way.norm(dim=1, keepdim=True)
    points = torch.cat([melon.intersect(s, (melon.center - s)[None])[1] for s in start[:3000]])
    splats = Gaussians.from_colors(
        points.float(),
        torch.full((len(points),), 0.0035),
        melon.surface_color(points),
        opacities=0.9,
    )
    filled = Fill(32, refine_image_size=96)(splats, capture)
    inner = filled.gaussians.select(filled.gaussians.labels == INTERIOR)
    assert float((~melon.inside(inner.means.double())).double().mean()) < 0.005
    errors = []
    for gaussians in (splats, filled.gaussians):
        total = 0.0
        for index in range(0, 12, 4):
            view = capture.view(index)
            assert view.mask is not None
            total += float(
                (draw(gaussians, view.camera).image - view.image * view.mask[..., None])
                .square()
                .mean()
            )
        errors.append(total)
    loss = 10.0 * np.log10(errors[1] / errors[0])
    assert loss < 0.1


def block(length: int = 24, *, hairs: bool = False) -> Solid:
    """A cube of matter, red inside, with a green skin of splats; ``hairs`` stand on its top."""
    occupied = torch.zeros(length + 12, length + 12, length + 12, dtype=torch.bool)
    occupied[6:-6, 6:-6, 6:-6] = True
    if hairs:
        occupied[10:-10:4, 10:-10:4, -6:-3] = True
    line = torch.linspace(6.5, length + 5.5, length)
    u, v = (x.reshape(-1) for x in torch.meshgrid(line, line, indexing="ij"))
    faces = []
    for axis in range(3):
        for side in (6.0, length + 6.0):
            points = torch.stack([u, v], 1)
            height = torch.full_like(u, side)[:, None]
            faces.append(torch.cat([points[:, :axis], height, points[:, axis:]], 1))
    points = torch.cat(faces)
    green = torch.tensor([0.1, 0.8, 0.1]).repeat(len(points), 1)
    splats = Gaussians.from_colors(
        points, torch.full((len(points),), 1.2), green, opacities=0.99, label=SURFACE
    )
    color = torch.zeros((*occupied.shape, 3))
    color[..., 0] = 1.0
    depth = occupied.float()
    return Solid(splats, occupied, depth, torch.zeros(3), 1.0, color)


def test_fuzz_does_not_colour_the_skin() -> None:
    solid = block()
    point = np.array([[18.0, 18.0, 30.0], [12.0, 20.0, 30.0]])
    clean = skin_colors(solid, point)
    assert np.allclose(clean, [0.1, 0.8, 0.1], atol=0.02)
    box = torch.rand(300, 3, generator=torch.Generator().manual_seed(0))
    box = box * torch.tensor([12.0, 12.0, 1.5]) + torch.tensor([12.0, 12.0, 27.0])
    # opaque black splats below the face that nobody can see, and black fuzz above it
    for lifted, alpha, strays in ((0.5, 1.0, 0), (5.5, 0.3, 300)):
        places = box + torch.tensor([0.0, 0.0, lifted])
        black = Gaussians.from_colors(
            places, torch.full((300,), 0.3), torch.zeros(300, 3), opacities=alpha, label=SURFACE
        )
        stained = replace(solid, gaussians=Gaussians.cat([solid.gaussians, black]))
        assert np.abs(skin_colors(stained, point) - clean).max() < 0.1
        assert int(stray_splats(stained).sum()) == strays


def test_colour_goes_on_where_no_splat_is() -> None:
    solid = block()
    bottom = solid.gaussians.select(solid.gaussians.means[:, 2] > 10.0)
    colors = skin_colors(replace(solid, gaussians=bottom), np.array([[18.0, 18.0, 6.0]]))
    assert np.allclose(colors, [0.1, 0.8, 0.1], atol=0.05)


@pytest.mark.parametrize(("hairs", "extent"), [(False, 24.0), (True, 27.0)])
def test_outline_of_a_cut_is_sharp_and_hairs_are_not_in_it(hairs: bool, extent: float) -> None:
    image = cut_view(block(hairs=hairs), "x", size=144)
    # the cut face of a cube: a square of 24 voxels with rounded corners; nothing else is red
    red = image[..., 0] - image[..., 1]
    pixel = (extent + 5.0) / 144  # two and a half voxels of border
    assert float(red.clip(0.0).sum()) * pixel**2 == pytest.approx(24.0**2, rel=0.05)


def test_cut_aslant_shows_face_and_skin() -> None:
    image = cut_view(block(), (1.0, 0.2, 0.0), size=96, tilt=30.0)
    red = (image[..., 0] > 0.9) & (image[..., 1] < 0.1)
    green = (image[..., 1] > 2.0 * image[..., 0]) & (image[..., 0] < 0.2)
    assert red.mean() > 0.3 and green.mean() > 0.1
    # the viewer stands above: the top of the block lies above the face
    assert np.argwhere(green)[:, 0].min() < np.argwhere(red)[:, 0].min()
    with pytest.raises(ValueError, match="tilt"):
        cut_view(block(), "x", tilt=90.0)
    with pytest.raises(ValueError, match="axis"):
        cut_view(block(), (0.0, 0.0, 0.0))


def test_matter_that_shows_keeps_the_colour_of_the_skin() -> None:
    solid = block()
    places = [[18.0, 18.0, 30.6], [18.0, 18.0, 18.0]]
    both = with_inner(solid.gaussians, places, 0.0)
    colored = keep_skin(replace(solid, gaussians=both), both).colors()
    assert torch.allclose(colored[-2], torch.tensor([0.1, 0.8, 0.1]), atol=0.05)
    assert torch.equal(colored[:-2], both.colors()[:-2])
    assert torch.allclose(colored[-1], torch.zeros(3), atol=1e-6)


def test_walls_of_two_voxels_are_not_smoothed_away() -> None:
    line = torch.arange(SIZE) + 0.5 - 0.5 * SIZE
    radius = torch.stack(torch.meshgrid(line, line, line, indexing="ij"), -1).norm(dim=-1)
    wall = (radius < 15.0) & (radius > 12.9)
    solid = block()
    shell_ = replace(
        solid,
        occupancy=wall,
        depth=wall.float(),
        color=torch.tensor([1.0, 0.0, 0.0]).expand(*wall.shape, 3).contiguous(),
        origin=torch.tensor([-2.0, -2.0, -2.0]),
    )
    image = cut_view(shell_, "x", size=200)
    red = (image[..., 0] - image[..., 1]).clip(0.0)
    area = float(red.sum()) * (35.0 / 200) ** 2
    assert area == pytest.approx(np.pi * (15.0**2 - 12.9**2), rel=0.15)
