"""Measure projected labels against fruit whose patches are known; enter docs/measured/regions.md.

    python scripts/accuracy/regions.py [--resolution 96] [--only exact errors trained] [--write]

The demo watermelon and orange get patches with wavy borders; label maps are ray-cast from 42 views
of 256 pixels. `exact`: the solid is the truth's own voxels. `trained`: photographs, reconstruction
and filling as a user has them. `errors`: what is left when masks are wrong. IoU is the mean over
the patches, the worst in brackets. Skin: against the nearest point of the true surface; points: the
material points of `solve.quality: shot`, through and through, and those down to 15 mm only.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from gsfluent import demo
from gsfluent.data import SURFACE, Camera, Capture, Gaussians, Solid
from gsfluent.demo.capture import _FIELD_OF_VIEW, ring_cameras
from gsfluent.demo.objects import DemoObject
from gsfluent.demo.truth import grid_points
from gsfluent.figure.markdown import enter
from gsfluent.io import load_capture
from gsfluent.io.segmentation.masks import LabelView, Segmentation
from gsfluent.pipeline import Fill, Reconstruct
from gsfluent.pipeline.matter.points import sample_points
from gsfluent.pipeline.regions.project import SkinLabels, project_labels

PAGE = Path(__file__).resolve().parents[2] / "docs" / "measured" / "regions.md"
NAMES = {1: "front", 2: "back", 3: "lid", 4: "spot"}
VIEWS, SIZE = 42, 256
LAYER = 0.015
Mistake = Callable[[np.ndarray, np.random.Generator, int], np.ndarray]


def patches(fruit: DemoObject, points: torch.Tensor) -> np.ndarray:
    """Patch of points on the skin: two halves, a lid, a spot; wavy borders, int [N]."""
    s = (points - fruit.center.to(points)) / torch.tensor(fruit.axes).to(points)
    s = s / s.norm(dim=1, keepdim=True)
    turn = torch.atan2(s[:, 1], s[:, 0])
    label = torch.where(s[:, 0] > 0.15 * torch.sin(5 * torch.atan2(s[:, 2], s[:, 1])), 1, 2)
    label[s[:, 2] > 0.8 + 0.05 * torch.sin(6 * turn)] = 3
    spot = torch.nn.functional.normalize(torch.tensor([0.3, -1.0, -0.1]).to(s), dim=0)
    label[s @ spot > 0.93] = 4
    return label.numpy()


def label_view(fruit: DemoObject, camera: object) -> np.ndarray:
    """True labels of a photograph by ray casting."""
    y, x = torch.meshgrid(torch.arange(SIZE) + 0.5, torch.arange(SIZE) + 0.5, indexing="ij")
    K, view = camera.K, camera.viewmat
    local = torch.stack(
        [(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], torch.ones_like(x)], -1
    ).double()
    index, hit = fruit.intersect(camera.center(), (local.reshape(-1, 3) @ view[:3, :3]).float())
    labels = np.zeros(SIZE * SIZE, np.int32)
    labels[index.numpy()] = patches(fruit, hit)
    return labels.reshape(SIZE, SIZE)


def cameras_of(fruit: DemoObject) -> Capture:
    """The demo's cameras without its photographs."""
    focal = 0.5 * SIZE / np.tan(np.radians(0.5 * _FIELD_OF_VIEW))
    K = torch.tensor([[focal, 0, SIZE / 2], [0, focal, SIZE / 2], [0, 0, 1]], dtype=torch.float64)
    views = ring_cameras(fruit, VIEWS, on_table=False)
    cameras = [Camera(view, K, SIZE, SIZE, name=f"{i:03d}.png") for i, view in enumerate(views)]
    return Capture(cameras, torch.zeros(0, 3, dtype=torch.float64), torch.zeros(0, 3), Path("."))


def true_segmentation(fruit: DemoObject, capture: Capture) -> Segmentation:
    views = tuple(LabelView(camera, label_view(fruit, camera)) for camera in capture.cameras)
    return Segmentation("truth", views, NAMES)


def exact_solid(fruit: DemoObject, resolution: int) -> Solid:
    low, high = fruit.bounds()
    extent = float((high - low).max()) * 1.06
    origin, voxel = 0.5 * (low + high) - 0.5 * extent, extent / resolution
    points = grid_points(origin, voxel, (resolution,) * 3)
    cube = (resolution,) * 3
    splat = Gaussians.from_colors(
        high.float()[None], torch.full((1,), voxel), torch.ones(1, 3), label=SURFACE
    )
    depth = fruit.depth(points).float().clamp(min=0.0)
    return Solid(splat, fruit.inside(points).view(cube), depth.view(cube), origin.float(), voxel)


def trained(name: str, resolution: int) -> Solid:
    """The fruit as its photographs give it."""
    with tempfile.TemporaryDirectory() as folder:
        demo.make_capture(name, folder, views=30, size=192)
        capture = load_capture(folder)
        splats = Reconstruct(600, 15_000, image_size=192)(capture)
        return Fill(resolution=resolution)(splats, capture)


class Truth:
    """Labels of points by the nearest point of the true surface."""

    def __init__(self, fruit: DemoObject, count: int = 150_000) -> None:
        from scipy.spatial import cKDTree

        generator = torch.Generator().manual_seed(0)
        unit = torch.randn(count, 3, generator=generator, dtype=torch.float64)
        unit = unit / unit.norm(dim=1, keepdim=True)
        axes = torch.tensor(fruit.axes, dtype=torch.float64)
        surface = fruit.center + unit * axes * (1.0 + fruit._bump(unit))[:, None]
        self.tree, self.label = cKDTree(surface.numpy()), patches(fruit, surface)

    def at(self, points: np.ndarray) -> np.ndarray:
        return self.label[self.tree.query(points)[1]]


def overlap(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """IoU of each patch."""
    return np.array(
        [((found == k) & (true == k)).sum() / ((found == k) | (true == k)).sum() for k in NAMES]
    )


def said(values: np.ndarray) -> str:
    return f"{values.mean():.3f} ({values.min():.3f})"


def measured(solid: Solid, found: SkinLabels, truth: Truth) -> list[str]:
    """Skin, points through and through, points of the outer layer."""
    volume = found.inside(solid)
    low, high = (solid.voxel_centers().amin(0), solid.voxel_centers().amax(0))
    points = sample_points(solid, float((high - low).max()) / 40 / 2.0)
    index = solid.voxel_index(points)[0]
    got, want = volume[tuple(index.numpy().T)], truth.at(points.numpy())
    outer = solid.depth_at(points).numpy() < LAYER
    return [
        said(overlap(found.label, truth.at(found.skin.centers))),
        said(overlap(got, want)),
        said(overlap(got[outer], want[outer])),
    ]


def spoiled(
    segmentation: Segmentation, mistake: Mistake, amount: int, linked: bool = True
) -> Segmentation:
    rng = np.random.default_rng(7)
    views = tuple(
        dataclasses.replace(view, labels=mistake(view.labels, rng, amount).astype(np.int32))
        for view in segmentation.views
    )
    return dataclasses.replace(
        segmentation, views=views, linked=linked, names=NAMES if linked else {}
    )


def grown_or_shrunk(labels: np.ndarray, rng: np.random.Generator, pixels: int) -> np.ndarray:
    """Every mask grown or shrunk, as it falls, by up to so many pixels."""
    import cv2

    result = labels.copy()
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * pixels + 1,) * 2)
    for k in rng.permutation(list(NAMES)):
        mask = (labels == k).astype(np.uint8)
        if rng.random() < 0.5:
            result[(cv2.dilate(mask, disc) > 0) & (labels > 0)] = k
        else:
            lost = (mask > 0) & (cv2.erode(mask, disc) == 0)
            result[lost & (result == k)] = 0
    return result


def flipped(labels: np.ndarray, rng: np.random.Generator, percent: int) -> np.ndarray:
    """In so many of 100 views the labels are exchanged at random."""
    wrong = rng.random() < percent / 100
    order = np.concatenate([[0], rng.permutation(4) + 1])
    return order[labels] if wrong else labels


def segmented(labels: np.ndarray, rng: np.random.Generator, percent: int) -> np.ndarray:
    """Instances: numbers without meaning, so many of 100 masks cut in two or three."""
    result, top = labels.astype(np.int64), 4
    rows, columns = np.mgrid[0 : labels.shape[0], 0 : labels.shape[1]]
    for k in NAMES:
        for _ in range(2):
            if rng.random() < percent / 200 and (result == k).any():
                angle, y, x = rng.random() * np.pi, *rng.permutation(np.argwhere(result == k))[0]
                side = (rows - y) * np.cos(angle) + (columns - x) * np.sin(angle) > 0
                top += 1
                result[(result == k) & side] = top
    order = np.concatenate([[0], rng.permutation(top) + 1])
    return order[result]


def joined(labels: np.ndarray, rng: np.random.Generator, percent: int) -> np.ndarray:
    """As :func:`segmented` with half of the masks cut, and in so many of 100 views two joined."""
    if rng.random() < percent / 100:
        a, b = rng.permutation(4)[:2] + 1
        labels = np.where(labels == a, b, labels)
    return segmented(labels, rng, 50)


def wandering(labels: np.ndarray, rng: np.random.Generator, pixels: int) -> np.ndarray:
    """As :func:`joined` in 20 % of the views, of masks that are grown or shrunk as well."""
    return joined(grown_or_shrunk(labels, rng, pixels), rng, 20)


def matched(found: SkinLabels, truth: Truth) -> tuple[np.ndarray, int]:
    """IoU of each patch with the part that fits it best, and the number of parts."""
    true = truth.at(found.skin.centers)
    parts = np.unique(found.label[found.label > 0])
    best = [
        max(
            ((found.label == p) & (true == k)).sum() / ((found.label == p) | (true == k)).sum()
            for p in parts
        )
        for k in NAMES
    ]
    return np.array(best), len(parts)


def error_table(resolution: int) -> str:
    fruit = demo.make_object("watermelon", 0)
    clean = true_segmentation(fruit, cameras_of(fruit))
    solid, truth = exact_solid(fruit, resolution), Truth(fruit)
    rows = [
        "| masks | amount | skin IoU: mean (worst patch) | parts |",
        "| --- | --- | --- | --- |",
    ]
    cases: list[tuple[str, Mistake, str, tuple[int, ...], bool]] = [
        ("grown or shrunk at random", grown_or_shrunk, "{} px", (1, 2, 4, 8), True),
        ("labels exchanged", flipped, "in {} % of the views", (10, 20, 30, 40), True),
        ("instances without identity, cut up", segmented, "{} % of the masks", (0, 50, 100), False),
        ("half cut up, and pairs joined", joined, "in {} % of the views", (20, 40), False),
        ("the same in 20 %, grown or shrunk", wandering, "{} px", (2, 4, 8), False),
    ]
    for name, mistake, form, amounts, linked in cases:
        for amount in amounts:
            found = project_labels(solid, spoiled(clean, mistake, amount, linked))
            values, parts = matched(found, truth)
            if linked:
                values = overlap(found.label, truth.at(found.skin.centers))
            rows.append(f"| {name} | {form.format(amount)} | {said(values)} | {parts} |")
            sys.stderr.write(rows[-1] + "\n")
    return "\n".join(rows)


def accuracy_table(resolution: int, kinds: list[str]) -> str:
    rows = [
        "| fruit | solid | skin voxels | skin | points | points, outer 15 mm | CPU s |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for name in ("watermelon", "orange"):
        fruit = demo.make_object(name, 0)
        truth = Truth(fruit)
        labels = true_segmentation(fruit, cameras_of(fruit))
        for kind in kinds:
            solid = exact_solid(fruit, resolution) if kind == "exact" else trained(name, resolution)
            began = time.process_time()
            found = project_labels(solid, labels)
            spent = time.process_time() - began
            cells = [name, kind, str(len(found.skin)), *measured(solid, found, truth)]
            rows.append("| " + " | ".join([*cells, f"{spent:.1f}"]) + " |")
            sys.stderr.write(rows[-1] + "\n")
    return "\n".join(rows)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0],
        epilog=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--resolution", type=int, default=96, help="voxels along the longest side")
    parser.add_argument("--only", nargs="*", default=["exact", "trained", "errors"])
    parser.add_argument(
        "--write", action="store_true", help="enter the tables into docs/measured/regions.md"
    )
    given = parser.parse_args()
    tables = {}
    kinds = [kind for kind in ("exact", "trained") if kind in given.only]
    if kinds:
        tables["accuracy"] = accuracy_table(given.resolution, kinds)
    if "errors" in given.only:
        tables["errors"] = error_table(given.resolution)
    for name, table in tables.items():
        sys.stdout.write(table + "\n\n")
        if given.write:
            PAGE.write_text(enter(PAGE.read_text(encoding="utf-8"), name, table))
    return 0


if __name__ == "__main__":
    sys.exit(main())
