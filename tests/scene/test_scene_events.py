"""Events as the scene stores them: places, velocities, refusals."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import torch
from simulation_shapes import ellipsoid

from gsfluent import materials
from gsfluent.data import Frame
from gsfluent.errors import InputError
from gsfluent.scene.parts import quaternion, quaternion_to, turned
from gsfluent.scene.scene import Scene

SOFT = materials.elastic.override(young_modulus=2e4)


def at(x: float, y: float, z: float) -> Frame:
    return Frame(torch.eye(3), torch.tensor([x, y, z]), 1.0)


def two(density: float = 1000.0) -> Scene:
    scene = Scene(floor=None)
    scene.add(ellipsoid(), SOFT, name="a", frame=at(-1.0, 0.0, 0.0))
    scene.add(ellipsoid(), SOFT.override(density=density), name="b", frame=at(1.0, 0.5, 0.0))
    return scene


def test_collide_gives_the_relative_speed_and_no_momentum() -> None:
    scene = two(density=3.0 * float(torch.as_tensor(SOFT.density)))
    scene.collide(["a", "b"], speed=8.0, direction=(1, 0, 0), distance=0.3)
    a, b = scene.bodies
    assert a.velocity == pytest.approx((6.0, 0.0, 0.0)) and b.velocity == pytest.approx((-2, 0, 0))
    assert float(b.bounds()[0][0] - a.bounds()[1][0]) == pytest.approx(0.3)
    assert a.offset[1:] == (0.0, 0.0) == b.offset[1:]


def test_press_sits_on_the_object_and_covers_it() -> None:
    scene = Scene()
    scene.add(ellipsoid((0.1, 0.06, 0.05)), SOFT)
    top = float(scene.bodies[0].bounds()[1][2])
    name = scene.press(speed=0.5, stroke=0.04, at=0.25)
    (plate,) = scene.colliders
    low, high = scene.bodies[0].bounds()
    assert plate.name == name and plate.mass is None
    assert plate.point[2] - 0.5 * plate.size[2] == pytest.approx(top)
    assert sorted(plate.size[:2]) == pytest.approx(sorted((1.5 * (high - low))[:2].tolist()))
    assert (plate.start, plate.stop) == pytest.approx((0.25, 0.33))


def test_pour_is_a_cylinder_behind_the_nozzle() -> None:
    scene = Scene()
    scene.pour((0, 0, 0.5), 2.0, 0.01, duration=0.1, material="jelly", at=0.3, direction=(0, 3, 4))
    (jet,) = scene.bodies
    assert jet.length == pytest.approx(0.2) and jet.held and jet.start == 0.3
    assert jet.volume == pytest.approx(math.pi * 0.01**2 * 0.2)
    front = [c + 0.5 * jet.length * a for c, a in zip(jet.offset, jet.axis, strict=True)]
    assert front == pytest.approx([0, 0, 0.5])
    low, high = jet.bounds()
    # A cylinder along (0, 0.6, 0.8): its discs reach r in x, 0.8 r in y, 0.6 r in z.
    assert (high - low).tolist() == pytest.approx([0.02, 0.12 + 0.016, 0.16 + 0.012])


def test_a_rigid_bullet_is_a_collider_with_the_mass_of_steel() -> None:
    scene = Scene()
    scene.add(ellipsoid(), SOFT)
    scene.bullet((2, 0, 0), (0, 0, 0), 50.0, radius=0.01, rigid=True)
    (ball,) = scene.colliders
    assert ball.mass == pytest.approx(4 / 3 * math.pi * 1e-6 * 7800)
    assert ball.velocity == pytest.approx((-50, 0, 0)) and len(scene.bodies) == 1


def test_blade_edge_is_across_its_path() -> None:
    scene = Scene()
    scene.blade([(0, 0, 0.4), (0, 0, 0)], width=0.2)
    scene.blade([(-1, 0, 0.1), (1, 0, 0.1)], width=0.2)
    assert scene.blades[0].edge == (0, 1, 0) and scene.blades[1].edge == pytest.approx((0, 1, 0))
    assert [blade.name for blade in scene.blades] == ["blade", "blade2"]


def test_rotations() -> None:
    for way in [(0, 0, 1), (0, 0, -1), (0.6, 0.0, 0.8), (0.0, -0.6, -0.8)]:
        assert turned(quaternion_to(way), (0, 0, 1)) == pytest.approx(way, abs=1e-12)
    assert turned(quaternion("turn", (0, 0, 90)), (1, 0, 0)) == pytest.approx((0, 1, 0), abs=1e-12)


@pytest.mark.parametrize(
    ("event", "match"),
    [
        ({"type": "slice"}, "unknown 'slice'"),
        ({"type": "blade", "width": 1.0}, "'path' is missing"),
        ({"type": "blade", "path": [[0, 0, 1]], "width": 1.0}, "two or more points"),
        ({"type": "blade", "path": [[0, 0, 1]] * 2, "width": 1.0}, "must not be zero"),
        (
            {"type": "blade", "path": [[0, 0, 1], [0, 0, 0]], "width": 1, "edge": [0, 0, 1]},
            "edge must not lie along",
        ),
        ({"type": "press", "speed": 0.0, "stroke": 0.1}, "press speed must lie in"),
        ({"type": "press", "speed": 1.0, "stroke": 0.1, "object": "c"}, "no object is called 'c'"),
        ({"type": "pour", "from": [0, 0, 1], "speed": 1, "radius": 0.1}, "either 'volume' or"),
        ({"type": "collide", "objects": ["a", "a"], "speed": 1.0}, "two different objects"),
        ({"type": "collide", "objects": ["a", "c"], "speed": 1.0}, "no object is called 'c'"),
        ({"type": "bullet", "toward": [0, 0, 0], "speed": 1.0}, "'from' is missing"),
        ({"type": "drop", "hight": 1.0}, "unknown 'hight'"),
    ],
)
def test_events_that_cannot_be_are_refused(event: dict[str, Any], match: str) -> None:
    with pytest.raises(InputError, match=match):
        two().add_event(event)


@pytest.mark.parametrize(
    ("shape", "kw", "match"),
    [
        ("cone", {}, "unknown 'cone'"),
        ("sphere", {}, "radius must lie in"),
        ("box", {}, "'size' is missing"),
        ("box", {"size": (1, 1, 0)}, "size must lie in"),
        ("mesh", {"mesh": "nothing.obj"}, "no file 'nothing.obj'"),
        ("plane", {"mass": 1.0}, "a plane has no mass"),
        ("sphere", {"radius": 1.0, "mode": "glue"}, "unknown 'glue'"),
        ("sphere", {"radius": 1.0, "name": "a"}, "two bodies are called 'a'"),
    ],
)
def test_colliders_that_cannot_be_are_refused(
    shape: str, kw: dict[str, Any], match: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=match):
        two().add_collider(shape, **kw)
