"""A shot for an input that comes without one: ``gsfluent run vase.glb`` drops it so that it breaks.

What takes more than a throw to break is dropped all the same, and bounces.

What had to be guessed is said, and the shot is written out, to be edited and run like any other.
"""

from __future__ import annotations

import hashlib
import logging
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsfluent import materials
from gsfluent.config import Shot
from gsfluent.config.physgaussian.space import model_file
from gsfluent.data import Gaussians
from gsfluent.errors import InputError
from gsfluent.io import atomic_path, kind_of, load_capture, load_splats
from gsfluent.pipeline.capture.front import photographers_side, splats_side
from gsfluent.pipeline.capture.orient import (
    DEFAULT_SIZE,
    camera_up,
    orient,
    upright_rotation,
)
from gsfluent.pipeline.simulate.stage import QUALITY
from gsfluent.plan.proxy import proxy
from gsfluent.run.photographs import is_photographs
from gsfluent.scene.scene import Body
from gsfluent.spatial.mesh_surface import surface_points
from gsfluent.stages.breaking import SURE, breaks_from, is_slender

_log = logging.getLogger(__name__)

FILE = "shot.yaml"
PHOTOGRAPHS = "photographs"
"""What :func:`find_input` calls photographs and videos whose poses are still to be found."""
SETTINGS: dict[str, dict[str, Any]] = {"solve": {"quality": "preview"}, "output": {}}
"""How a shot that nobody has written is simulated and filmed."""

_GRAVITY = 9.81
_LOW, _HIGH = 0.5, 3.0  # heights of a drop [m]; what needs more is thrown down as well
_FASTEST = 25.0  # m/s at the floor, as a good arm throws: what needs more is shown whole
_AFTER = 1.2  # seconds of film after the landing
_QUICK = 0.06  # s: what lands with its length in less is shown slower, by as much
_SLOWEST = 16  # times slower than it happens, at most
_BEFORE = 0.8  # seconds of film before the landing of what is shown slower
_SAMPLE = 2000  # points of a surface that are asked for their colour
_VIEWED = 20_000  # points of a mesh that are looked at for the front
_SOLID = 0.3  # opacity from which a splat counts

_WORDS = {
    "fruit.watermelon": "watermelon melon",
    "fruit.apple": "apple",
    "fruit.orange": "orange",
    "fruit.pumpkin": "pumpkin",
    "ceramic": "ceramic porcelain china bowl plate cup mug pot vase jug tea teapot dish urn",
    "glass": "glass bottle wineglass goblet jar",
    "bone": "bone skull skeleton tooth",
    "egg": "egg",
    "bread": "bread loaf bun cake toast",
    "chocolate": "chocolate",
    "jelly": "jelly jello pudding",
    "plush": "plush toy teddy doll pillow",
    "rubber": "rubber tyre tire ball",
    "rock": "rock stone boulder granite marble",
    "ice": "ice",
    "wood": "wood log trunk chair guitar violin",
    "concrete": "concrete brick",
    "plaster": "plaster gypsum bust statue statuette figure figurine bunny dragon buddha",
    "clay": "clay",
    "foam": "foam styrofoam",
    "snow": "snow snowman",
}
"""Words in the names of files, by the preset that they suggest."""

_LIKE = {
    "fruit.apple": "fruit pear mango pepper paprika peach tomato plum potato carrot vegetable",
    "fruit.orange": "citrus lemon grapefruit lime",
    "fruit.pumpkin": "squash gourd",
}
"""Words for what has no preset of its own, by the nearest one."""

_INSIDE = {
    "fruit.watermelon": "watermelon",
    "fruit.apple": "apple",
    "fruit.orange": "orange",
    "bread": "bread",
    "wood": "wood",
    "bone": "bone",
    "concrete": "concrete",
    "jelly": "jelly",
    "plush": "stuffing",
}
"""Procedural insides by material; others continue the colours of the skin."""


def made_shot(
    source: Path,
    out: Path,
    material: str | None = None,
    pose: Callable[[Path], Path] | None = None,
) -> Path:
    """Write ``OUT/shot.yaml`` for a mesh, a splat or a folder, and say what was guessed.

    Args:
        source: A mesh, a splat, a capture, a model folder of the INRIA trainer, or a folder with
            one of them in it; photographs or a video, with ``pose``.
        out: Result folder of the run.
        material: Preset; guessed from name and colour without.
        pose: Called with photographs that have no poses, returns their capture; without it they
            are refused.

    Returns:
        The file.

    Raises:
        InputError: There is no such input, no such preset, or the file there has been edited.
    """
    import yaml

    key, path = find_input(source)
    if key == PHOTOGRAPHS:
        if pose is None:
            raise _no_poses(source)
        key, path = "capture", pose(path)
    if material is None:
        material, why = guess_material(key, path, source)
        _log.info("material: %s, a guess from %s; --material NAME says better", material, why)
    splats = _sampled(key, path)
    front, side = guess_front(key, path, splats)
    _log.info("front: %s; front: in the shot says better", side)
    values: dict[str, Any] = {key: str(path.resolve())}
    if front is not None:
        values["front"] = front
    values["objects"] = {"object": {"material": material}}
    made_of = materials.get(material)
    events, shown, fall = _fall(made_of, *_shape(key, values | SETTINGS, made_of))
    _log.info("event: %s", fall)
    if material in _INSIDE:
        values["texture"] = {"method": "procedural", "preset": _INSIDE[material]}
    output = {**shown, **SETTINGS["output"]}
    values |= SETTINGS | {"events": events, "output": output}
    text = yaml.safe_dump(values, sort_keys=False)
    target = out / FILE
    out.mkdir(parents=True, exist_ok=True)
    _refuse_edited(target)
    with atomic_path(target) as part:
        part.write_text(f"{_HEAD}{_digest(text)}\n# edit it, then: gsfluent run {target} -o {out}\n"
                        f"{text}", encoding="utf-8")  # fmt: skip
    _log.info("shot: %s", target)
    return target


_HEAD = "# made by gsfluent run, digest "


def _digest(text: str) -> str:
    return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()


def _refuse_edited(target: Path) -> None:
    """Do not write over what somebody has written.

    Raises:
        InputError: The file is not one that was made here and left as it was.
    """
    if not target.is_file():
        return
    lines = target.read_text(encoding="utf-8", errors="replace").split("\n", 2)
    if len(lines) == 3 and lines[0] == f"{_HEAD}{_digest(lines[2])}":
        return
    raise InputError(
        f"{target} has been edited", f"run it: gsfluent run {target}, or remove it to start over"
    )


def _no_poses(source: Path) -> InputError:
    return InputError(
        f"{source}: photographs without poses",
        f"gsfluent run {source} -o out finds them; or: gsfluent poses {source} -o capture",
    )


def find_input(source: Path) -> tuple[str, Path]:
    """Key of a shot, or :data:`PHOTOGRAPHS`, and path for what a user pointed at.

    Raises:
        InputError: Nothing that a run can start from, or more than one thing.
    """
    inside = source if source.is_dir() else source.parent
    if source in (inside, inside / "meta.json") and (inside / "means_l.webp").is_file():
        raise InputError(
            f"{source}: a .sog that has been unpacked",
            f"pack it: cd {inside} && zip -0 ../{inside.name}.sog *, and run that",
        )
    kind = kind_of(source)
    if kind in ("mesh", "splats", "capture"):
        return kind, source
    if source.is_file() and is_photographs(source):
        return PHOTOGRAPHS, source
    if not source.is_dir():
        raise InputError(
            f"{source}: neither a shot, nor a mesh, a splat or a folder",
            "give a shot.yaml, .obj, .glb, .stl, .ply, a video, or a folder of photographs",
        )
    if (source / "run.json").is_file():
        raise InputError(f"{source}: the result of a run", f"look at it: gsfluent view {source}")
    if (source / "point_cloud").is_dir():
        return "splats", model_file(source)
    found = [
        (kind, path)
        for path in sorted(source.iterdir())
        if path.is_file() and (kind := kind_of(path)) in ("mesh", "splats")
    ]
    if len(found) == 1:
        return str(found[0][0]), found[0][1]
    if found:
        names = ", ".join(path.name for _, path in found[:5])
        raise InputError(f"{source}: holds more than one input ({names})", "name one of them")
    if is_photographs(source):
        return PHOTOGRAPHS, source
    raise InputError(
        f"{source}: holds no capture, splat or mesh, and no three photographs",
        "photographs need poses, which are found for three or more of one thing; 40 are good",
    )


def guess_material(key: str, path: Path, source: Path) -> tuple[str, str]:
    """A preset for an input, and what it was guessed from.

    Args:
        key: ``mesh``, ``splats`` or ``capture``.
        path: The file or folder.
        source: What the user named, whose name counts as well.
    """
    names = dict.fromkeys((path.stem, source.stem, path.resolve().parent.name))
    for name in names:
        parts = re.findall(r"[a-z]+", re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name).lower())
        words = {*parts, *(part.removesuffix("s") for part in parts)}
        for preset, known in _WORDS.items():
            if words & set(known.split()):
                return preset, f"the name {name!r}"
        for preset, known in _LIKE.items():
            if hit := sorted(words & set(known.split())):
                return preset, f"the name {name!r}: {_nearest_to(preset, hit[0])}"
    if key == "capture":
        return "plaster", "nothing (it is brittle and breaks from any height)"
    if key == "mesh":
        found = surface_points(path, _SAMPLE)
        if not found.colored:
            return "plaster", "there being no colours"
        colors = found.colors
    else:
        splats = load_splats(path)
        colors = splats.colors().clamp(0.0, 1.0).double().numpy()[splats.opacities.numpy() > _SOLID]
    return _by_color(np.median(colors, axis=0))


def _nearest_to(preset: str, word: str) -> str:
    """That a word has no preset, and which are near."""
    family = preset.split(".")[0] + "."
    others = [name for name in materials.names() if name.startswith(family) and name != preset]
    near = f", before {', '.join(others)}" if others else ""
    return f"{word} has no preset, and this is the nearest{near}"


def _sampled(key: str, path: Path) -> Gaussians | None:
    """Splats on the surface of an input; None for photographs."""
    if key == "capture":
        return None
    if key == "mesh":
        found = surface_points(path, _VIEWED)
        return Gaussians.from_colors(
            torch.from_numpy(found.points).float(), torch.full((len(found.points),), 1e-3),
            torch.from_numpy(found.colors).float(),
        )  # fmt: skip
    return load_splats(path)


def _shape(key: str, values: dict[str, Any], material: materials.Material) -> tuple[float, bool]:
    """Largest extent that the object will have in the scene [m], and whether it is slender."""
    if key == "capture":
        return DEFAULT_SIZE, False
    made = proxy(Shot.from_dict(values), [])  # kept: the plan of the run takes it again
    (solid,) = made.solids.values()
    body = Body("object", material, solid, made.frame)
    low, high = body.bounds()
    return float((high - low).max()), is_slender(body)


def guess_front(key: str, path: Path, splats: Gaussians | None) -> tuple[list[float] | None, str]:
    """The direction towards who looks at the front of an input, and what it was guessed from.

    Photographers stand before the front: the middle of where they stood. Of a splat or a mesh, what
    :func:`gsfluent.pipeline.capture.front.front_side` chooses.

    Args:
        key: ``mesh``, ``splats`` or ``capture``.
        path: The file or folder.
        splats: Some of those on the surface; None for photographs.

    Returns:
        Three numbers in the axes of the input, or None where a run's own guess is as good; and
        words.

    Raises:
        InputError: The input cannot be read.
    """
    if splats is None:
        capture = load_capture(path)
        up = orient(None, capture).up if len(capture.points) else camera_up(capture.cameras)
        way, why = photographers_side(capture.cameras, up)
    else:
        up = orient(splats, up="auto", mesh=path if key == "mesh" else None).up
        way, why = splats_side(splats, up, -upright_rotation(up)[1])
    return None if way is None else _rounded(way), why


def _rounded(way: np.ndarray) -> list[float]:
    return [round(float(part), 4) + 0.0 for part in way]


def _by_color(color: np.ndarray) -> tuple[str, str]:
    """A preset for a colour [3] in 0..1, and the colour in words."""
    high, low = float(color.max()), float(color.min())
    saturation = (high - low) / max(high, 1e-6)
    red, green, blue = (float(part) for part in color)
    if saturation < 0.2:
        if high > 0.7:
            return "ceramic", "its pale colour"
        return ("plaster", "its grey colour") if high > 0.35 else ("rock", "its dark colour")
    if red >= green >= blue and high < 0.6 and saturation < 0.7:
        return "wood", "its brown colour"
    if blue > max(red, green):
        return "ceramic", "its blue colour"
    return ("fruit.apple", "its bright colour") if saturation > 0.5 else ("plaster", "its colour")


def _fall(
    material: materials.Material, size: float, slender: bool
) -> tuple[list[dict[str, Any]], dict[str, float], str]:
    """Events that break a material or show that it stays whole, time of the film, why in words."""
    limit = breaks_from(material, size, size / QUALITY["preview"], slender=slender)
    if not SURE * limit <= _FASTEST:
        why = "does not break"
        if math.isfinite(limit):
            why = f"is estimated to break from {limit:.2g} m/s, faster than one throws"
        height, why = 1.0, f"a drop from 1 m ({material.name} {why})"
        return [{"type": "drop", "height": height}], _time(height, 0.0, 1.0), why
    lands = SURE * limit
    needed = lands**2 / (2.0 * _GRAVITY)
    height, speed = min(max(needed, _LOW), _HIGH), 0.0
    lands = max(lands, math.sqrt(2.0 * _GRAVITY * height))
    # what is small and fast has left the picture before anybody has seen it break
    slow = float(min(max(1, round(_QUICK * lands / size)), _SLOWEST))
    if needed > _HIGH:
        falls = _BEFORE / slow  # of what is shown slower nobody waits for the whole fall
        if slow > 1.0:
            height = min(max(lands * falls - 0.5 * _GRAVITY * falls**2, _LOW), _HIGH)
        speed = round(math.sqrt(lands**2 - 2.0 * _GRAVITY * height), 1)
    height = round(height, 2)
    events: list[dict[str, Any]] = [{"type": "drop", "height": height}]
    about = f"{material.name} is estimated to break from {limit:.2g} m/s"
    said = f"a drop from {height:g} m ({about})"
    if speed > 0.0:
        events.append({"type": "throw", "velocity": [0.0, 0.0, -speed]})
        said = f"thrown down from {height:g} m at {speed:g} m/s ({about})"
    if slow > 1.0:
        said += f", shown {slow:g} times slower than it happens"
    return events, _time(height, speed, slow), said


def _time(height: float, speed: float, slow: float) -> dict[str, float]:
    """``fps``, ``seconds`` and ``slow`` of a film of a fall."""
    fall = (math.sqrt(speed**2 + 2.0 * _GRAVITY * height) - speed) / _GRAVITY
    seconds = {"seconds": round(fall + _AFTER / slow, 2 if slow > 1.0 else 1)}
    return seconds if slow == 1.0 else {"fps": 30.0 * slow, **seconds, "slow": slow}
