"""Masks of many views correct one another; residue behind the object is told from background."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from interior_shapes import ellipsoid_shell
from torch import Tensor

from gsfluent.data import Camera, Gaussians
from gsfluent.pipeline.capture.hull import visual_hull
from gsfluent.pipeline.capture.views import TrainView, cropped
from gsfluent.pipeline.reconstruct.evaluate import render_view
from gsfluent.pipeline.reconstruct.masks import (
    agreed_hull,
    hull_silhouette,
    object_views,
    seen_background,
)

SIZE = 56
GREEN = torch.tensor([0.1, 0.6, 0.2])


def view_of(splats: Gaussians, camera: Camera) -> tuple[TrainView, Tensor]:
    """A photograph of the splats before grey, and the true mask."""
    image, alpha = render_view(splats, camera)
    image = image + (1.0 - alpha[..., None]) * 0.75
    view = TrainView(image, None, None, camera.viewmat.float(), camera.K.float(), SIZE)
    return view, alpha


def cameras(count: int = 24) -> list[Camera]:
    found = []
    for index in range(count):
        angle, rise = 2.4 * index, 0.9 * math.sin(1.7 * index)
        eye = [4 * math.cos(angle) * math.cos(rise), 4 * math.sin(angle) * math.cos(rise)]
        eye.append(4 * math.sin(rise))
        found.append(Camera.look_at(eye, (0.0, 0.0, 0.0), width=SIZE, height=SIZE, fov=40.0))
    return found


@pytest.fixture(scope="module")
def shell() -> Gaussians:
    return ellipsoid_shell(2000, color=lambda p: GREEN.double().expand_as(p))


@pytest.fixture(scope="module")
def seen(shell: Gaussians) -> list[tuple[TrainView, Tensor]]:
    return [view_of(shell, camera) for camera in cameras()]


def overlap(a: Tensor, b: Tensor) -> float:
    a, b = a > 0.5, b > 0.5
    return float((a & b).sum()) / float((a | b).sum())


def test_masks_spoiled_by_floaters_are_made_again(
    shell: Gaussians, seen: list[tuple[TrainView, Tensor]]
) -> None:
    views = [view for view, _ in seen]
    # before every third lens hangs a splat that hides half of the object from it
    eyes = [-view.viewmat[:3, :3].T @ view.viewmat[:3, 3] for view in views[::3]]
    right = [view.viewmat[0, :3] for view in views[::3]]
    means = torch.stack([0.5 * eye + 0.35 * side for eye, side in zip(eyes, right, strict=True)])
    floaters = Gaussians.from_colors(
        means, torch.full((len(means),), 0.18), torch.full_like(means, 0.75), opacities=0.99
    )
    masked, counts = object_views(views, shell, floaters)
    assert counts["shown"] == 24 and counts["corrected"] >= 5 and counts["left_out"] <= 3
    truth = agreed_hull(
        [cropped(replace(view, mask=(alpha > 0.5).float())) for view, alpha in seen]
    )
    for view in masked:
        assert view.mask is not None
        # one pixel of the border is 7 % here; a mask that lost its half has 0.5
        assert overlap(view.mask, hull_silhouette(truth, view)) > 0.8


def test_good_masks_are_left_alone(shell: Gaussians, seen: list[tuple[TrainView, Tensor]]) -> None:
    far = Gaussians.from_colors(torch.tensor([[0.0, 0.0, 40.0]]), torch.ones(1), torch.ones(1, 3))
    masked, counts = object_views([view for view, _ in seen], shell, far)
    assert counts == {"shown": 24, "corrected": 0, "left_out": 0} and len(masked) == 24


def test_the_picture_of_a_hull_covers_the_masks_it_was_made_of(
    seen: list[tuple[TrainView, Tensor]],
) -> None:
    masked = [cropped(replace(view, mask=(alpha > 0.5).float())) for view, alpha in seen]
    hull = visual_hull(masked)
    for view in masked:
        assert view.mask is not None
        on = view.mask > 0.5
        drawn = hull_silhouette(hull, view) > 0.5
        assert float((on & ~drawn).sum()) / float(on.sum()) < 0.03
        assert overlap(drawn.float(), view.mask) > 0.85


def test_a_pose_that_is_off_does_not_cut_the_hull(seen: list[tuple[TrainView, Tensor]]) -> None:
    masked = [cropped(replace(view, mask=(alpha > 0.5).float())) for view, alpha in seen]
    wrong = masked[0].K.clone()
    wrong[0, 2] += 11.0  # the object lies 11 pixels beside its mask
    spoiled = [replace(masked[0], K=wrong), *masked[1:]]
    exact = visual_hull(masked)
    whole = float(exact.occupancy.sum()) * exact.voxel**3
    strict, agreed = visual_hull(spoiled), agreed_hull(spoiled)
    assert float(strict.occupancy.sum()) * strict.voxel**3 < 0.8 * whole
    assert float(agreed.occupancy.sum()) * agreed.voxel**3 > 0.95 * whole


def test_residue_inside_the_object_is_no_background(
    shell: Gaussians, seen: list[tuple[TrainView, Tensor]]
) -> None:
    inside = 0.4 * torch.randn(50, 3, generator=torch.Generator().manual_seed(0)).clamp(-1, 1)
    around = torch.nn.functional.normalize(torch.randn(80, 3), dim=1) * 3.0
    rest = Gaussians.from_colors(
        torch.cat([inside, around]), torch.full((130,), 0.1), torch.full((130, 3), 0.4),
        opacities=0.8,
    )  # fmt: skip
    kept, hidden = seen_background(shell, rest, [view for view, _ in seen])
    assert hidden >= 48 and kept.count == 130 - hidden
    far = kept.means.norm(dim=1) > 2.0
    assert int(far.sum()) >= 76
