"""Reconstruct: starts on the hull, reaches a PSNR bar, resumes, refuses bad captures plainly."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from gsfluent import demo, ops
from gsfluent.data import BACKGROUND, SURFACE, Capture, Gaussians
from gsfluent.errors import InputError, RunError
from gsfluent.io import load_capture, save_image
from gsfluent.pipeline.capture.hull import focus_point, visual_hull
from gsfluent.pipeline.capture.views import TrainView, halved, read_views
from gsfluent.pipeline.reconstruct.init import hull_gaussians
from gsfluent.pipeline.reconstruct.isolate import Isolate, find_plane
from gsfluent.pipeline.reconstruct.masks import refined_mask
from gsfluent.pipeline.reconstruct.model import SplatModel
from gsfluent.pipeline.reconstruct.stage import Reconstruct


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    paths = demo.make_capture("watermelon", tmp_path_factory.mktemp("melon"), views=24, size=80)
    return load_capture(paths.root)


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    folder = tmp_path_factory.mktemp("table")
    demo.make_capture("watermelon", folder, views=16, size=64, support="table", masks=False)
    return load_capture(folder)


def test_hull_contains_the_object_and_little_more(capture: Capture) -> None:
    views = read_views(capture, 80, torch.device("cpu"), crop=True)
    hull = visual_hull(views, resolution=48)
    truth = demo.make_object("watermelon", 0)
    lower, upper = truth.bounds()
    draw = torch.rand(20_000, 3, dtype=torch.float64)
    points = lower + draw * (upper - lower)
    matter = points[truth.inside(points)].float()
    assert float(hull.contains(matter).float().mean()) > 0.999
    volume = float(hull.occupancy.sum()) * hull.voxel**3
    true_volume = len(matter) / len(points) * float((upper - lower).prod())
    assert volume < 1.25 * true_volume


def test_hull_gaussians_lie_on_the_surface_with_its_colours(capture: Capture) -> None:
    views = read_views(capture, 80, torch.device("cpu"), crop=True)
    start = hull_gaussians(visual_hull(views), views, 2000, 1, torch.Generator().manual_seed(0))
    truth = demo.make_object("watermelon", 0)
    depth = truth.depth(start.means.double())
    assert float(depth.abs().median()) < 0.005
    surface = truth.surface_color(start.means)
    assert float((start.colors() - surface).abs().mean()) < 0.12
    assert start.sh.shape == (2000, 4, 3)


def test_views_are_cropped_without_moving_the_projection(capture: Capture) -> None:
    full = capture.view(0, 80)
    crop = read_views(capture, 80, torch.device("cpu"), crop=True)[0]
    assert min(crop.size) < 80
    truth = demo.make_object("watermelon", 0)
    local = truth.center.float() @ crop.viewmat[:3, :3].T + crop.viewmat[:3, 3]
    small = halved(crop)
    pixels = [(k @ (local / local[2]))[:2] for k in (full.camera.K.float(), crop.K, small.K)]
    shift = (pixels[0] - pixels[1]).round().long().tolist()
    assert torch.allclose(pixels[1] / 2, pixels[2], atol=1e-4)
    width, height = crop.size
    window = full.image[shift[1] : shift[1] + height, shift[0] : shift[0] + width]
    assert full.mask is not None
    mask = full.mask[shift[1] : shift[1] + height, shift[0] : shift[0] + width]
    assert torch.allclose(crop.color, window * mask[..., None])


def test_small_reconstruction_reaches_its_bar_and_resumes(capture: Capture, tmp_path: Path) -> None:
    settings = {"iterations": 200, "image_size": 80, "start_gaussians": 2000, "seed": 1}
    seen: list[int] = []
    gaussians = Reconstruct(**settings)(
        capture, progress=lambda done, total, note: seen.append(done)
    )
    report = gaussians.report
    assert report["psnr"] > 25.0 and report["ssim"] > 0.85 and report["psnr_inside"] > 22.0
    assert report["held_out"] == 3 and report["images"] == 24
    assert report["gaussians"] == gaussians.count and seen[-1] == 200
    # no splat has a colour that no photograph shows
    views = read_views(capture, 80, torch.device("cpu"), crop=True)
    shown = [view.color[view.mask > 0.9] for view in views if view.mask is not None]
    low, high = torch.cat(shown).aminmax(dim=0)
    assert bool(((gaussians.colors() > low - 1e-4) & (gaussians.colors() < high + 1e-4)).all())
    # Interrupted after 100 steps and resumed, it ends where the uninterrupted run ends.
    file = tmp_path / "state.pt"
    stage = Reconstruct(**settings, checkpoint=file, checkpoint_every=100)

    def interrupt(done: int, total: int, note: str) -> None:
        if done == 110:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        stage(capture, progress=interrupt)
    assert file.is_file()
    resumed = stage(capture).report
    assert resumed["resumed_at"] == 100
    assert resumed["psnr"] == pytest.approx(report["psnr"], abs=0.5)
    file.write_bytes(b"not a checkpoint")
    with pytest.raises(InputError, match="damaged"):
        stage(capture)


def test_count_stays_under_the_cap_and_isotropic_kernels_are_round(capture: Capture) -> None:
    stage = Reconstruct(
        iterations=170, image_size=64, max_gaussians=700, start_gaussians=600,
        kernel="isotropic", gradient_threshold=1e-9,
    )  # fmt: skip
    gaussians = stage(capture)
    report = gaussians.report
    assert 600 < report["gaussians"] <= 700
    assert torch.equal(gaussians.scales[:, 0], gaussians.scales[:, 2])


def test_a_capture_without_masks_is_learned_whole_and_the_object_isolated(table: Capture) -> None:
    stage = Reconstruct(iterations=150, image_size=64, start_gaussians=2000, separate=False)
    gaussians = stage(table)
    report = gaussians.report
    assert report["start"] == "sparse points" and report["psnr_region"] == "whole image"
    assert report["psnr"] > 14.0
    found, rest = Isolate().split(gaussians, table)
    assert found.report["plane"]["normal"][2] > 0.97
    assert found.labels is not None and rest.labels is not None
    assert set(found.labels.tolist()) == {SURFACE} and set(rest.labels.tolist()) == {BACKGROUND}
    truth = demo.make_object("watermelon", 0)
    lower, upper = truth.bounds()
    near = (found.means > lower - 0.03).all(1) & (found.means < upper + 0.03).all(1)
    assert float(near.float().mean()) > 0.9
    assert float(found.means[:, 2].max()) > 0.7 * float(upper[2])


def test_object_is_learned_again_from_its_silhouettes_and_resumes(
    table: Capture, tmp_path: Path
) -> None:
    file = tmp_path / "state.pt"
    settings = {"iterations": 250, "image_size": 64, "start_gaussians": 3000}
    stage = Reconstruct(**settings, checkpoint=file, checkpoint_every=20)

    def interrupt(done: int, total: int, note: str) -> None:
        if done >= 200:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        stage(table, progress=interrupt)
    gaussians = stage(table)
    report = gaussians.report
    assert report["resumed_at"] == 190
    assert gaussians.labels is not None
    assert report["object_gaussians"] == int((gaussians.labels == SURFACE).sum()) > 500
    found = Isolate()(gaussians, table)
    assert found.count == report["object_gaussians"]
    truth = demo.make_object("watermelon", 0)
    depth = truth.depth(found.means.double())
    assert float((depth > -0.01).double().mean()) > 0.9  # nothing of table or shadow


def scattered(views: list[TrainView]) -> list[TrainView]:
    """Masks of two corners in turn: no voxel is on all of them."""
    made = []
    for number, view in enumerate(views):
        mask = torch.zeros(view.color.shape[:2])
        mask[(slice(2, 6), slice(2, 6)) if number % 2 else (slice(-6, -2), slice(-6, -2))] = 1.0
        made.append(replace(view, mask=mask))
    return made


def test_silhouettes_without_a_common_body_are_survived(
    table: Capture, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Given masks that contradict each other are an error; those that were found are not."""
    views = read_views(table, 64, torch.device("cpu"), crop=False)
    with pytest.raises(InputError, match="no common object"):
        visual_hull(scattered(views))
    monkeypatch.setattr(
        "gsfluent.pipeline.reconstruct.stage.object_views",
        lambda views, found, rest: (scattered(views), {}),
    )
    gaussians = Reconstruct(iterations=100, image_size=64, start_gaussians=2000)(table)
    assert "it stays as 60 of 100 steps have it" in caplog.text
    assert gaussians.labels is not None
    assert 0 < gaussians.report["object_gaussians"] < gaussians.count


def test_mask_is_refined_by_the_photograph() -> None:
    y, x = torch.meshgrid(torch.arange(80.0), torch.arange(80.0), indexing="ij")
    disc = ((x - 40) ** 2 + (y - 42) ** 2 < 20**2).float()
    rough = ((x - 41) ** 2 + (y - 43) ** 2 < 18**2).float()
    image = disc[..., None] * torch.tensor([0.8, 0.2, 0.1]) + 0.1 * torch.rand(80, 80, 3)
    mask = refined_mask(rough, image)
    assert mask is not None
    assert float(((mask > 0.5) == (disc > 0.5)).float().mean()) > 0.995
    assert refined_mask(torch.zeros(80, 80), image) is None


def test_isolate_by_box_and_by_masks(capture: Capture) -> None:
    truth = demo.make_object("watermelon", 0)
    means = torch.cat([truth.center[None].float(), torch.tensor([[0.6, 0.0, 0.1]])])
    pair = Gaussians.from_colors(means, torch.full((2,), 0.01), torch.rand(2, 3))
    by_mask, rest = Isolate("masks").split(pair, capture)
    assert torch.equal(by_mask.means, means[:1]) and torch.equal(rest.means, means[1:])
    by_box = Isolate("box", box=((0.5, -0.1, 0.0), (0.7, 0.1, 0.2)))(pair)
    assert torch.equal(by_box.means, means[1:])
    labelled = pair.replace(labels=torch.tensor([BACKGROUND, SURFACE], dtype=torch.int32))
    assert torch.equal(Isolate()(labelled, capture).means, means[1:])
    assert Isolate()(pair).count == 2  # nothing known, nothing removed
    with pytest.raises(InputError, match="needs the capture"):
        Isolate("plane")(pair)
    with pytest.raises(InputError, match="found no object"):
        Isolate("box", box=((5.0, 5.0, 5.0), (6.0, 6.0, 6.0)))(pair, None)
    with pytest.raises(InputError, match="needs a box"):
        Isolate("box")


def test_a_stage_keeps_nothing_of_what_it_saw(capture: Capture) -> None:
    means = demo.make_object("watermelon", 0).center[None].float()
    one = Gaussians.from_colors(means, torch.full((1,), 0.01), torch.rand(1, 3))
    isolate = Isolate()
    before = dict(vars(isolate))
    found = isolate(one, capture)
    assert found.report == {"method": "masks", "object": 1, "background": 0}
    assert vars(isolate) == before and one.report == {}
    assert found.to("cpu").select(torch.tensor([0])).report == found.report


def test_plane_is_found_among_outliers() -> None:
    generator = torch.Generator().manual_seed(0)
    flat = torch.rand(800, 3, generator=generator, dtype=torch.float64)
    flat[:, 2] = 0.4 + 0.002 * torch.randn(800, generator=generator, dtype=torch.float64)
    noise = torch.rand(500, 3, generator=generator, dtype=torch.float64)
    plane = find_plane(torch.cat([flat, noise]), torch.tensor([[0.5, 0.5, 3.0]]), 0.01)
    assert plane is not None
    assert float(plane.normal[2]) > 0.999 and plane.offset == pytest.approx(0.4, abs=0.005)
    assert find_plane(noise, torch.tensor([[0.5, 0.5, 3.0]]), 0.001) is None


def test_focus_point_is_where_the_cameras_look(capture: Capture) -> None:
    viewmats = torch.stack([camera.viewmat for camera in capture.cameras])
    center = demo.make_object("watermelon", 0).center
    assert torch.allclose(focus_point(viewmats), center, atol=1e-4)


def test_black_photographs_are_refused(table: Capture, tmp_path: Path) -> None:
    save_image(torch.zeros(64, 64, 3), tmp_path / "black.png")
    cameras = [camera.replace(image_path=tmp_path / "black.png") for camera in table.cameras]
    with pytest.raises(InputError, match="are black"):
        Reconstruct(iterations=1, image_size=64)(table.replace(cameras=cameras))


def test_photographs_too_small_for_the_window_are_refused(table: Capture, tmp_path: Path) -> None:
    save_image(torch.rand(8, 8, 3), tmp_path / "tiny.png")
    cameras = [c.replace(image_path=tmp_path / "tiny.png") for c in table.cameras]
    with pytest.raises(InputError, match="at least 12"):
        Reconstruct(iterations=1)(table.replace(cameras=cameras))


def test_neither_masks_nor_points_is_refused(table: Capture) -> None:
    bare = table.replace(points=table.points[:0], point_colors=table.point_colors[:0])
    with pytest.raises(InputError, match="no masks, and only 0 usable sparse points"):
        Reconstruct(iterations=1, image_size=64)(bare)


def test_empty_masks_are_refused(table: Capture, tmp_path: Path) -> None:
    save_image(torch.zeros(64, 64), tmp_path / "mask.png")
    cameras = [camera.replace(mask_path=tmp_path / "mask.png") for camera in table.cameras]
    with pytest.raises(InputError, match="every mask is empty"):
        Reconstruct(iterations=1, image_size=64)(table.replace(cameras=cameras))


def test_a_diverged_loss_names_the_step(capture: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    stage = Reconstruct(iterations=5, image_size=64, start_gaussians=300)

    activated = SplatModel.activated

    def broken(model: SplatModel, degree: int) -> ops.activation.Activated:
        splats = activated(model, degree)
        splats.scales[7] = float("nan")
        return splats

    monkeypatch.setattr(SplatModel, "activated", broken)
    with pytest.raises(RunError, match="loss became nan at step 0"):
        stage(capture)


def test_settings_out_of_range_are_refused() -> None:
    with pytest.raises(InputError, match="kernel"):
        Reconstruct(kernel="square")
    with pytest.raises(InputError, match="iterations"):
        Reconstruct(iterations=0)
    with pytest.raises(InputError, match="sh_degree"):
        Reconstruct(sh_degree=4)
