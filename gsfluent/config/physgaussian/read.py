"""A PhysGaussian model folder and its JSON config as a shot.

``gsfluent run MODEL --config config.json -o OUT`` turns both into ``OUT/physgaussian/shot.yaml``,
an ordinary shot that can be read, changed and run, and says what became of every key. The units:
:mod:`gsfluent.config.physgaussian.space`; the keys:
:mod:`gsfluent.config.physgaussian.keys`.
"""

from __future__ import annotations

import dataclasses
import logging
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gsfluent.config.physgaussian.boundary import Boundaries, gaussian_masses
from gsfluent.config.physgaussian.keys import (
    INERT,
    KEYS,
    MAPPED,
    MATERIALS,
    NEAR,
    UNKNOWN,
    UNSUPPORTED,
    Note,
    number,
    numbers,
    read_config,
)
from gsfluent.config.physgaussian.space import Space, camera_path, in_box, model_file, space_of
from gsfluent.config.read import nearest
from gsfluent.data import BACKGROUND
from gsfluent.errors import InputError, short
from gsfluent.io import atomic_path, load_splats, save_splats, write_json

_log = logging.getLogger(__name__)
_CELLS = {"preview": 20, "shot": 40, "hero": 64}
_LAW = {
    "jelly": "corotated",
    "metal": "von_mises",
    "sand": "drucker_prager",
    "foam": "von_mises",
    "plasticine": "von_mises",
}
_UNSET = {"softening": 0.1}  # Pa, where a config for plasticine names none
_FRICTION_ANGLE = 25.0  # degrees, where a config for sand names none


@dataclasses.dataclass(frozen=True)
class Conversion:
    """A shot made of a config, and what became of every key."""

    shot: dict[str, Any]  # Keys and values as in a shot file
    notes: tuple[Note, ...]  # One or more per key of the config
    space: Space  # How their box lies in the scene

    def report(self) -> dict[str, Any]:
        """For run.json: notes by status, and world to scene."""
        found: dict[str, Any] = {
            status: {note.key: note.text for note in self.notes if note.status == status}
            for status in (MAPPED, NEAR, UNSUPPORTED, INERT, UNKNOWN)
        }
        return found | {"world_to_scene": self.space.frame().to_dict()}


def convert(model: Path, config: Path, folder: Path) -> Conversion:
    """Turn a model folder and its config into a shot.

    Args:
        model: Folder that the INRIA trainer wrote.
        config: PhysGaussian's JSON file.
        folder: Receives ``model.ply``, ``camera.json``, ``shot.yaml`` and ``keys.json``.

    Raises:
        InputError: No such model, or a config that cannot be.
    """
    try:
        return _convert(model, config, folder)
    except InputError as error:
        if str(config) in error.what or str(model) in error.what:
            raise
        raise InputError(f"{config}: {error.what}", error.hint) from error


def _convert(model: Path, config: Path, folder: Path) -> Conversion:
    import yaml

    values, notes = read_config(config)
    space, gaussians = space_of(load_splats(model_file(model)).validated(str(model)), values)
    points = in_box(space, gaussians)
    frame_dt = _frame_time(values, notes)
    frames = max(1, round(number(values, "frame_num", 100.0)))
    edges = Boundaries(values, space, points, gaussian_masses(values, points), frames * frame_dt)
    notes += edges.notes
    if edges.floor is not None:
        moved = dataclasses.replace(space, floor=edges.floor)
        # the conditions again, now that it is known where z = 0 is
        edges = Boundaries(values, moved, points, edges.mass, edges.seconds)
        space = moved
    path, size = camera_path(model, values, space, frames, notes)
    folder.mkdir(parents=True, exist_ok=True)
    labels = gaussians.labels
    assert labels is not None
    save_splats(gaussians.transformed(space.frame()), folder / "model.ply")
    if path is not None:
        write_json(folder / "camera.json", path)
    shot: dict[str, Any] = {
        "splats": str((folder / "model.ply").resolve()),
        "scale": 1.0,
        "up": "+z",
        "origin": "input",
        "floor": "none" if edges.floor is None else 0.0,
        **edges.floor_keys,
        "gravity": _gravity(values, space, notes),
        "fill": {"hollow": "none" if "particle_filling" in values else "auto"},
        "texture": {"method": "color_copy"},
        "objects": {"object": _object(values, space, notes)},
        "events": edges.events,
        "colliders": edges.colliders,
        "solve": {"quality": _quality(values, notes)},
        "output": {
            "fps": round(1.0 / frame_dt, 6),
            "seconds": round(frames * frame_dt, 9),
            **({"size": size} if size else {}),
            "camera": str((folder / "camera.json").resolve()) if path else "orbit",
            "backdrop": "captured" if bool(labels.eq(BACKGROUND).any()) else "studio",
            "what": ["mp4"],
        },
    }
    plain = ("opacity_threshold", "rotation_degree", "rotation_axis", "sim_area", "scale",
             "particle_filling", "mpm_space_vertical_upward_axis", "frame_num", "show_hint",
             "substep_dt", "pic_damping", "grid_lim")  # fmt: skip
    notes += [Note(key, *KEYS[key]) for key in plain if key in values]
    _damping(values, notes)
    conversion = Conversion(shot, tuple(notes), space)
    with atomic_path(folder / "shot.yaml") as part:
        part.write_text(yaml.safe_dump(shot, sort_keys=False), encoding="utf-8")
    write_json(folder / "keys.json", conversion.report())
    for note in notes:
        if note.status in (UNSUPPORTED, UNKNOWN):
            _log.warning("%s: %s: %s", config.name, note.key, note.text)
        elif note.status == INERT:
            _log.info("%s: %s does nothing: %s", config.name, note.key, note.text)
    return conversion


def _frame_time(values: Mapping[str, Any], notes: list[Note]) -> float:
    """Length of a frame [s]: whole steps of theirs."""
    frame, step = number(values, "frame_dt", 1e-2), number(values, "substep_dt", 1e-4)
    if not frame > 0.0 or not step > 0.0 or frame < step:
        raise InputError(
            f"frame_dt {frame:g} and substep_dt {step:g}: the first must hold the second",
            "correct the config",
        )
    real = int(frame / step) * step
    if "frame_dt" in values:
        text = f"output.fps {1.0 / real:g}"
        if abs(real - frame) > 1e-9 * frame:
            text += f": {int(frame / step)} whole steps of theirs are {real:g} s"
        notes.append(Note("frame_dt", MAPPED, text))
    return real


def _gravity(values: Mapping[str, Any], space: Space, notes: list[Note]) -> list[float]:
    if "g" not in values:
        notes.append(Note("g", NEAR, "missing, which stops PhysGaussian: no gravity here"))
        return [0.0, 0.0, 0.0]
    found = space.way(numbers(values, "g", []))
    notes.append(Note("g", MAPPED, f"gravity {found}"))
    return found


def _quality(values: Mapping[str, Any], notes: list[Note]) -> str:
    wanted = number(values, "n_grid", 50.0) * number(values, "scale", 1.0)
    wanted /= number(values, "grid_lim", 2.0)
    if not wanted > 0.0:
        raise InputError("n_grid, scale and grid_lim must be positive", "correct the config")
    name = min(_CELLS, key=lambda quality: abs(math.log(_CELLS[quality] / wanted)))
    text = f"{wanted:g} cells along the object: solve.quality {name} has {_CELLS[name]}"
    notes.append(Note("n_grid", NEAR, text))
    return name


def _object(values: Mapping[str, Any], space: Space, notes: list[Note]) -> dict[str, Any]:
    """The object: its material, and parts of other stiffness."""
    kind = values.get("material", "jelly")
    if kind not in MATERIALS:
        raise InputError(f"material: unknown material {short(kind)}", nearest(kind, MATERIALS))
    law = _LAW.get(kind, "drucker_prager")
    young, nu = number(values, "E", 1e5), number(values, "nu", 0.4)
    made: dict[str, Any] = {
        "material": "elastic",
        "law": law,
        "young_modulus": young,
        "poisson_ratio": _poisson(nu, "nu", notes),
        "density": number(values, "density", 200.0),
    }
    if kind == "snow":
        made |= {"law": "corotated"}
        text = "PhysGaussian names snow and gives it no stress; it is elastic here (jelly)"
        notes.append(Note("material", UNSUPPORTED, text))
    else:
        notes.append(Note("material", MAPPED, f"{kind}: law {law}"))
    notes += [Note(key, MAPPED, KEYS[key][1]) for key in ("E", "nu", "density") if key in values]
    _plastic(values, kind, young / (2.0 * (1.0 + nu)), made, notes)
    parts = []
    for i, extra in enumerate(values.get("additional_material_params", [])):
        place = f"additional_material_params[{i}]"
        for key in ("point", "size", "E", "nu"):
            if key not in extra:
                raise InputError(f"{place}.{key} is missing", "give point, size, E and nu")
        if not space.aligned:
            text = "its box lies along no axis of the scene: choose an upward axis of theirs"
            notes.append(Note(place, UNSUPPORTED, text))
            continue
        middle = np.array(space.place(numbers(extra, "point", [], f"{place}.")))
        half = 0.5 * np.array(space.edges(numbers(extra, "size", [], f"{place}.")))
        box = [np.round(corner, 9).tolist() for corner in (middle - half, middle + half)]
        changes = {
            "young_modulus": number(extra, "E", 0.0, f"{place}."),
            "poisson_ratio": _poisson(number(extra, "nu", 0.0, f"{place}."), f"{place}.nu", notes),
            "density": number(extra, "density", made["density"], f"{place}."),
        }
        parts.append({"name": f"part{i + 1}", "where": {"box": box}, **changes})
        notes.append(Note(place, MAPPED, f"objects.object.parts, part{i + 1}"))
    return made | ({"parts": parts} if parts else {})


def _poisson(nu: float, key: str, notes: list[Note]) -> float:
    if not 0.0 <= nu <= 0.5:
        raise InputError(f"{key} must lie in 0..0.5, got {nu:g}", "correct the config")
    if nu > 0.495:
        notes.append(Note(key, NEAR, f"0.495 instead of {nu:g}: nothing is incompressible here"))
    return min(nu, 0.495)


def _plastic(
    values: Mapping[str, Any], kind: str, mu: float, made: dict[str, Any], notes: list[Note]
) -> None:
    """Parameters of materials that flow; notes for those that the material does not read."""
    flows = _LAW.get(kind) == "von_mises"
    unread = f"{kind} does not read it in PhysGaussian"
    if "friction_angle" in values and kind != "sand":
        notes.append(Note("friction_angle", INERT, unread))
    if kind == "sand":
        made["friction_angle"] = number(values, "friction_angle", _FRICTION_ANGLE)
        text = f"{made['friction_angle']:g} degrees"
        notes.append(Note("friction_angle", MAPPED, text))
    for key in ("yield_stress", "hardening", "xi"):
        if key in values and not flows:
            notes.append(Note(key, INERT, unread))
    if flows:
        given = number(values, "yield_stress", 0.0)
        # foam: |dev tau| = sqrt(2/3) y as here; metal, plasticine: |dev tau| = y
        made["yield_stress"] = given if kind == "foam" else math.sqrt(1.5) * given
        text = f"{made['yield_stress']:g} Pa in a tension test"
        if "yield_stress" not in values:
            text = "missing, which is 0 in PhysGaussian and here: it flows at once"
        notes.append(Note("yield_stress", MAPPED, text))
        hard = number(values, "hardening", 0.0) == 1.0 and kind != "foam"
        if hard:
            made["hardening_modulus"] = 3.0 * mu * number(values, "xi", 0.0)
        for key in ("hardening", "xi"):
            if key in values:
                read = hard or (key == "hardening" and kind != "foam")
                text = KEYS[key][1] if read else "foam does not harden in PhysGaussian"
                if key == "xi" and not hard and kind != "foam":
                    text = "hardening is not 1"
                notes.append(Note(key, MAPPED if read else INERT, text))
    for key, reader in (("plastic_viscosity", "foam"), ("softening", "plasticine")):
        given = number(values, key, _UNSET.get(key, 0.0))
        gives = kind == reader and given != 0.0
        if gives and key == "plastic_viscosity":
            made["plastic_viscosity"] = given
        elif gives:  # per norm of the strain that flows; ours is per sqrt(2/3) of it, and uniaxial
            made["hardening_modulus"] = made.get("hardening_modulus", 0.0) - 1.5 * given
        if key in values or gives:
            text = KEYS[key][1] if gives else (unread if kind != reader else "it is 0")
            text += "" if key in values else f" ({given:g} Pa unless set)"
            notes.append(Note(key, KEYS[key][0] if gives else INERT, text))


def _damping(values: Mapping[str, Any], notes: list[Note]) -> None:
    key = "grid_v_damping_scale"
    if key in values:
        factor = number(values, key, 1.1)
        if factor >= 1.0:
            notes.append(Note(key, INERT, "1 or more damps nothing in PhysGaussian"))
        else:
            step = number(values, "substep_dt", 1e-4)
            rate = -math.log(max(factor, 1e-300)) / step
            text = f"{KEYS[key][1]}: all speeds would fall by exp(-{rate:.3g} t), t in seconds"
            notes.append(Note(key, UNSUPPORTED, text))
    key = "rpic_damping"
    if key in values:
        zero = number(values, key, 0.0) == 0.0
        notes.append(Note(key, INERT if zero else UNSUPPORTED, "it is 0" if zero else KEYS[key][1]))
