"""The shot file."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsfluent.config import EVENTS, Bullet, Drop, Shot, Throw, load_shot, typed_dict
from gsfluent.errors import InputError
from gsfluent.scene.parts import Part

FULL = """
splats: melon.ply
size: 0.25
up: -y
floor: none
fill: {method: auto, hollow: 0.01, resolution: 64}
texture: {method: exemplar, exemplar: cut.jpg}
objects:
  melon:
    select: {sphere: [0, 0, 0.1, 0.2]}
    material: fruit.watermelon
    young_modulus: 1e5
    parts:
      - {name: rind, where: {depth_below: 0.012}, cohesion: 2.0}
      - {name: seed, where: {color_near: [0.1, 0.07, 0.05], tolerance: 0.15}, cohesion: 5.0}
      - {name: foot, where: {box: [[-1, -1, 0], [1, 1, 0.02]]}, law: elastic}
events:
  - {type: drop, height: 1.0, object: melon}
  - {type: throw, velocity: [1, 0, 0], spin: [0, 3, 0]}
  - {type: bullet, at: 0.4, from: [2, 0, 0.2], toward: [0, 0, 0.1], speed: 60}
solve: {quality: preview}
light: {key: {direction: [1, -1, 2], shadow: false}, ambient: 0.4, specular: 0.2}
output: {fps: 24, seconds: 1.5, size: [640, 360], camera: 3, what: [mp4, ply-seq]}
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("melon.ply", "cut.jpg", "path.json", "labels.npy"):
        (tmp_path / name).write_bytes(b"")
    (tmp_path / "capture").mkdir()
    return tmp_path


def read(folder: Path, **keys: Any) -> Shot:
    base: dict[str, Any] = {} if "capture" in keys else {"splats": "melon.ply"}
    return Shot.from_dict({**base, **keys}, folder)


@pytest.mark.parametrize(("solve", "most"), [
    ({"quality": "preview"}, 10_000), ({"quality": "shot"}, 300_000),
    ({"quality": "preview", "max_points": 0}, 0), ({"max_points": 7}, 7),
])  # fmt: skip
def test_a_preview_spends_fewer_points_on_walls(
    folder: Path, solve: dict[str, Any], most: int
) -> None:
    assert read(folder, solve=solve).solve.points_for_walls == most


def test_a_key_is_read_under_its_old_name_with_a_warning(
    folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    shot = read(folder, solve={"loose_crumbs": True, "quality": "preview"})
    assert shot == read(folder, solve={"loose_debris": True, "quality": "preview"})
    assert shot.solve.loose_debris and "loose_crumbs" not in shot.resolved()["solve"]
    assert caplog.messages == [
        "solve.loose_crumbs is called loose_debris now; the old name still works",
        "solve.loose_debris does nothing now: loose matter leaves the grid",
        "solve.loose_debris does nothing now: loose matter leaves the grid",
    ]
    with pytest.raises(InputError, match="both are given"):
        read(folder, solve={"loose_crumbs": True, "loose_debris": True})
    with pytest.raises(InputError, match=r"solve\.loose_debris must be true"):
        read(folder, solve={"loose_crumbs": 3})


def test_full_form_reads_into_types(folder: Path) -> None:
    (folder / "shot.yaml").write_text(FULL)
    shot = load_shot(folder / "shot.yaml")
    assert shot.splats == folder / "melon.ply" and shot.texture.exemplar == folder / "cut.jpg"
    assert shot.up == (0.0, -1.0, 0.0) and shot.floor == "none" and shot.size == 0.25
    assert shot.fill.given(scale=0.5) == {"method": "auto", "hollow": 0.02, "resolution": 64}
    melon = shot.objects["melon"]
    assert melon.overrides == {"young_modulus": 1e5} and melon.select.sphere == (0.0, 0.0, 0.1, 0.2)
    assert melon.parts is not None and [part.name for part in melon.parts] == [
        "rind",
        "seed",
        "foot",
    ]
    assert melon.parts[0].to_dict() == {
        "name": "rind",
        "where": {"depth_below": 0.012},
        "cohesion": 2.0,
    }
    assert isinstance(shot.events[0], Drop) and isinstance(shot.events[1], Throw)
    assert shot.events[2] == Bullet((2.0, 0.0, 0.2), (0.0, 0.0, 0.1), 60.0, 0.008, 7800.0, 0.4)
    assert shot.light.key.shadow is False and shot.light.key.direction == (1.0, -1.0, 2.0)
    assert shot.output.size == (640, 360) and shot.output.camera == 3 and shot.output.fps == 24.0


def test_smallest_shot_has_sensible_defaults(folder: Path) -> None:
    shot = read(folder, capture="capture", events=[{"type": "drop", "height": 1.0}])
    assert shot.capture == folder / "capture" and list(shot.objects) == ["object"]
    assert shot.objects["object"].select.everything and shot.objects["object"].parts is None
    assert shot.reconstruct.given() == {} and shot.fill.given() == {
        "method": "auto",
        "hollow": "auto",
    }
    assert shot.output.what == ("mp4",) and shot.output.camera == "orbit"


def test_resolved_reads_back_as_the_same_shot(folder: Path) -> None:
    (folder / "shot.yaml").write_text(FULL)
    shot = load_shot(folder / "shot.yaml")
    again = Shot.from_dict(shot.resolved(), "/")
    assert again == shot and again.resolved() == shot.resolved()


def test_shot_is_frozen(folder: Path) -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        read(folder).scale = 1.0  # type: ignore[misc]


def test_events_go_to_the_scene_as_written(folder: Path) -> None:
    event = {"type": "bullet", "from": [2.0, 0.0, 0.2], "toward": [0.0, 0.0, 0.1], "speed": 60.0}
    shown = typed_dict(read(folder, events=[event]).events[0], EVENTS)
    assert shown == {**event, "radius": 0.008, "density": 7800.0, "at": 0.0, "rigid": False}
    drop = {"type": "drop", "height": 1.0}
    assert typed_dict(read(folder, events=[drop]).events[0], EVENTS) == drop


OBJECT = "objects.melon"


@pytest.mark.parametrize(
    ("keys", "path", "hint"),
    [
        ({"splat": "melon.ply"}, "splat: unknown key", "did you mean 'splats'"),
        (
            {"objects": {"melon": {"cohesoin": 2}}},
            "objects.melon.cohesoin: unknown key",
            "did you mean 'cohesion'",
        ),
        ({"output": {"secnods": 2}}, "output.secnods: unknown key", "did you mean 'seconds'"),
        (
            {"light": {"key": {"dirction": [1, 0, 0]}}},
            "light.key.dirction: unknown key",
            "'direction'",
        ),
        (
            {"events": [{"type": "drop", "heihgt": 1}]},
            r"events\[0\].heihgt: unknown key",
            "'height'",
        ),
        ({"events": [{"type": "dorp"}]}, r"events\[0\].type: unknown event 'dorp'", "'drop'"),
        (
            {"objects": {"melon": {"material": "fruit.watermellon"}}},
            "objects.melon.material: .*fruit.wate",
            "'fruit.watermelon'",
        ),
        ({"fill": {"method": "vot"}}, "fill.method must be one of", "did you mean 'vote'"),
        (
            {"objects": {"melon": {"parts": [{"name": "rind", "where": {"depth": 1}}]}}},
            "objects.melon.parts.rind.where.depth: unknown key",
            "'depth_below'",
        ),
    ],
)
def test_unknown_keys_name_their_path_and_the_nearest(
    folder: Path, keys: dict[str, Any], path: str, hint: str
) -> None:
    with pytest.raises(InputError, match=path) as caught:
        read(folder, **keys)
    assert hint in caught.value.hint


@pytest.mark.parametrize("other", [{"quality": "hero"}, {"cells": 30}, {"error": "3%"}])
def test_a_time_budget_stands_alone(folder: Path, other: dict[str, Any]) -> None:
    assert read(folder, solve={"seconds_per_frame": 0.5}).solve.seconds_per_frame == 0.5
    with pytest.raises(InputError, match=next(iter(other))) as caught:
        read(folder, solve={"seconds_per_frame": 0.5} | other)
    assert "remove" in caught.value.hint


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        (
            {"capture": "capture", "splats": "melon.ply"},
            "one of capture, splats, mesh, got capture and splats",
        ),
        ({"splats": "none.ply"}, "none.ply does not exist"),
        ({"scale": 0}, "scale must be above 0, got 0"),
        ({"scale": 1.0, "size": 1.0}, "'scale' and 'size' both"),
        ({"size": "large"}, "size must be a number, got 'large'"),
        ({"size": True}, "size must be a number"),
        ({"size": float("nan")}, "size must lie in"),
        ({"up": "+w"}, "up must be auto"),
        ({"up": [0, 0, 0]}, "up must not be zero"),
        ({"up": [0, 1]}, "up must be 3 numbers"),
        ({"floor": "low"}, "floor must be one of auto, none, plane, got 'low'"),
        ({"reconstruct": {"iterations": 100}}, "does nothing when splats is given"),
        ({"texture": {"method": "exemplar"}}, "texture.exemplar is missing"),
        ({"texture": {"method": "procedural"}}, "texture.preset is missing"),
        ({"texture": {"method": "diffusion"}}, "texture.model is missing"),
        ({"texture": {"model": "x"}}, "texture.model does nothing with method procedural"),
        ({"texture": {"exemplar": "cut.jpg", "prompt": "x"}}, "texture.prompt does nothing"),
        ({"texture": {"method": "color_copy", "quality": "full"}}, "texture.quality does nothing"),
        ({"fill": {"hollow": -1}}, "fill.hollow must be above 0"),
        ({"fill": {"resolution": 64.5}}, "fill.resolution must be a whole number"),
        ({"fill": [1]}, "fill must be a section of keys"),
        ({"events": {"type": "drop"}}, "events must be a list"),
        ({"events": [{"type": "drop"}]}, r"events\[0\].height is missing"),
        (
            {"events": [{"type": "drop", "height": -1}]},
            r"events\[0\].height must lie in 0\.\.10000",
        ),
        (
            {"events": [{"type": "drop", "height": 1, "object": "pear"}]},
            "no object is called 'pear'",
        ),
        (
            {"events": [{"type": "throw", "velocity": [1, 2]}]},
            r"events\[0\].velocity must be 3 numbers",
        ),
        ({"output": {"size": [641, 360]}}, "output.size must be even numbers"),
        ({"output": {"seconds": 0}}, "output.seconds must be above 0"),
        ({"output": {"camera": "front"}}, "output.camera: .*front does not exist"),
        ({"output": {"what": ["mp5"]}}, r"output.what\[0\] must be one of"),
        ({"light": {"key": {"shadow": 1}}}, "light.key.shadow must be true or false"),
        ({"light": {"key": {"direction": [0, 0, 0]}}}, "light.key.direction must not be zero"),
        ({"objects": {"melon": {"poisson_ratio": 0.7}}}, "objects.melon.poisson_ratio: .*got 0.7"),
        ({"objects": {"melon": {"young_modulus": 0}}}, "objects.melon.young_modulus: "),
        (
            {"objects": {"melon": {"select": "some"}}},
            "objects.melon.select must be all, or a section",
        ),
        ({"objects": {"melon": {"select": {}}}}, "objects.melon.select must name a condition"),
        (
            {"objects": {"melon": {"select": {"sphere": [0, 0, 0, 0]}}}},
            "must have a positive radius",
        ),
        (
            {"objects": {"melon": {"select": {"box": [[1, 1, 1], [0, 0, 0]]}}}},
            "first corner below its second",
        ),
        (
            {"objects": {"melon": {"select": {"tolerance": 1}}}},
            "select.tolerance does nothing without color_near",
        ),
        (
            {"objects": {"melon": {"select": {"label": 1}}}},
            "select.label does nothing without labels",
        ),
        (
            {"objects": {"melon": {"parts": [{"name": "a", "cohesion": 1}]}}},
            "parts.a.where must name a condition",
        ),
        (
            {"objects": {"melon": {"parts": [{"name": "a", "where": {"region": 1}}]}}},
            "parts.a changes no parameter",
        ),
        (
            {
                "objects": {
                    "melon": {"parts": [{"where": {"color_near": [2, 0, 0]}, "cohesion": 1}]}
                }
            },
            r"parts.part1.where.color_near.0 must lie in 0\.\.1",
        ),
    ],
)
def test_bad_values_name_their_path(folder: Path, keys: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        read(folder, **keys)
    assert caught.value.hint


def test_neither_input_is_an_error(folder: Path) -> None:
    with pytest.raises(InputError, match="got none"):
        Shot.from_dict({}, folder)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("splats: [", r"shot\.yaml, line \d+: not valid YAML"),
        (
            "splats: melon.ply\nsize: 1\nsize: 2\n",
            r"shot\.yaml, line 3: not valid YAML \(key 'size' stands twice\)",
        ),
        ("- a\n- b\n", "must be a YAML mapping, got list"),
        ("", "must be a YAML mapping, got NoneType"),
        ("splats: melon.ply\n? [1, 2]\n: 3\n", "not valid YAML"),
        ("splats: melon.ply\nsizee: 2\n", r"shot\.yaml: sizee: unknown key"),
    ],
)
def test_bad_yaml_names_file_and_line(folder: Path, text: str, message: str) -> None:
    (folder / "shot.yaml").write_text(text)
    with pytest.raises(InputError, match=message):
        load_shot(folder / "shot.yaml")


def test_missing_and_binary_files(folder: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        load_shot(folder / "none.yaml")
    (folder / "shot.yaml").write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(InputError, match=r"is no text"):
        load_shot(folder / "shot.yaml")


def test_numbers_that_yaml_reads_as_text_are_numbers(folder: Path) -> None:
    (folder / "shot.yaml").write_text(
        "splats: melon.ply\nsize: 1e-1\nobjects: {melon: {young_modulus: 2e5}}\n"
    )
    shot = load_shot(folder / "shot.yaml")
    assert shot.size == 0.1 and shot.objects["melon"].overrides["young_modulus"] == 2e5


@pytest.mark.parametrize(
    ("text", "axis"),
    [("-y", (0, -1, 0)), ("z", (0, 0, 1)), ("+x", (1, 0, 0)), ([1, 2, 3], (1, 2, 3))],
)
def test_up_axes(folder: Path, text: Any, axis: tuple[int, ...]) -> None:
    assert read(folder, up=text).up == axis


values = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text(max_size=6)
    | st.sampled_from(["auto", "drop", "all"]),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(st.text(max_size=6) | st.just("type"), inner, max_size=3)
    ),
    max_leaves=6,
)


@settings(derandomize=True, deadline=None)
@given(st.sampled_from([field.name for field in dataclasses.fields(Shot)]), values)
def test_any_value_reads_or_is_an_input_error(key: str, value: Any) -> None:
    given_keys = {"splats": ".", key: value}
    try:
        shot = Shot.from_dict(given_keys)
    except InputError as error:
        assert error.what
    else:
        assert Shot.from_dict(shot.resolved()).resolved() == shot.resolved()


def test_scatter_of_strength_may_be_set(folder: Path) -> None:
    shot = read(folder, objects={"melon": {"variation": 0.2, "grain": 0.01}})
    assert shot.objects["melon"].overrides == {"variation": 0.2, "grain": 0.01}
    with pytest.raises(InputError, match="variation"):
        read(folder, objects={"melon": {"material": "jelly", "variation": 0.2}})


def test_handbook_numbers_of_objects_and_parts(folder: Path) -> None:
    whole = {"softening": 4.0, "restitution": 0.5, "dust": 0.2}
    own = {"tensile_strength": 1e5, "weibull_modulus": 6.0, "reference_volume": 1e-5}
    part = {"name": "rind", "where": {"depth_below": 0.01}, **own}
    keys = {"material": "fruit.apple", **whole, **own, "parts": [part]}
    (item,) = read(folder, objects={"apple": keys}).objects.values()
    assert dict(item.overrides) == whole | own
    assert item.parts is not None and dict(item.parts[0].overrides) == own


@pytest.mark.parametrize("key", ["softening", "restitution", "dust"])
def test_what_holds_for_a_whole_object_is_refused_in_a_part(folder: Path, key: str) -> None:
    part = {"name": "rind", "where": {"depth_below": 0.01}, key: 0.5}
    with pytest.raises(InputError, match=rf"parts\.rind\.{key} .*whole object") as caught:
        read(folder, objects={"apple": {"material": "fruit.apple", "parts": [part]}})
    assert "to the object" in caught.value.hint
    with pytest.raises(InputError, match=f"part 'rind': {key} holds for a whole object"):
        Part.parse(part)
