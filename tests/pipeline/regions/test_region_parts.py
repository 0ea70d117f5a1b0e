"""Parts with labels in shots, runs, simulations and in what `inspect` shows."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from region_scene import ball_solid, capture_of, label_map, ring

from gsfluent.cli import main
from gsfluent.config import Shot
from gsfluent.data import SURFACE, Frame, Gaussians, Solid
from gsfluent.data.regions import with_inclusions
from gsfluent.errors import InputError
from gsfluent.inspection.parts import body_parts, solid_regions
from gsfluent.inspection.parts_picture import part_colors, save_parts_picture
from gsfluent.io.solid import save_solid
from gsfluent.pipeline.matter.points import build_matter, grid_spacing
from gsfluent.pipeline.regions.project import label_regions
from gsfluent.pipeline.simulate.stage import Simulate
from gsfluent.progress import LineReporter
from gsfluent.results.record import RunRecord
from gsfluent.results.store import StageStore
from gsfluent.scene.scene import Scene
from gsfluent.stages.context import RunContext
from gsfluent.stages.solids import load_solids, regions_stage


def stripes(path: Path) -> Path:
    """A side view in three stripes: 1, a thin 2, 3."""
    picture = np.full((8, 40), 1, np.uint8)
    picture[:, 24:26], picture[:, 26:] = 2, 3
    Image.fromarray(picture).save(path)
    return path


def bar() -> Solid:
    """A bar of 200 x 40 x 40 mm."""
    occupancy = torch.zeros(44, 12, 12, dtype=torch.bool)
    occupancy[2:42, 2:10, 2:10] = True
    splat = Gaussians.from_colors(
        torch.zeros(1, 3), torch.full((1,), 0.005), torch.ones(1, 3), label=SURFACE
    )
    depth = 0.01 * occupancy.float()
    return Solid(splat, occupancy, depth, torch.tensor([-0.11, -0.03, -0.03]), 0.005)


GLUE = {"tensile_strength": 1e5, "compressive_strength": 6e5, "fracture_energy": 0.1}
"""A twentieth of the strength of the plaster around it."""


@pytest.mark.parametrize("weak", [True, False])
def test_two_materials_part_at_a_weak_interface(tmp_path: Path, weak: bool) -> None:
    # A spinning bar is under tension along its length. Two materials joined by a weak layer part
    # in that layer, off the middle where the tension is largest; without it they hold.
    file = stripes(tmp_path / "side.png")
    parts: list[dict[str, Any]] = [
        {"name": "left", "where": {"label_image": {"y": file}, "label": 1}, "density": 900.0},
        {"name": "right", "where": {"label_image": {"y": file}, "label": 3}, "material": "plaster"},
    ]
    if weak:
        glue = {"label_image": {"y": file}, "label": 2}
        parts.append({"name": "glue", "where": glue, **GLUE})
    scene = Scene(floor=None, gravity=(0, 0, 0))
    labelled = label_regions(bar(), [part["where"] for part in parts])
    scene.add(labelled, "plaster", parts=parts, angular_velocity=(0, 0, 60))
    stage = Simulate("preview", repair=False, splats=False, free_flight=False, piece_flight=False,
                     sleep=False)  # fmt: skip
    *_, last = stage(scene, fps=1000, seconds=0.009)
    rest = build_matter(scene, grid_spacing(scene, 20)).rest[:, 0].numpy()
    broken = last.broken.numpy()
    pieces = last.fragments.numpy()
    large = [k for k in np.unique(pieces) if k >= 0 and (pieces == k).sum() > 200]
    if not weak:
        assert not broken.any() and len(large) == 1
        return
    cell = grid_spacing(scene, 20)
    assert (rest[broken] > 0.02 - cell).all() and (rest[broken] < 0.03 + cell).all()
    assert len(large) == 2
    first, second = sorted(large, key=lambda k: rest[pieces == k].min())
    # they meet in the glue, and there is air between them by now
    assert rest[pieces == first].max() < 0.03 and rest[pieces == second].min() > 0.02
    place = last.particles.position.numpy()
    along = place[pieces == second].mean(axis=0) - place[pieces == first].mean(axis=0)
    assert (place[pieces == first] @ along).max() < (place[pieces == second] @ along).min()


def test_the_table_and_the_picture_of_parts(tmp_path: Path) -> None:
    solid = ball_solid(24)
    scene = Scene(floor=None)
    parts = [
        {"name": "rind", "where": {"depth_below": 0.02}, "cohesion": 2.0},
        {"name": "core", "where": {"sphere": [0, 0, 0, 0.03]}, "material": "wood"},
        {"name": "lost", "where": {"box": [[5, 5, 5], [6, 6, 6]]}, "cohesion": 2.0},
    ]
    scene.add(solid, "fruit.watermelon", parts=parts, frame=Frame.identity(), name="melon")
    found = body_parts(scene.bodies[0], 0.01)
    rest, rind, core, lost = found.rows
    assert [row["part"] for row in found.rows] == ["melon", "rind", "core", "lost"]
    assert rind["material"] == "fruit.watermelon (cohesion 2)" and core["material"] == "wood"
    assert sum(row["share"] for row in found.rows) == pytest.approx(1.0)
    assert rind["share"] == pytest.approx(1 - 0.8**3, abs=0.05)
    assert core["volume"] == pytest.approx(4 / 3 * np.pi * 0.03**3, rel=0.1)
    assert rind["mean_depth"] < 0.02 < rest["mean_depth"] < core["mean_depth"]
    assert core["particles"] == pytest.approx(8 * core["volume"] / 0.01**3, rel=0.2)
    assert lost["volume"] == 0.0 and "lost" in found.warnings[0]
    save_parts_picture(found, tmp_path / "parts.png", "melon")
    picture = np.asarray(Image.open(tmp_path / "parts.png").convert("RGB")).astype(int)
    for color in part_colors(4)[:3]:  # each part's flat colour is on the cut faces
        assert (abs(picture - 255 * color).max(axis=-1) <= 1).sum() > 200


def test_a_solid_shows_its_regions(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cameras = ring(8)
    for camera in cameras:
        values = 255 * (label_map(camera) == 3).astype(np.uint8)
        Image.fromarray(values).save(tmp_path / Path(camera.name).name)
    solid = ball_solid(24)
    stones = torch.zeros(solid.occupancy.shape, dtype=torch.int32)
    stones[10:12, 10:12, 10:12], stones[13, 13, 13] = 1, 2
    labelled = label_regions(
        solid.replace(regions=stones), [{"mask": tmp_path}], capture_of(cameras)
    )
    rows = solid_regions(labelled).rows
    assert [row["part"] for row in rows] == ["rest", "inclusion (2)", tmp_path.name]
    assert rows[2]["agreement"] > 0.8 and rows[1]["volume"] == pytest.approx(9 * solid.voxel**3)
    save_solid(labelled, tmp_path / "solid.ply")
    out = tmp_path / "regions_of_it.png"
    assert main(["inspect", str(tmp_path / "solid.ply"), "-o", str(out), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert [row["number"] for row in report["parts"]] == [0, 1, 100_001]
    assert Image.open(out).size[0] > 1000


def shot_of(folder: Path, **where: Any) -> Shot:
    part = {"name": "cap", "where": where, "cohesion": 2.0}
    return Shot.from_dict({"capture": str(folder), "objects": {"ball": {"parts": [part]}}}, folder)


def test_a_run_projects_masks_once_and_again_when_they_change(tmp_path: Path) -> None:
    cameras, masks = ring(6), tmp_path / "masks"
    masks.mkdir()
    for camera in cameras:
        values = 255 * (label_map(camera) == 3).astype(np.uint8)
        Image.fromarray(values).save(masks / Path(camera.name).name)

    def run() -> tuple[bool, int]:
        store = StageStore(tmp_path / "stages")
        shot = shot_of(tmp_path, mask="masks", depth_below=0.01)
        record = RunRecord(tmp_path / "run.json", shot.resolved(), torch.device("cpu"), 0)
        context = RunContext(
            shot, tmp_path, torch.device("cpu"), 0, store, record, LineReporter(),
            capture=capture_of(cameras), source_key="same",
        )  # fmt: skip
        regions_stage(context)
        solid = load_solids(context)["ball"]
        scene = Scene()
        parts = [part.to_dict() for part in shot.objects["ball"].parts or ()]
        scene.add(solid, parts=parts)  # projected already: no capture needed
        assert context.record.values["regions"]["ball"]
        volume = body_parts(scene.bodies[0]).rows[1]["volume"]
        return store.results[-1].resumed, round(volume / solid.voxel**3)

    save_solid(ball_solid(24), tmp_path / "texture.ply")
    (tmp_path / "stages" / "texture").mkdir(parents=True)
    save_solid(ball_solid(24), tmp_path / "stages" / "texture" / "ball.ply")
    first, count = run()
    assert not first and count > 50
    assert run() == (True, count)
    for camera in cameras:  # now the mask is of everything
        values = 255 * (label_map(camera) > 0).astype(np.uint8)
        Image.fromarray(values).save(masks / Path(camera.name).name)
    again, more = run()
    assert not again and more > 3 * count
    (tmp_path / "stages" / "regions" / "ball.npz").write_bytes(b"cut short")
    assert run() == (False, more)  # what is damaged is projected anew


@pytest.mark.parametrize(
    ("where", "said"),
    [
        ({"mask": "nowhere"}, "does not exist"),
        ({"mask": "m", "labels": "m"}, "both mask and labels"),
        ({"mask": "m", "label": "leaf"}, "does nothing with mask"),
        ({"label_image": {"w": "side.png"}}, "unknown key"),
        ({"label_image": {}}, "name a file for x, y or z"),
        ({"label": 0}, "lie in 1"),
    ],
)
def test_conditions_that_cannot_be_are_refused_in_the_shot(
    tmp_path: Path, where: dict[str, Any], said: str
) -> None:
    (tmp_path / "m").mkdir()
    stripes(tmp_path / "side.png")
    with pytest.raises(InputError, match=said):
        shot_of(tmp_path, **where)


def test_masks_need_photographs_in_the_shot(tmp_path: Path) -> None:
    (tmp_path / "m").mkdir()
    (tmp_path / "a.ply").write_bytes(b"")
    part = {"name": "cap", "where": {"mask": "m"}, "cohesion": 2.0}
    values = {"splats": "a.ply", "objects": {"ball": {"parts": [part]}}}
    with pytest.raises(InputError, match=r"parts\.cap\.where\.mask needs photographs"):
        Shot.from_dict(values, tmp_path)


def test_a_shot_with_labels_reads_back(tmp_path: Path) -> None:
    stripes(tmp_path / "side.png")
    shot = shot_of(tmp_path, label_image={"x": "side.png"}, label=3, depth_below=0.01)
    again = Shot.from_dict(shot.resolved(), tmp_path / "elsewhere")
    assert again.resolved() == shot.resolved()
    assert again.objects["ball"].parts == shot.objects["ball"].parts


def test_the_shot_of_the_page_is_a_shot(tmp_path: Path) -> None:
    import re

    import yaml

    page = Path(__file__).resolve().parents[3] / "docs" / "guide" / "regions.md"
    found = re.search(r"```yaml\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    assert found is not None
    for name in ("captures/apple", "parts/stem", "segmentation"):
        (tmp_path / name).mkdir(parents=True)
    shot = Shot.from_dict(yaml.safe_load(found.group(1)), tmp_path)
    parts = shot.objects["apple"].parts or ()
    assert [part.name for part in parts] == ["skin", "stem", "leaf", "core"]
    assert parts[2].where.label == "leaf"


def test_inclusions_placed_later_leave_the_labels(tmp_path: Path) -> None:
    labels = stripes(tmp_path / "side.png")
    solid = label_regions(bar(), [{"label_image": {"y": labels}}])
    stones = np.zeros(tuple(solid.occupancy.shape), np.int32)
    stones[5:7, 5:7, 5:7] = 3
    regions, table = with_inclusions(solid, stones)
    assert regions is not None and solid.regions is not None
    assert (regions[5:7, 5:7, 5:7] == 3).all() and int((regions == 3).sum()) == 8
    assert torch.equal(regions[10:], solid.regions[10:]) and table["regions"]
    again, _ = with_inclusions(solid.replace(regions=regions), np.roll(stones, 10, axis=0))
    assert again is not None and int((again[5:7, 5:7, 5:7] == 3).sum()) == 0  # placed anew
