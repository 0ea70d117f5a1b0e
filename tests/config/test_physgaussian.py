"""PhysGaussian model folders and configs as shots.

Expected values follow from PhysGaussian's own definitions (commit 8339ed6): its box, its return
maps, its boundary conditions; they are worked out here by hand.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from physgaussian_model import CENTER, RADIUS, config, write_model

from gsfluent.config import load_shot
from gsfluent.config.physgaussian import page as physgaussian_page
from gsfluent.config.physgaussian.keys import FILLING, KEYS, MATERIALS
from gsfluent.config.physgaussian.read import Conversion, convert
from gsfluent.errors import InputError
from gsfluent.io import load_splats
from gsfluent.scene.scene import Scene
from gsfluent.stages.simulate import build_scene

SCALE = 1.0 / (2.0 * RADIUS)


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_model(tmp_path_factory.mktemp("model"))


def made(model: Path, tmp_path: Path, **keys: Any) -> Conversion:
    found = convert(model, config(tmp_path / "config.json", **keys), tmp_path / "made")
    load_shot(tmp_path / "made" / "shot.yaml")  # every shot made is a shot
    return found


def status(conversion: Conversion, key: str) -> str:
    found = {note.status for note in conversion.notes if note.key == key}
    assert len(found) == 1, (key, found)
    return found.pop()


def test_the_box_is_the_scene_and_the_model_lies_in_it(model: Path, tmp_path: Path) -> None:
    turns = {"rotation_degree": [90.0, 30.0], "rotation_axis": [0, 2], "scale": 0.6}
    conversion = made(model, tmp_path, **turns)
    splats = load_splats(tmp_path / "made" / "model.ply")
    # a turned point of the model: about x, then about z, then into the box around (1, 1, 1)
    point = np.array([RADIUS, 0.0, 0.0])
    c, s = math.cos(math.radians(30)), math.sin(math.radians(30))
    about_x = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    about_z = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    turned = about_z @ about_x @ point
    means = load_splats(model / "point_cloud/iteration_30/point_cloud.ply").means.numpy()
    whole = about_z @ about_x @ (means - np.array(CENTER)).T
    extent = float(np.ptp(whole, axis=1).max())
    middle = 0.5 * (whole.max(axis=1) + whole.min(axis=1))
    assert splats.means[0].numpy() == pytest.approx(0.6 / extent * (turned - middle), abs=1e-5)
    assert float((splats.means.amax(0) - splats.means.amin(0)).max()) == pytest.approx(
        0.6, rel=1e-5
    )
    # no number is rescaled: one unit of the box is one metre
    assert conversion.shot["objects"]["object"]["young_modulus"] == 2e4
    assert conversion.shot["gravity"] == [0.0, 0.0, -9.8]


def test_what_falls_in_their_box_falls_as_far_in_object_units(model: Path, tmp_path: Path) -> None:
    # in their box x'' = g; one world unit is SCALE of the box, so the world sees g / SCALE
    conversion = made(model, tmp_path, mpm_space_vertical_upward_axis=[0, -1, 0], g=[0, 3.0, 0])
    frame = conversion.space.frame()
    assert frame.scale == pytest.approx(SCALE, rel=1e-5)
    shot = conversion.shot
    assert shot["gravity"] == pytest.approx([0.0, 0.0, -3.0], abs=1e-9)  # their +y is down
    world = frame.inverse().apply_vector(torch.tensor(shot["gravity"])) / frame.scale
    assert world.numpy() == pytest.approx(np.array([0.0, 3.0 / SCALE, 0.0]), abs=1e-4)


@pytest.mark.parametrize("kind", MATERIALS)
def test_materials_yield_where_theirs_do(model: Path, tmp_path: Path, kind: str) -> None:
    keys = {"yield_stress": 100.0, "friction_angle": 30.0, "hardening": 1, "xi": 0.5}
    conversion = made(model, tmp_path, material=kind, **keys)
    scene = build_scene_of(tmp_path)
    row = scene.bodies[0].material.parameters()
    mu = 2e4 / 2.6
    law = scene.bodies[0].material.law
    if kind in ("jelly", "snow"):
        assert law == "corotated"
        assert status(conversion, "yield_stress") == "inert"
        assert status(conversion, "material") == ("mapped" if kind == "jelly" else "unsupported")
    elif kind == "sand":
        sine = math.sin(math.radians(30.0))
        # theirs: |dev tau| <= 3 p alpha with alpha = sqrt(2/3) 2 sin / (3 - sin)
        alpha = math.sqrt(2.0 / 3.0) * 2.0 * sine / (3.0 - sine)
        assert float(row[2]) == pytest.approx(alpha)
    else:
        # theirs: |dev tau| <= y (foam: sqrt(2/3) y); here |dev tau| <= sqrt(2/3) yield_stress
        theirs = 100.0 * (math.sqrt(2.0 / 3.0) if kind == "foam" else 1.0)
        assert math.sqrt(2.0 / 3.0) * float(row[2]) == pytest.approx(theirs)
        # theirs: y grows by 2 mu xi per norm of plastic strain, which is sqrt(3/2) here's measure
        hard = 0.0 if kind == "foam" else 2.0 * mu * 0.5
        hard -= 0.1 * (kind == "plasticine")  # it softens so unless told otherwise
        grown = math.sqrt(2.0 / 3.0) * float(row[4]) * math.sqrt(2.0 / 3.0)
        assert grown == pytest.approx(hard, rel=1e-6)


def build_scene_of(tmp_path: Path) -> Scene:
    from simulation_shapes import ellipsoid

    from gsfluent.data import Frame

    shot = load_shot(tmp_path / "made" / "shot.yaml")
    return build_scene(shot, {"object": ellipsoid()}, Frame.identity())


def test_other_material_in_a_box(model: Path, tmp_path: Path) -> None:
    extra = {"point": [1, 1, 1.5], "size": [1, 1, 0.5], "E": 5e5, "nu": 0.4, "density": 70}
    conversion = made(model, tmp_path, additional_material_params=[extra])
    part = conversion.shot["objects"]["object"]["parts"][0]
    assert part["where"]["box"] == [[-1.0, -1.0, 0.0], [1.0, 1.0, 1.0]]
    assert (part["young_modulus"], part["poisson_ratio"], part["density"]) == (5e5, 0.4, 70.0)


def box(**keys: Any) -> dict[str, Any]:
    there = {"point": [1, 1.25, 1], "size": [1, 0.05, 0.5], "velocity": [0, 0.2, 0]}
    return there | {"start_time": 0.0, "end_time": 1e3} | keys


@pytest.mark.parametrize("kind", ["cuboid", "enforce_particle_translation"])
def test_a_box_that_holds_matter(model: Path, tmp_path: Path, kind: str) -> None:
    conversion = made(
        model, tmp_path,
        boundary_conditions=[box(type=kind, end_time=0.1), box(type=kind, start_time=0.05),
                             box(type=kind, start_time=5.0, end_time=6.0)],
        mpm_space_vertical_upward_axis=[0, 1, 0],
    )  # fmt: skip
    first, second = conversion.shot["colliders"]
    # their y is up, so (0, 0.25, 0) is 0.25 m above the middle, and the box is flat
    assert first["at"] == pytest.approx([0.0, 0.0, 0.25], abs=1e-9)
    assert first["size"] == pytest.approx([2.0, 1.0, 0.1], abs=1e-9)
    assert first["velocity"] == pytest.approx([0.0, 0.0, 0.2], abs=1e-9)
    assert (first["mode"], first["shown"], first["vanishes"]) == ("sticky", False, 0.1)
    assert second["appears"] == 0.05 and "vanishes" not in second
    assert status(conversion, "boundary_conditions[2].end_time") == "inert"
    scene = build_scene_of(tmp_path)
    assert [c.there(0.07) for c in scene.colliders] == [True, True]
    assert [c.there(0.15) for c in scene.colliders] == [False, True]


def test_walls_floor_and_surfaces(model: Path, tmp_path: Path) -> None:
    plane = {"type": "surface_collider", "point": [1, 1, 0.48], "normal": [0, 0, 1],
             "surface": "slip", "friction": 0.3, "start_time": 0, "end_time": 1e3}  # fmt: skip
    conversion = made(model, tmp_path, boundary_conditions=[{"type": "bounding_box"}, plane])
    shot = conversion.shot
    # the surface is above the lowest wall: it is the floor, at z = 0
    assert (shot["floor"], shot["floor_mode"]) == (0.0, "sticky")
    assert conversion.space.place([1, 1, 0.48])[2] == pytest.approx(0.0, abs=1e-9)
    assert status(conversion, "boundary_conditions[1].surface") == "near"
    assert status(conversion, "boundary_conditions[1].friction") == "inert"
    walls = [c for c in shot["colliders"] if c["type"] == "plane"]
    assert len(walls) == 6
    # cells of 2 / 40: they stop nodes up to 2 cells from the side of the box
    lowest = next(c for c in walls if c["normal"] == [0.0, 0.0, 1.0])
    assert lowest["at"][2] == pytest.approx(2.5 * 0.05 - 0.48)
    alone = made(model, tmp_path, boundary_conditions=[{"type": "bounding_box"}])
    assert alone.shot["floor_mode"] == "separate" and alone.shot["floor_friction"] == 0.0
    assert len(alone.shot["colliders"]) == 5
    flying = made(model, tmp_path, boundary_conditions=[{"type": "bounding_box"}], g=[0, 0, 0])
    assert flying.shot["floor"] == "none" and len(flying.shot["colliders"]) == 6


def test_a_cylinder_that_turns_turns_the_same_way(model: Path, tmp_path: Path) -> None:
    turning = {
        "type": "enforce_particle_velocity_rotation", "point": [1, 0.7, 1], "normal": [0, 2, 0],
        "half_height_and_radius": [0.2, 0.1], "rotation_scale": 1.9, "translation_scale": 0.5,
        "start_time": 0.0, "end_time": 0.3,
    }  # fmt: skip
    conversion = made(model, tmp_path, boundary_conditions=[turning])
    (found,) = conversion.shot["colliders"]
    assert (found["type"], found["radius"], found["length"]) == ("cylinder", 0.1, 0.4)
    # theirs, by its own formula, at a point off the axis
    n = np.array([0.0, 1.0, 0.0])
    h1 = np.array([1.0, 0.0, 1.0]) / math.sqrt(2.0)
    h2 = np.cross(h1, n)
    offset = 0.05 * (math.cos(0.7) * h1 + math.sin(0.7) * h2)
    theirs = 0.05 * 1.9 * (-math.sin(0.7) * h1 + math.cos(0.7) * h2) + 0.5 * n
    ours = np.cross(found["spin"], offset) + np.array(found["velocity"])
    assert ours == pytest.approx(theirs, abs=1e-9)
    from gsfluent.scene.parts import quaternion, turned

    axis = turned(quaternion("turn", found["turn"]), (0.0, 0.0, 1.0))
    assert np.abs(axis) == pytest.approx(np.abs(n), abs=1e-9)


def test_sequential_release_lets_the_far_end_go_first(model: Path, tmp_path: Path) -> None:
    release = {
        "type": "release_particles_sequentially", "normal": [1, 0, 0], "start_position": 1.5,
        "end_position": 0.5, "num_layers": 7, "start_time": 0.0, "end_time": 0.1,
    }  # fmt: skip
    conversion = made(model, tmp_path, boundary_conditions=[release])
    assert status(conversion, "boundary_conditions[0].num_layers") == "inert"
    scene = build_scene_of(tmp_path)
    for time in (0.001, 0.05, 0.099):
        there = [c for c in scene.colliders if c.there(time)]
        assert len(there) == 1
        reach = there[0].point[0] + 0.5 * there[0].size[0] + 1.0
        # held from 0.5 to what is not yet released: 1.5 at first, 0.5 at the end
        assert reach == pytest.approx(1.5 - time / 0.1, abs=0.021)
    assert not any(c.there(0.1001) for c in scene.colliders)


def test_an_impulse_is_a_throw_of_the_same_momentum(model: Path, tmp_path: Path) -> None:
    push = {"type": "particle_impulse", "force": [-0.18, 0, 0.09], "num_dt": 2, "start_time": 0}
    conversion = made(model, tmp_path, boundary_conditions=[push])
    (event,) = conversion.shot["events"]
    means = load_splats(model / "point_cloud/iteration_30/point_cloud.ply").means.double().numpy()
    place = SCALE * (means - np.array(CENTER)) + 1.0
    cells = np.unique(np.floor(place / 0.05).astype(int), axis=0)
    mass = 200.0 * 0.05**3 * len(cells)  # Gaussians of a cell share its volume
    momentum = len(means) * np.array([-0.18, 0, 0.09]) * 1e-4 * 2
    assert event["velocity"] == pytest.approx(momentum / mass, rel=0.02)
    late = made(model, tmp_path, boundary_conditions=[push | {"start_time": 0.1}])
    assert late.shot["events"] == []
    assert status(late, "boundary_conditions[0].force") == "unsupported"


def test_what_lies_outside_sim_area_becomes_the_backdrop(tmp_path: Path) -> None:
    folder = write_model(tmp_path / "model", far=True)
    conversion = made(folder, tmp_path, sim_area=[-3, 3, -3, 3, -3, 3])
    splats = load_splats(tmp_path / "made" / "model.ply")
    assert splats.labels is not None
    assert int((splats.labels < 0).sum() + (splats.labels > 0).sum()) >= 50
    assert splats.count == 1550  # twenty are fainter than opacity_threshold
    assert conversion.shot["output"]["backdrop"] == "captured"
    assert conversion.space.scale == pytest.approx(SCALE, rel=1e-5)


def test_cameras(model: Path, tmp_path: Path) -> None:
    orbit = {"default_camera_index": -1, "init_azimuthm": 0.0, "init_elevation": 90.0,
             "init_radius": 4.0, "move_camera": True, "delta_a": 1.0, "delta_e": -9.0,
             "delta_r": 0.5}  # fmt: skip
    conversion = made(model, tmp_path, **orbit)
    path = json.loads((tmp_path / "made" / "camera.json").read_text())
    assert len(path["frames"]) == 10
    # straight above, four world units away; then lower and further
    assert path["frames"][0]["eye"] == pytest.approx([0, 0, 4.0 * SCALE], abs=1e-6)
    far = np.linalg.norm(path["frames"][3]["eye"])
    assert far == pytest.approx(5.0 * SCALE, rel=1e-6)
    assert path["fov"] == pytest.approx(math.degrees(2 * math.atan(32 / 90)))
    assert conversion.shot["output"]["size"] == [96, 64]  # video needs even sides
    made(model, tmp_path, default_camera_index=0)
    (still,) = json.loads((tmp_path / "made" / "camera.json").read_text())["frames"]
    assert still["eye"] == pytest.approx([0.0, -6.8 * SCALE, 0.0], abs=1e-5)
    assert still["target"] == pytest.approx([0.0, 0.0, 0.0], abs=1e-5)
    missing = made(model, tmp_path, default_camera_index=-1, delta_a=1.0)
    assert missing.shot["output"]["camera"] == "orbit"
    assert status(missing, "delta_a") == "unsupported"


def test_every_key_is_named(model: Path, tmp_path: Path) -> None:
    """A config with every key: each has a note, none twice with different meaning."""
    everything: dict[str, Any] = {
        "yield_stress": 1.0, "hardening": 1, "xi": 0.1, "friction_angle": 20,
        "plastic_viscosity": 3.0, "softening": 0.2, "additional_material_params": [],
        "grid_lim": 2.0, "grid_v_damping_scale": 0.9995, "rpic_damping": 0.5, "pic_damping": 0.1,
        "opacity_threshold": 0.02, "rotation_degree": [0.0], "rotation_axis": [0],
        "sim_area": [-3, 3, -3, 3, -3, 3], "scale": 1.0,
        "particle_filling": dict.fromkeys(FILLING, 1), "boundary_conditions": [],
        "mpm_space_vertical_upward_axis": [0, 0, 1], "mpm_space_viewpoint_center": [1, 1, 1],
        "default_camera_index": -1, "init_azimuthm": 1, "init_elevation": 2, "init_radius": 3,
        "move_camera": False, "delta_a": 1, "delta_e": 1, "delta_r": 1, "show_hint": False,
    }  # fmt: skip
    conversion = made(model, tmp_path, material="foam", **everything)
    given = json.loads((tmp_path / "config.json").read_text())
    assert set(given) == set(KEYS)
    silent = {"additional_material_params", "boundary_conditions"}  # empty lists: nothing to say
    named = {note.key for note in conversion.notes}
    assert set(given) - silent - named == set()
    assert {f"particle_filling.{key}" for key in FILLING} <= named
    report = conversion.report()
    assert report["unsupported"]["grid_v_damping_scale"].endswith("exp(-5 t), t in seconds")
    assert "plastic_viscosity" in report["mapped"] and "softening" in report["inert"]
    assert conversion.shot["objects"]["object"]["plastic_viscosity"] == 3.0
    assert json.loads((tmp_path / "made" / "keys.json").read_text()) == report


def test_plasticine_softens_as_it_flows(model: Path, tmp_path: Path) -> None:
    """|dev tau| <= y falls by softening times the norm of the flow: -3/2 in a tension test."""
    keys = {"yield_stress": 100.0, "hardening": 1, "xi": 0.01, "E": 1e4, "nu": 0.25}
    made_of = made(model, tmp_path, material="plasticine", softening=20.0, **keys)
    hard = 3.0 * 4e3 * 0.01
    made_object = made_of.shot["objects"]["object"]
    assert made_object["hardening_modulus"] == pytest.approx(hard - 30.0)
    assert status(made_of, "softening") == "near"
    usual = made(model, tmp_path, material="plasticine", **keys)
    assert usual.shot["objects"]["object"]["hardening_modulus"] == pytest.approx(hard - 0.15)
    assert "0.1 Pa unless set" in usual.report()["near"]["softening"]


def test_unknown_keys_are_named_with_the_nearest(model: Path, tmp_path: Path) -> None:
    plane = box(type="cuboid", sizes=[1, 1, 1])
    conversion = made(model, tmp_path, frictionangle=3, zzz=1, boundary_conditions=[plane])
    unknown = conversion.report()["unknown"]
    assert unknown["frictionangle"].endswith("did you mean 'friction_angle'?")
    assert "did you mean" not in unknown["zzz"]
    assert unknown["boundary_conditions[0].sizes"].endswith("did you mean 'size'?")


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"material": "jely"}, "unknown material 'jely'"),
        ({"E": "soft"}, "E must be a number"),
        ({"nu": 0.7}, "nu must lie in 0..0.5"),
        ({"g": 9.8}, "g must be 3 numbers"),
        ({"rotation_degree": [1.0], "rotation_axis": []}, "lists of one length"),
        ({"sim_area": [0, 0, 0, 0, 0, 0]}, "none of 1500 Gaussians"),
        ({"boundary_conditions": [{"type": "cubiod"}]}, "unknown boundary condition 'cubiod'"),
        ({"boundary_conditions": [{"type": "cuboid"}]}, "point is missing"),
        ({"boundary_conditions": {}}, "must be a list"),
        ({"frame_dt": 1e-5}, "the first must hold the second"),
        ({"additional_material_params": [{"point": [1, 1, 1]}]}, "size must be 3 numbers"),
        ({"default_camera_index": 4}, "no camera 4"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused(
    model: Path, tmp_path: Path, keys: dict[str, Any], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        made(model, tmp_path, **keys)


def test_folders_and_files_that_are_none(model: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no point_cloud/iteration_N"):
        convert(tmp_path, config(tmp_path / "config.json"), tmp_path / "made")
    with pytest.raises(InputError, match="no such file"):
        convert(model, tmp_path / "none.json", tmp_path / "made")
    (tmp_path / "bad.json").write_text("{")
    with pytest.raises(InputError, match="not readable as JSON"):
        convert(model, tmp_path / "bad.json", tmp_path / "made")


def test_the_page_has_the_tables_of_the_program() -> None:
    path = Path(__file__).parents[2] / "docs" / "guide" / "physgaussian.md"
    page = path.read_text(encoding="utf-8")
    for table in (physgaussian_page.keys, physgaussian_page.filling, physgaussian_page.boundaries):
        assert table() in page, f"{path.name}: enter {table.__name__} again"
