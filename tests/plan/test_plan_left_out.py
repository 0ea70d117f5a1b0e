"""Model no more than a scene needs: what a plan leaves out, a run leaves out, and says so."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from simulation_scenes import SOFT, at
from simulation_shapes import ellipsoid

from gsfluent import materials
from gsfluent.config import Shot
from gsfluent.io.splats.load import save_splats
from gsfluent.pipeline.simulate.stage import Simulate, Simulation
from gsfluent.plan.motion import foresee
from gsfluent.plan.plan import insulated
from gsfluent.plan.work import passes_of
from gsfluent.scene.scene import Scene

APPLE = materials.fruit.apple.override(variation=0.0)
DX = 0.0125


@pytest.fixture(scope="module")
def shot(tmp_path_factory: pytest.TempPathFactory) -> Shot:
    """Only its light, texture and output are read here."""
    splats = tmp_path_factory.mktemp("shot") / "ball.ply"
    save_splats(ellipsoid().gaussians, splats)
    return Shot.from_dict({"splats": str(splats), "events": [{"type": "drop", "height": 0.1}]})


def needed(shot: Shot, scene: Scene, seconds: float) -> dict[str, bool]:
    outlook = foresee(scene, DX, seconds, 4, [4000] * len(scene.bodies))
    rows = passes_of(shot, scene, outlook)
    assert all(row["why"] for row in rows if row["pass"] not in ("rigid things", "blades"))
    return {row["pass"]: row["needed"] for row in rows}


def ran(scene: Scene, seconds: float) -> tuple[dict[str, Any], Simulation]:
    simulation = Simulate(dx=DX, splats=False)(scene, fps=4 / seconds, seconds=seconds)
    for _ in simulation:
        pass
    report = simulation.report
    assert report["verdict"] == "clean"
    return report, simulation


def ball(material: materials.Material, height: float, speed: float = 0.0) -> Scene:
    scene = Scene()
    scene.add(ellipsoid((0.05,) * 3), material, frame=at(0, 0, 0.05), velocity=(0, 0, -speed))
    scene.drop(height)
    return scene


def test_no_brittle_part_gets_no_damage_variable(shot: Shot) -> None:
    wanted = needed(shot, ball(SOFT, 0.0), 0.05)
    assert not wanted["damage variable"] and not wanted["return map"] and not wanted["repair"]
    report, simulation = ran(ball(SOFT, 0.0), 0.05)
    assert report["substeps"] > 0
    assert report["skipped"]["damage_steps"] == report["substeps"]
    assert bool((simulation.run.state.peak == -1.0).all())


def test_a_brittle_part_has_a_damage_variable(shot: Shot) -> None:
    scene = ball(SOFT, 0.0)
    inner = [{"name": "core", "where": {"depth_above": 0.02}, "material": APPLE.name}]
    scene = Scene()
    scene.add(ellipsoid((0.05,) * 3), SOFT, frame=at(0, 0, 0.05), parts=inner)
    assert needed(shot, scene, 0.05)["damage variable"]
    report, _ = ran(scene, 0.05)
    assert report["skipped"]["damage_steps"] == 0 < report["substeps"]


def test_one_body_gets_no_contact_fields(shot: Shot) -> None:
    assert not needed(shot, ball(SOFT, 0.0), 0.05)["contact fields"]
    report, _ = ran(ball(SOFT, 0.0), 0.05)
    assert report["fields_max"] == 1
    assert report["skipped"]["contact_steps_done"] == 0
    assert report["skipped"]["contact_steps"] == report["substeps"] > 0


def test_two_bodies_get_them_only_where_they_are_near(shot: Shot) -> None:
    scene = Scene()
    for side in (-1.0, 1.0):
        scene.add(ellipsoid((0.05,) * 3), SOFT, frame=at(0.058 * side, 0, 0.05),
                  velocity=(-1.0 * side, 0, 0))  # fmt: skip
    assert needed(shot, scene, 0.02)["contact fields"]
    report, _ = ran(scene, 0.02)
    assert report["fields_max"] == 2
    assert 0.0 < report["skipped"]["contact_block_fraction"] < 1.0


def test_an_object_in_free_fall_gets_no_grid(shot: Shot) -> None:
    wanted = needed(shot, ball(APPLE, 1.0), 0.2)
    assert wanted["free flight"] and not wanted["grid"]
    assert not wanted["damage variable"] and not wanted["contact fields"]
    report, _ = ran(ball(APPLE, 1.0), 0.2)
    assert (report["substeps"], report["active_blocks_max"]) == (0, 0)
    # the last frame is at three quarters
    assert report["skipped"]["free_flight_seconds"] == pytest.approx(0.15)


def test_what_rests_in_a_standing_shot_sleeps() -> None:
    simulation = Simulate(dx=DX, splats=False, standing=True)(ball(SOFT, 0.0), fps=20, seconds=0.2)
    frames = list(simulation)
    report = simulation.report
    assert report["substeps"] == 0 and report["skipped"]["sleeping_fraction"] == pytest.approx(1.0)
    moved = frames[-1].particles.position - frames[0].particles.position
    assert torch.equal(moved, torch.zeros_like(moved))


def test_a_blade_needs_no_composed_steps(shot: Shot) -> None:
    scene = ball(APPLE, 0.0)
    scene.add_event({"type": "blade", "path": [[0, 0, 0.15], [0, 0, -0.01]], "width": 0.2,
                     "speed": 4.0, "at": 0.01})  # fmt: skip
    assert needed(shot, scene, 0.06)["blades"]
    assert not needed(shot, ball(APPLE, 0.0), 0.06)["blades"]
    report, _ = ran(scene, 0.06)
    assert report["composed_steps"] == 0 < report["substeps"]


def test_every_pass_has_a_reason(shot: Shot, tmp_path: Path) -> None:
    rows = passes_of(shot, ball(APPLE, 0.1, 5.0), foresee(ball(APPLE, 0.1, 5.0), DX, 0.2, 4, [9]))
    assert len({row["pass"] for row in rows}) == len(rows)
    assert {row["pass"] for row in rows if not row["needed"]} >= {"blades", "export", "reconstruct"}


WARM = {"select": "all", "material": "ice", "temperature": -5.0}
POT = {"select": {"sphere": [0, 0, 0, 0.1]}, "material": "wood"}
WAX = {**POT, "material": "wax", "temperature": 20.0}
PLATE = {"type": "plane", "at": [0, 0, -1], "normal": [0, 0, 1]}


@pytest.mark.parametrize(("objects", "colliders", "said"), [
    ({"ice": WARM}, [], False),
    ({"ice": WARM, "pot": POT}, [], True),
    ({"ice": WARM, "wax": WAX}, [], False),
    ({"ice": WARM, "wax": WAX, "pot": POT}, [], True),
    ({"ice": WARM}, [PLATE], True),
    ({"pot": {"select": "all", "material": "wood"}}, [PLATE], False),
])  # fmt: skip
def test_heat_that_does_not_pass_is_said(
    shot: Shot, objects: dict[str, Any], colliders: list[dict[str, Any]], said: bool
) -> None:
    given = {"splats": str(shot.splats), "objects": objects, "colliders": colliders}
    found = insulated(Shot.from_dict(given))
    assert bool(found) == said
    if said:
        assert "ice (-5 C)" in found[0] and "heat.floor" in found[0]
