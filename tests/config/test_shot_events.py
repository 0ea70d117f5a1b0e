"""Events and colliders of a shot file reach the scene as they were written."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from simulation_shapes import ellipsoid

from gsfluent.config import COLLIDERS, EVENTS, Shot, typed_dict
from gsfluent.data import Frame
from gsfluent.errors import InputError
from gsfluent.stages.simulate import build_scene

OBJECTS = {"a": {"material": "bread"}, "b": {"material": "jelly"}}
SHOTS: list[dict[str, Any]] = [
    {"type": "drop", "height": 1.0, "object": "a"},
    {"type": "throw", "velocity": [1, 0, 2], "spin": [0, 3, 0]},
    {"type": "bullet", "from": [2, 0, 0.2], "toward": [0, 0, 0.1], "speed": "6e1", "rigid": True},
    {"type": "blade", "at": 0.2, "path": [[0, 0, 1], [0, 0, 0]], "width": 0.2, "thickness": 0.01},
    {"type": "press", "speed": 0.5, "stroke": 0.1, "object": "a", "size": [0.5, 0.5]},
    {"type": "pour", "from": [0, 0, 1], "speed": 1, "radius": 0.02, "volume": 1e-3,
     "material": "jelly"},
    {"type": "collide", "objects": ["a", "b"], "speed": 5, "direction": [1, 0, 0], "distance": 0},
    {"type": "grip", "box": [[0, 0, 0], [1, 1, 1]], "turn": [0, 0, 9], "duration": 2, "at": 0.1},
    {"type": "pull", "distance": 0.1, "duration": 1, "object": "a", "at": 0.1},
    {"type": "twist", "angle": 9, "duration": 1, "object": "b"},
    {"type": "bend", "angle": 9, "duration": 1, "object": "b", "depth": 0.01},
]  # fmt: skip


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("melon.ply", "bowl.obj"):
        (tmp_path / name).write_bytes(b"")
    return tmp_path


def read(folder: Path, **keys: Any) -> Shot:
    return Shot.from_dict({"splats": "melon.ply", "objects": OBJECTS, **keys}, folder)


def test_every_event_is_tried_here() -> None:
    assert [event["type"] for event in SHOTS] == list(EVENTS)


@pytest.mark.parametrize("event", SHOTS, ids=[event["type"] for event in SHOTS])
def test_events_reach_the_scene(folder: Path, event: dict[str, Any]) -> None:
    shot = read(folder, events=[event])
    again = Shot.from_dict(shot.resolved(), folder)
    assert again.events == shot.events
    shown = typed_dict(shot.events[0], EVENTS)
    solids = dict.fromkeys(("a", "b"), ellipsoid())
    frame = Frame(torch.eye(3), torch.tensor([0.0, 0.0, 0.1]), 1.0)
    scene = build_scene(shot, solids, frame)
    made = {
        "bullet": scene.colliders,
        "press": scene.colliders,
        "blade": scene.blades,
        "pour": scene.bodies[2:],
    }
    kind = event["type"]
    if kind in ("grip", "pull", "twist", "bend"):
        assert [thing.kind for thing in scene.colliders] == ["grip"] * (1 if kind == "grip" else 2)
        assert all(thing.start == shown["at"] for thing in scene.colliders)
    elif kind in made:
        (thing,) = made[kind]
        assert thing.start == shown.get("at", 0.0)
    elif kind == "drop":
        assert float(scene.bodies[0].bounds()[0][2]) == pytest.approx(1.0)
    else:
        assert scene.bodies[0].velocity != (0, 0, 0) and scene.bodies[1].velocity != (0, 0, 0)


COLLIDER_KEYS: dict[str, dict[str, Any]] = {
    "plane": {"normal": [1, 0, 0], "radius": 0.3},
    "sphere": {"radius": 0.1, "mass": 2.0},
    "box": {"size": [0.1, 0.2, 0.3], "turn": [0, 0, 45]},
    "capsule": {"radius": 0.1, "length": 0.0},
    "cylinder": {"radius": 0.1, "length": 0.2, "spin": [0, 0, 3]},
    "mesh": {"mesh": "bowl.obj", "scale": 0.001},
}


@pytest.mark.parametrize("kind", list(COLLIDERS))
def test_colliders_reach_the_scene(folder: Path, kind: str) -> None:
    keys = {"type": kind, "at": [0, 0, 0.4], "mode": "sticky", **COLLIDER_KEYS[kind]}
    shot = read(folder, colliders=[keys], floor_mode="slip")
    again = Shot.from_dict(shot.resolved(), folder)
    assert again.colliders == shot.colliders
    assert typed_dict(shot.colliders[0], COLLIDERS)["type"] == kind
    scene = build_scene(shot, dict.fromkeys(("a", "b"), ellipsoid()), Frame.identity())
    (made,) = scene.colliders
    assert made.kind == kind and made.mode == "sticky" and made.point == (0, 0, 0.4)
    assert scene.floor_mode == "slip"
    assert made.mass == keys.get("mass")


@pytest.mark.parametrize(
    ("keys", "match"),
    [
        ({"events": [{"type": "blade", "path": [[0, 0, 1]], "width": 1}]}, "list of 2 or more"),
        ({"events": [{"type": "collide", "objects": ["a"], "speed": 1}]}, "list of 2"),
        ({"events": [{"type": "collide", "objects": ["a", "c"], "speed": 1}]}, "called 'c'"),
        ({"events": [{"type": "pour", "from": [0, 0, 1], "speed": 1, "radius": 1,
                      "material": "jelly"}]}, "either 'volume' or 'duration', got neither"),
        ({"events": [{"type": "pour", "from": [0, 0, 1], "speed": 1, "radius": 1, "volume": 1,
                      "duration": 1, "material": "jelly"}]}, "got both"),
        ({"events": [{"type": "pour", "from": [0, 0, 1], "speed": 1, "radius": 1, "volume": 1,
                      "material": "watr"}]}, "watr"),
        ({"colliders": [{"type": "bowl"}]}, "unknown collider 'bowl'"),
        ({"colliders": [{"type": "box"}]}, r"colliders\[0\].size is missing"),
        ({"colliders": [{"type": "plane", "mass": 1.0}]}, r"colliders\[0\].mass: unknown key"),
        ({"colliders": [{"type": "mesh", "mesh": "no.obj"}]}, "does not exist"),
        ({"floor": "none", "floor_mode": "slip"}, "do nothing without a floor"),
    ],
)  # fmt: skip
def test_wrong_events_and_colliders_are_refused(
    folder: Path, keys: dict[str, Any], match: str
) -> None:
    with pytest.raises(InputError, match=match):
        read(folder, **keys)
