"""The built-in objects: one seed gives one object, and photographs agree with the truth."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from gsfluent import demo
from gsfluent.data import INTERIOR, SURFACE, Gaussians, Solid
from gsfluent.demo import capture
from gsfluent.demo.capture import DemoPaths, moved, one_thread_per_operation
from gsfluent.demo.truth import grid_points
from gsfluent.errors import InputError
from gsfluent.io import load_capture


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> DemoPaths:
    return demo.make_capture(
        "watermelon", tmp_path_factory.mktemp("demo"), views=6, size=48, seed=3
    )


def test_same_seed_draws_the_same_pixels_and_another_seed_does_not() -> None:
    with one_thread_per_operation():
        first = demo.make_object("watermelon", 1)
        images = [
            demo.photograph(demo.make_object("watermelon", seed), _view(first), 40)[0]
            for seed in (1, 1, 2)
        ]
    assert torch.equal(images[0], images[1])
    assert not torch.allclose(images[0], images[2], atol=0.05)


def test_capture_folder_reads_back_with_posed_masked_images(small: DemoPaths) -> None:
    capture = load_capture(small.root)
    assert len(capture) == 6
    truth = demo.load_truth(small.truth)
    for number in range(6):
        image, mask, camera = capture.image(number)
        assert image.shape == (48, 48, 3) and mask is not None
        assert 0.2 < float(mask.mean()) < 0.8
        # Points of the surface project into the mask: pose, intrinsics and geometry agree.
        surface = truth.center + 0.98 * (_surface_points(truth, 300) - truth.center)
        pixel, depth = camera.project(surface)
        assert bool((depth > 0).all())
        column, row = pixel.floor().long().unbind(1)
        assert float((mask[row, column] > 0).float().mean()) > 0.99


def test_truth_volume_agrees_with_the_object(small: DemoPaths) -> None:
    truth = demo.load_truth(small.truth)
    with np.load(small.truth) as stored:
        parts, color = torch.from_numpy(stored["parts"].astype(np.int64)), stored["color"]
        origin, voxel = torch.from_numpy(stored["origin"]), float(stored["voxel"])
        depth = torch.from_numpy(stored["depth"])
    points = grid_points(origin, voxel, tuple(parts.shape))
    pick = torch.arange(0, len(points), 499)
    inside = truth.inside(points[pick])
    assert torch.equal(parts.reshape(-1)[pick] > 0, inside)
    assert torch.equal(truth.parts(points[pick]) * inside, parts.reshape(-1)[pick])
    rgb = torch.from_numpy(color).reshape(-1, 3)[pick][inside].float() / 255
    assert torch.allclose(truth.interior(points[pick][inside]), rgb, atol=0.003)
    # Depth is the distance to the surface: compare with the nearest of many surface points.
    near = pick[inside & (truth.depth(points[pick]) < 0.02)][:200]
    distance = torch.cdist(points[near], _surface_points(truth, 60_000)).min(1).values
    assert float((distance - depth.reshape(-1)[near]).abs().max()) < 0.002


def test_layers_lie_in_order_and_seeds_have_their_own_ids(small: DemoPaths) -> None:
    truth = demo.load_truth(small.truth)
    assert set(truth.labels(truth.seed_center[:5] + truth.center).tolist()) == {4}
    parts = truth.parts(truth.seed_center + truth.center)
    assert parts.tolist() == [4 + k for k in range(len(parts))]
    surface = _surface_points(truth, 200)
    inward = (truth.center - surface) / (truth.center - surface).norm(dim=1, keepdim=True)
    for depth, label in ((0.002, 1), (0.008, 2), (0.018, 3)):
        assert set(truth.labels(surface + depth * inward).tolist()) == {label}
    red = truth.interior(surface + 0.03 * inward).mean(0)
    assert red[0] > 0.6 and red[1] < 0.35


def test_object_rests_on_the_floor() -> None:
    for name in ("watermelon", "orange"):
        lowest = float(_surface_points(demo.make_object(name, 0), 40_000)[:, 2].min())
        assert abs(lowest) < 5e-4


def test_exemplar_shows_a_cut_with_a_mask(small: DemoPaths) -> None:
    from PIL import Image

    rgba = np.asarray(Image.open(small.cut)).astype(float) / 255
    assert rgba.shape[2] == 4
    middle = rgba[rgba.shape[0] // 2 - 20 :, rgba.shape[1] // 2 - 20 :][:40, :40, :3].mean((0, 1))
    assert middle[0] > 2 * middle[1]  # red flesh
    assert 0.5 < rgba[..., 3].mean() < 0.9


def test_table_capture_has_points_on_the_table_and_no_alpha(tmp_path: Path) -> None:
    paths = demo.make_capture("orange", tmp_path, views=3, size=32, support="table")
    document = json.loads(paths.transforms.read_text())
    assert document["ply_file_path"] == "sparse.ply"
    capture = load_capture(tmp_path)
    assert len(capture.points) > 2000
    image, mask, _ = capture.image(0)
    assert mask is not None and float(image[mask < 0.01].mean()) > 0.2
    assert float((capture.points[:, 2].abs() < 0.001).double().mean()) > 0.4


def test_interior_error_is_zero_for_the_truth_and_large_for_the_colour_copy() -> None:
    truth = demo.make_object("watermelon", 0)
    solid = _true_solid(truth, 0.006)
    exact = demo.interior_error(solid, truth)
    assert max(exact["profile"], exact["histogram"], exact["patch"]) < 1e-3
    assert exact["iou"] > 0.98
    assert exact["color_copy"]["profile"] > 10 and exact["color_copy"]["patch"] > 5
    # A sibling of the same kind lies near the truth, far from the copy.
    sibling = demo.make_object("watermelon", 5)
    centers = solid.voxel_centers(solid.occupancy.nonzero())
    color = solid.color.clone()
    color[solid.occupancy] = sibling.interior(centers)
    near = demo.interior_error(solid.replace(color=color), truth)
    assert 0 < near["patch"] < 0.3 * exact["color_copy"]["patch"]


def test_bad_requests_say_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="melon of doom"):
        demo.make_capture("melon of doom", tmp_path)
    with pytest.raises(InputError, match="size must be"):
        demo.make_capture(out_dir=tmp_path, size=8)
    with pytest.raises(InputError, match="views"):
        demo.make_capture(out_dir=tmp_path, views=1)
    with pytest.raises(InputError, match="support"):
        demo.make_capture(out_dir=tmp_path, support="cloud")
    with pytest.raises(InputError, match="truth"):
        demo.load_truth(tmp_path / "none.npz")


def _view(obj: demo.DemoObject) -> torch.Tensor:
    from gsfluent.demo.capture import ring_cameras

    return ring_cameras(obj, 6, on_table=False)[1]


def _surface_points(obj: demo.DemoObject, count: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    out = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    out /= out.norm(dim=1, keepdim=True)
    low, high = torch.zeros(count, dtype=torch.float64), torch.full((count,), 0.3).double()
    for _ in range(40):  # bisection along rays from the centre
        middle = 0.5 * (low + high)
        inside = obj.inside(obj.center + middle[:, None] * out)
        low, high = torch.where(inside, middle, low), torch.where(inside, high, middle)
    return obj.center + low[:, None] * out


def _true_solid(truth: demo.DemoObject, voxel: float) -> Solid:
    lower, upper = truth.bounds()
    shape = tuple(int(n) for n in ((upper - lower) / voxel).ceil())
    points = grid_points(lower, voxel, shape)
    inside = truth.inside(points)
    color = torch.zeros(len(points), 3)
    color[inside] = truth.interior(points[inside])
    surface = _surface_points(truth, 4000).float()
    matter = points[inside][::50].float()
    gaussians = Gaussians.cat(
        [
            Gaussians.from_colors(
                surface,
                torch.full((len(surface),), voxel),
                truth.surface_color(surface),
                label=SURFACE,
            ),
            Gaussians.from_colors(
                matter, torch.full((len(matter),), voxel), truth.interior(matter), label=INTERIOR
            ),
        ]
    )
    return Solid(
        gaussians,
        inside.view(shape),
        truth.depth(points).clamp_min(0).float().view(shape),
        lower.float(),
        voxel,
        color=color.view(*shape, 3),
    )


def _tensors(value: object) -> list[torch.Tensor]:
    """All tensors that an object holds, whatever holds them in it."""
    if isinstance(value, torch.Tensor):
        return [value]
    if isinstance(value, list | tuple):
        return [found for one in value for found in _tensors(one)]
    held = vars(value).values() if type(value).__module__.startswith("gsfluent") else ()
    return [found for one in held for found in _tensors(one)]


def test_an_object_is_moved_with_all_it_holds() -> None:
    here = demo.make_object("melons", 2)
    there = moved(here, torch.device("meta"))
    assert len(_tensors(there)) == len(_tensors(here)) > 10
    assert {value.device.type for value in _tensors(there)} == {"meta"}
    assert {value.device.type for value in _tensors(here)} == {"cpu"}


@pytest.mark.cuda
@pytest.mark.parametrize("name", ["watermelon", "melons", "cake", "bowl"])
def test_a_gpu_draws_the_same_photographs(name: str) -> None:
    here = demo.make_object(name, 1)
    there = moved(here, torch.device("cuda"))
    eyes = capture.ring_cameras(here, 3, on_table=True)
    table = capture.Table(1)
    for view in eyes:
        image, cover = demo.photograph(here, view, 96, table=table)
        drawn, covered = demo.photograph(there, view, 96, table=moved(table, torch.device("cuda")))
        assert drawn.is_cuda and covered.is_cuda
        assert float((cover - covered.cpu()).abs().mean()) < 2e-3
        assert float((image - drawn.cpu()).abs().mean()) < 2e-3
    image, mask = demo.cut_photograph(here.one(), 96)
    cut, cut_mask = demo.cut_photograph(there.one(), 96)
    assert float((image * mask[..., None] - (cut * cut_mask[..., None]).cpu()).abs().mean()) < 2e-3
