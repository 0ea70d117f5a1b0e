"""Colliders that come and go, gravity of the shot, objects put on their floor, slow motion."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from simulation_shapes import ellipsoid

from gsfluent import materials
from gsfluent.config import Shot
from gsfluent.data import Frame
from gsfluent.errors import InputError
from gsfluent.pipeline.matter.points import build_matter
from gsfluent.pipeline.simulate.engine import SolverOptions
from gsfluent.pipeline.simulate.run import Run
from gsfluent.scene.scene import Scene
from gsfluent.stages.simulate import build_scene

SOFT = materials.elastic.override(young_modulus=2e4)
DX = 0.05


def heights(scene: Scene, frames: int, **options: bool) -> list[float]:
    """Height of the mean point [m] at each frame, 20 per second, from time 0."""
    run = Run(scene, build_matter(scene, DX), 20.0, SolverOptions(**options, max_rollbacks=3))
    found = [float(run.state.position[:, 2].mean())]
    for frame in range(1, frames + 1):
        assert run.advance_to(frame, None), run.failure
        run.record(frame)
        found.append(float(run.state.position[:, 2].mean()))
    assert run.report()["verdict"] == "clean", run.report()["reason"]
    return found


@pytest.mark.parametrize("resident", [True, False])
def test_what_a_sticky_box_holds_falls_freely_when_the_box_is_gone(resident: bool) -> None:
    scene = Scene(floor=None)
    scene.add(ellipsoid(), SOFT)
    scene.add_collider("box", size=(0.4, 0.4, 0.4), mode="sticky", vanishes=0.25)
    z = heights(scene, 10, resident=resident)
    assert max(abs(value - z[0]) for value in z[:6]) < 1e-6
    # free fall over the last quarter of a second
    assert z[0] - z[10] == pytest.approx(0.5 * 9.81 * 0.25**2, rel=0.02)


def test_what_is_not_there_yet_is_not_met() -> None:
    scene = Scene(floor=None)
    scene.add(ellipsoid(), SOFT)
    scene.add_collider("box", size=(0.4, 0.4, 0.4), mode="sticky", appears=10.0)
    z = heights(scene, 4)
    assert z[0] - z[4] == pytest.approx(0.5 * 9.81 * 0.2**2, rel=1e-3)


def test_a_moving_box_moves_only_while_it_is_there() -> None:
    scene = Scene(floor=None, gravity=(0, 0, 0))
    scene.add(ellipsoid(), SOFT)
    scene.add_collider("box", size=(0.4, 0.4, 0.4), mode="sticky", velocity=(0, 0, 0.2), vanishes=9)
    z = heights(scene, 4)
    assert z[4] - z[0] == pytest.approx(0.2 * 0.2, rel=0.02)


def test_a_thing_that_is_not_shown_has_no_surface_and_a_heavy_one_cannot_vanish() -> None:
    from gsfluent.pipeline.colliders.rigid import RigidSet

    scene = Scene()
    scene.add_collider("box", size=(0.4, 0.4, 0.4), shown=False)
    rigid = RigidSet(scene, DX)
    assert rigid.surfaces(rigid.start) is None
    with pytest.raises(InputError, match="there all the time"):
        scene.add_collider("sphere", radius=0.1, mass=1.0, vanishes=1.0)
    with pytest.raises(InputError, match="vanishes at 1 s, before it appears at 2 s"):
        scene.add_collider("sphere", radius=0.1, appears=2.0, vanishes=1.0)


def shot(tmp_path: Path, **keys: object) -> Shot:
    (tmp_path / "ball.ply").touch()
    return Shot.from_dict({"splats": "ball.ply", **keys}, tmp_path)


def test_gravity_of_the_shot_reaches_the_scene(tmp_path: Path) -> None:
    scene = build_scene(
        shot(tmp_path, gravity=[0, 1, -2]), {"object": ellipsoid()}, Frame.identity()
    )
    assert scene.gravity == (0.0, 1.0, -2.0)


def test_a_solid_that_reaches_below_a_found_floor_is_put_on_it(tmp_path: Path) -> None:
    solids = {"object": ellipsoid()}
    sunk = Frame(torch.eye(3), torch.tensor([0.0, 0.0, 0.09]), 1.0)
    found = build_scene(shot(tmp_path), solids, sunk)
    assert float(found.bodies[0].bounds()[0][2]) == pytest.approx(0.0, abs=1e-9)
    told = build_scene(shot(tmp_path, floor=0.0), solids, sunk)
    assert float(told.bodies[0].bounds()[0][2]) < -0.005


def test_slow_motion_plays_slower_and_paths_take_environment_variables(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert shot(tmp_path, output={"fps": 300, "slow": 10}).output.video_fps == 30.0
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "ball.ply").touch()
    monkeypatch.setenv("GSFLUENT_TEST_FOLDER", str(tmp_path / "deep"))
    found = Shot.from_dict({"splats": "$GSFLUENT_TEST_FOLDER/ball.ply"}, tmp_path)
    assert found.splats == tmp_path / "deep" / "ball.ply"
    monkeypatch.delenv("GSFLUENT_TEST_FOLDER")
    with pytest.raises(InputError, match="environment variable that is not set"):
        Shot.from_dict({"splats": "$GSFLUENT_TEST_FOLDER/ball.ply"}, tmp_path)


def test_a_blade_is_drawn_behind_its_edge_and_goes_back_the_way_it_came() -> None:
    from gsfluent.pipeline.colliders.splats import blade_splats

    scene = Scene()
    assert blade_splats(scene, 0.0) is None
    scene.add(ellipsoid(), SOFT)
    scene.blade([(0, 0, 0.5), (0, 0, 0.1), (0.3, 0, 0.1)], width=0.2, speed=1.0, at=1.0)
    for time, low in ((0.0, 0.5), (1.1, 0.4), (1.3, 0.2), (2.1, 0.2), (2.3, 0.4)):
        plate = blade_splats(scene, time)
        assert plate is not None
        # the middles of its outermost splats, half their width from the edge
        assert float(plate.means[:, 2].min()) == pytest.approx(low, abs=3e-4)
        assert float(plate.means[:, 1].abs().max()) == pytest.approx(0.1, abs=3e-4)
        assert plate.normals is not None and float(plate.normals[:, 0].abs().min()) > 0.999
        # thin across the plate
        across, along = plate.covariances()[:, 0], plate.covariances()[:, 2]
        assert bool((across < 0.02 * along).all())
    assert blade_splats(scene, 2.41) is None
    along = blade_splats(scene, 1.6)  # on the second leg, 0.2 m along it
    assert along is not None and float(along.means[:, 0].max()) == pytest.approx(0.2, abs=3e-4)
