"""Labels of photographs on a solid: votes, unseen skin, instances, material of the points."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from region_scene import (
    RADIUS,
    ball_solid,
    capture_of,
    halves,
    iou,
    label_map,
    ring,
    segmentation,
)

from gsfluent import geometry
from gsfluent.data import Frame, Solid
from gsfluent.data.regions import FIRST_LABEL, region_mask
from gsfluent.errors import InputError
from gsfluent.io.segmentation.masks import LabelView, Segmentation
from gsfluent.io.solid import load_solid, save_solid
from gsfluent.pipeline.matter.points import build_matter, grid_spacing
from gsfluent.pipeline.regions.associate import associate
from gsfluent.pipeline.regions.image import image_labels
from gsfluent.pipeline.regions.project import label_regions, project_labels
from gsfluent.pipeline.regions.stage import Regions
from gsfluent.pipeline.regions.vote import find_skin, label_votes
from gsfluent.scene.scene import Scene


@pytest.fixture(scope="module")
def solid() -> Solid:
    return ball_solid()


def on_sphere(points: np.ndarray) -> np.ndarray:
    return np.asarray(points * (RADIUS / np.linalg.norm(points, axis=1))[:, None])


def write_masks(folder: Path, cameras: list, number: int | None = None) -> Path:  # type: ignore[type-arg]
    """Label maps as grey PNGs, or the masks of one label."""
    from PIL import Image

    folder.mkdir(parents=True, exist_ok=True)
    for camera in cameras:
        labels = label_map(camera)
        values = labels if number is None else 255 * (labels == number)
        Image.fromarray(values.astype(np.uint8)).save(folder / Path(camera.name).name)
    return folder


def test_votes_are_the_pixels_each_splat_makes_up(solid: Solid) -> None:
    # every label's pixels, blended: the votes of all splats for a label sum to the label's
    # covered pixels, which the accumulated opacity counts
    from gsfluent.draw import draw

    skin, camera = find_skin(solid), ring(1)[0]
    labels = label_map(camera)
    votes = label_votes(skin.splats, LabelView(camera, labels), np.array([0, 1, 2, 3]))
    alpha = draw(skin.splats, camera, colors=torch.ones(skin.splats.count, 1)).alpha.numpy()
    wanted = [float(alpha[labels == n].sum()) for n in range(4)]
    assert votes.sum(dim=0).tolist() == pytest.approx(wanted, rel=1e-4)


def test_skin_and_inside_get_the_labels_that_the_photographs_show(solid: Solid) -> None:
    found = project_labels(solid, segmentation(ring()))
    true = halves(on_sphere(found.skin.centers))
    for number in (1, 2, 3):
        assert iou(found.label == number, true == number) > 0.95
    assert (found.share[found.label > 0].mean()) > 0.9


def test_order_of_the_views_changes_nothing(solid: Solid) -> None:
    whole = segmentation(ring(8))
    turned = dataclasses.replace(whole, views=whole.views[::-1])
    first, second = project_labels(solid, whole), project_labels(solid, turned)
    assert np.array_equal(first.label, second.label)


def test_unseen_skin_stays_unlabelled(solid: Solid) -> None:
    above = ring(6, rise=(0.9,))  # nothing below is seen
    found = project_labels(solid, segmentation(above))
    below = found.skin.centers[:, 2] < -0.5 * RADIUS
    assert (found.label[below] == -1).all()
    assert (found.label[found.skin.centers[:, 2] > 0.5 * RADIUS] > 0).all()
    assert found.report()["unseen"] > 0.2


def test_the_majority_outvotes_a_wrong_view(solid: Solid) -> None:
    whole = segmentation(ring())
    clean = project_labels(solid, whole)
    wrong = list(whole.views)
    swapped = np.array([0, 2, 1, 3], np.int32)[wrong[4].labels]
    wrong[4] = dataclasses.replace(wrong[4], labels=swapped)
    found = project_labels(solid, dataclasses.replace(whole, views=tuple(wrong)))
    assert (found.label == clean.label).mean() > 0.97
    assert found.share.mean() < clean.share.mean()


def test_instances_are_linked_through_the_skin(solid: Solid) -> None:
    cameras = ring(20)
    whole = segmentation(cameras)
    rng = np.random.default_rng(3)
    views = []
    for index, view in enumerate(whole.views):
        labels = view.labels.copy()
        if index % 4 == 0:  # cut a part in two at some place of the picture
            column = int(rng.integers(35, 60))
            half = (labels == 2) & (np.arange(labels.shape[1]) > column)
            labels[half] = 4
        order = rng.permutation(9) + 1  # numbers without meaning
        views.append(
            LabelView(view.camera, np.where(labels > 0, order[labels], 0).astype(np.int32))
        )
    loose = Segmentation("instances", tuple(views), {}, linked=False)
    linked = associate(find_skin(solid), loose)
    assert list(linked.names.values()) == ["part 1", "part 2", "part 3"]
    found = project_labels(solid, loose)
    true = halves(on_sphere(found.skin.centers))
    for number in (1, 2, 3):
        assert max(iou(found.label == k, true == number) for k in (1, 2, 3)) > 0.9


def test_instances_are_linked_where_their_borders_wander(solid: Solid) -> None:
    # Masks grown or shrunk by two of 96 pixels: no border runs between the same two voxels in
    # most photographs, so neighbours would all be joined.
    import cv2

    rng = np.random.default_rng(5)
    views = []
    for view in segmentation(ring(24)).views:
        labels = view.labels.copy()
        on = view.labels > 0
        for number, other in ((1, 2), (3, int(rng.integers(1, 3)))):
            # the outline of the ball itself stays where it is
            mask = ((view.labels == number) | ~on).astype(np.uint8)
            grow = rng.random() < 0.5
            if grow:
                mask = (view.labels == number).astype(np.uint8)
            moved = (cv2.dilate if grow else cv2.erode)(mask, np.ones((5, 5), np.uint8)) > 0
            labels[(view.labels == number) & ~moved] = other
            labels[moved & on] = number
        order = rng.permutation(9) + 1
        numbers = np.where(labels > 0, order[labels], 0).astype(np.int32)
        views.append(LabelView(view.camera, numbers))
    found = project_labels(solid, Segmentation("instances", tuple(views), {}, linked=False))
    true = halves(on_sphere(found.skin.centers))
    for number in (1, 2):
        assert max(iou(found.label == k, true == number) for k in np.unique(found.label)) > 0.85


def test_two_sources_share_the_regions_and_inclusions_stay(solid: Solid, tmp_path: Path) -> None:
    cameras = ring()
    stones = torch.zeros(solid.occupancy.shape, dtype=torch.int32)
    stones[18:22, 18:22, 18:22] = 7
    parts = write_masks(tmp_path / "all", cameras)
    cap = write_masks(tmp_path / "cap", cameras, 3)
    labelled = label_regions(
        solid.replace(regions=stones),
        [{"labels": parts, "label": 1}, {"mask": cap}, {"labels": parts, "label": 2}],
        capture_of(cameras),
    )
    assert labelled.regions is not None
    assert torch.equal(labelled.regions[stones == 7], stones[stones == 7])
    numbers = set(labelled.regions.unique().tolist()) - {0, 7}
    assert numbers and min(numbers) >= FIRST_LABEL
    both = region_mask(labelled, {"labels": parts, "label": "3"}, "a")
    alone = region_mask(labelled, {"mask": cap}, "b")
    assert iou(both, alone) > 0.95  # the same patch, told in two ways
    assert region_mask(labelled, {"label": "inclusion"}, "c").sum() == 64
    again = label_regions(labelled, [{"mask": cap}], capture_of(cameras))
    assert torch.equal(again.regions, labelled.regions)


def test_saved_labels_come_back(solid: Solid, tmp_path: Path) -> None:
    cameras = ring(6)
    folder = write_masks(tmp_path / "cap", cameras, 3)
    labelled = label_regions(solid, [{"mask": folder}], capture_of(cameras))
    save_solid(labelled, tmp_path / "solid.ply")
    back = load_solid(tmp_path / "solid.ply")
    where = {"mask": folder}
    assert np.array_equal(region_mask(back, where, "cap"), region_mask(labelled, where, "cap"))


def test_the_frame_of_the_solid_changes_nothing(solid: Solid, tmp_path: Path) -> None:
    cameras = ring(8)
    folder = write_masks(tmp_path / "cap", cameras, 3)
    turn = geometry.quaternion_to_matrix(torch.tensor([0.8, 0.3, -0.4, 0.2], dtype=torch.float64))
    frame = Frame(turn, torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64), 2.5)
    plain = label_regions(solid, [{"mask": folder}], capture_of(cameras))
    moved = label_regions(solid.transformed(frame), [{"mask": folder}], capture_of(cameras))
    assert torch.equal(plain.regions, moved.regions)


def test_points_get_the_material_of_their_part(solid: Solid, tmp_path: Path) -> None:
    cameras = ring()
    folder = write_masks(tmp_path / "all", cameras)
    scene = Scene(floor=None)
    parts = [
        {"name": "right", "where": {"labels": folder, "label": 1}, "density": 1500.0},
        {"name": "cap", "where": {"labels": folder, "label": 3, "depth_below": 0.02},
         "material": "wood", "density": 500.0},
    ]  # fmt: skip
    labelled = label_regions(solid, [part["where"] for part in parts], capture_of(cameras))
    scene.add(labelled, "fruit.watermelon", parts=parts)
    matter = build_matter(scene, grid_spacing(scene, 20))
    at = matter.particles.position.numpy()
    density = (matter.particles.mass / matter.particles.volume).numpy()
    part, deep = halves(on_sphere(at)), RADIUS - np.linalg.norm(at, axis=1)
    assert iou(np.isclose(density, 1500.0), part == 1) > 0.93
    assert iou(np.isclose(density, 500.0), (part == 3) & (deep < 0.02)) > 0.85
    assert density[part == 2].min() < 1400.0


def test_label_images(solid: Solid, tmp_path: Path) -> None:
    from PIL import Image

    # seen along y, x runs right and z up: the left half red, the upper right quarter blue
    picture = np.zeros((20, 20, 3), np.uint8)
    picture[:, :10] = (255, 0, 0)
    picture[:10, 10:] = (0, 0, 255)
    Image.fromarray(picture).save(tmp_path / "side.png")
    labels, names, _ = image_labels(solid, {"y": tmp_path / "side.png"})
    number = {name: n for n, name in names.items()}
    at = solid.voxel_centers().numpy()
    found = labels[solid.occupancy.numpy()]
    assert np.array_equal(found == number["#ff0000"], at[:, 0] < 0)
    assert np.array_equal(found == number["#0000ff"], (at[:, 0] > 0) & (at[:, 2] > 0))
    # turned about z by 90 degrees, the scene's y is the solid's x
    quarter = Frame(
        torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64),
        torch.zeros(3, dtype=torch.float64),
        1.0,
    )
    labels, names, _ = image_labels(solid, {"y": tmp_path / "side.png"}, quarter)
    assert np.array_equal(labels[solid.occupancy.numpy()] == number["#ff0000"], at[:, 1] > 0)


def test_a_cut_labels_by_depth(solid: Solid, tmp_path: Path) -> None:
    from PIL import Image

    y, x = np.mgrid[0:101, 0:101] - 50.0
    radius = np.hypot(x, y)
    picture = np.where(radius <= 50, np.where(radius > 40, 1, 2), 0).astype(np.uint8)
    picture[48:52, 70:74] = 3  # a seed: the main label of no depth
    Image.fromarray(picture).save(tmp_path / "cut.png")
    labels, _, notes = image_labels(solid, {"": tmp_path / "cut.png"})
    depth = solid.depth.numpy() / float(solid.depth.max())
    inside = solid.occupancy.numpy()
    assert iou((labels == 1) & inside, (depth < 0.2) & inside) > 0.95
    assert set(np.unique(labels[inside])) == {1, 2}
    assert any("3" in note for note in notes)


def test_the_stage_takes_parts_and_labels_as_the_function_does(
    solid: Solid, tmp_path: Path
) -> None:
    cameras = ring(6)
    where = {"mask": write_masks(tmp_path / "cap", cameras, 3)}
    stage = Regions([{"name": "cap", "where": where, "cohesion": 2.0}])
    before = dict(vars(stage))
    labelled, same = (
        stage(solid, capture_of(cameras)),
        label_regions(solid, [where], capture_of(cameras)),
    )
    assert labelled.regions is not None and same.regions is not None
    assert bool((labelled.regions > 0).any()) and torch.equal(labelled.regions, same.regions)
    assert labelled.report["region_sources"] == same.report["region_sources"]
    assert vars(stage) == before


def test_what_is_missing_is_said(solid: Solid, tmp_path: Path) -> None:
    cameras = ring(6)
    folder = write_masks(tmp_path / "cap", cameras, 3)
    part = {"name": "cap", "where": {"mask": folder}, "cohesion": 2.0}
    with pytest.raises(InputError, match="need the photographs"):
        label_regions(solid, [part["where"]])
    with pytest.raises(InputError, match=r"not projected onto this solid[\s\S]*Regions\(parts\)"):
        Scene().add(solid, parts=[part])
    with pytest.raises(InputError, match="no region called 'leaf'"):
        scene = Scene()
        scene.add(solid, parts=[{"name": "x", "where": {"label": "leaf"}, "cohesion": 2.0}])
        build_matter(scene, grid_spacing(scene, 12))
    with pytest.raises(InputError, match="both mask and labels"):
        Scene().add(solid, parts=[{"where": {"mask": folder, "labels": folder}, "cohesion": 1.0}])
    away = [c.replace(viewmat=_shifted(c.viewmat)) for c in cameras]
    with pytest.raises(InputError, match="shows the object"):
        label_regions(solid, [{"mask": folder}], capture_of(away))


def _shifted(viewmat: torch.Tensor) -> torch.Tensor:
    """The camera looks past the object."""
    moved = viewmat.clone()
    moved[0, 3] += math.tan(math.radians(60.0))
    return moved
