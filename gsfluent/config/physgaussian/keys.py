"""The keys of PhysGaussian's JSON configs: what each becomes here, or why it becomes nothing.

Learned from the public repository (github.com/XPandora/PhysGaussian, commit 8339ed6); nothing of it
is copied. ``docs/guide/physgaussian.md`` shows these tables.
"""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from gsfluent.config.read import nearest
from gsfluent.errors import InputError, short
from gsfluent.io.checked.files import read_json

MAPPED, NEAR, UNSUPPORTED, INERT, UNKNOWN = "mapped", "near", "unsupported", "inert", "unknown"
"""Same meaning; nearly so; no meaning here yet; does nothing there or here; not a key."""

KEYS: dict[str, tuple[str, str]] = {
    "material": (MAPPED, "objects.object.law"),
    "E": (MAPPED, "objects.object.young_modulus"),
    "nu": (MAPPED, "objects.object.poisson_ratio"),
    "density": (MAPPED, "objects.object.density"),
    "g": (MAPPED, "gravity, turned with the up axis"),
    "yield_stress": (MAPPED, "objects.object.yield_stress, as the stress of a tension test"),
    "hardening": (MAPPED, "objects.object.hardening_modulus (with xi)"),
    "xi": (MAPPED, "objects.object.hardening_modulus, 3 mu xi"),
    "friction_angle": (MAPPED, "objects.object.friction_angle"),
    "plastic_viscosity": (MAPPED, "objects.object.plastic_viscosity"),
    "softening": (
        NEAR,
        "in objects.object.hardening_modulus, -3/2 of it; what has softened to nothing keeps its "
        "volume here",
    ),
    "additional_material_params": (MAPPED, "objects.object.parts with where: box"),
    "grid_lim": (MAPPED, "with n_grid: the size of a cell, and the walls of bounding_box"),
    "n_grid": (NEAR, "solve.quality whose cells are nearest in size"),
    "substep_dt": (INERT, "the solver chooses its own time step"),
    "frame_dt": (MAPPED, "output.fps"),
    "frame_num": (MAPPED, "output.seconds"),
    "grid_v_damping_scale": (UNSUPPORTED, "there is no damping of all motion here"),
    "rpic_damping": (UNSUPPORTED, "the transfer keeps all angular and affine motion here"),
    "pic_damping": (INERT, "PhysGaussian reads it and never uses it"),
    "opacity_threshold": (MAPPED, "fainter Gaussians are left out"),
    "rotation_degree": (MAPPED, "the model is turned so before anything else"),
    "rotation_axis": (MAPPED, "axes of rotation_degree"),
    "sim_area": (MAPPED, "Gaussians outside become the backdrop"),
    "scale": (MAPPED, "size of the object in their box, and here in metres"),
    "particle_filling": (NEAR, "fill: {hollow: none}; without it fill: {hollow: auto}"),
    "boundary_conditions": (MAPPED, "colliders, floor and throw; see below"),
    "mpm_space_vertical_upward_axis": (MAPPED, "+z of the scene"),
    "mpm_space_viewpoint_center": (MAPPED, "where the camera looks"),
    "default_camera_index": (MAPPED, "output.camera from cameras.json"),
    "init_azimuthm": (MAPPED, "output.camera"),
    "init_elevation": (MAPPED, "output.camera"),
    "init_radius": (MAPPED, "output.camera"),
    "move_camera": (MAPPED, "output.camera"),
    "delta_a": (MAPPED, "output.camera"),
    "delta_e": (MAPPED, "output.camera"),
    "delta_r": (MAPPED, "output.camera"),
    "show_hint": (INERT, "gsfluent view shows where a camera stands"),
}
"""Top-level key: what it is, and what it becomes or why not."""

BOUNDARIES: dict[str, tuple[str, str, tuple[str, ...], tuple[str, ...]]] = {
    "bounding_box": (MAPPED, "six planes without friction, the lowest as floor under gravity", (),
                     ()),
    "cuboid": (MAPPED, "a sticky box that is not shown and moves at its velocity while it is there",
               ("point", "size", "velocity"), ("start_time", "end_time", "reset")),
    "enforce_particle_translation": (
        NEAR, "the same sticky box: it holds what is inside it now, not what was at the start",
        ("point", "size", "velocity", "start_time", "end_time"), ()),
    "enforce_particle_velocity_rotation": (
        NEAR, "a sticky cylinder that turns: it holds what is inside it now",
        ("point", "normal", "half_height_and_radius", "rotation_scale", "translation_scale",
         "start_time", "end_time"), ()),
    "surface_collider": (
        MAPPED, "a sticky plane, or the floor: PhysGaussian stops every node behind it, whatever "
        "its surface and friction say",
        ("point", "normal", "surface", "friction", "start_time", "end_time"), ()),
    "release_particles_sequentially": (
        NEAR, "fifty sticky boxes, one after another: they hold what is inside them now",
        ("normal", "start_position", "end_position", "num_layers", "start_time", "end_time"), ()),
    "particle_impulse": (
        NEAR, "throw, with the mean of the speeds that the force gives to the Gaussians",
        ("force",), ("num_dt", "start_time", "point", "size")),
}  # fmt: skip
"""Type of boundary condition: what it is, what it becomes, keys it needs, keys it may have."""

FILLING = (
    "n_grid", "density_threshold", "search_threshold", "search_exclude_direction",
    "ray_cast_direction", "max_particles_num", "max_partciels_per_cell", "boundary", "smooth",
    "visualize",
)  # fmt: skip
"""Keys of particle_filling; all inert: the inside is found in another way here."""

EXTRA = ("point", "size", "E", "nu", "density")
"""Keys of an entry of additional_material_params."""

MATERIALS = ("jelly", "metal", "sand", "foam", "snow", "plasticine")


@dataclasses.dataclass(frozen=True)
class Note:
    """What became of one key."""

    key: str  # Its path in the config
    status: str  # ``mapped``, ``near``, ``unsupported``, ``inert`` or ``unknown``
    text: str  # What it became, or why it became nothing


def read_config(path: Path) -> tuple[dict[str, Any], list[Note]]:
    """Read a config and name what nobody reads.

    Returns:
        Its values, unknown keys left out, and a note for each of those.

    Raises:
        InputError: Not such a file, or a known key of the wrong kind.
    """
    try:
        values = read_json(path, "correct the file")
    except InputError as error:
        raise InputError(f"--config {error.what}", error.hint) from error
    if not isinstance(values, dict):
        raise InputError(
            f"--config {path}: must hold one JSON object", "see docs/guide/physgaussian.md"
        )
    notes: list[Note] = []
    known = _known(values, KEYS, "", notes)
    if "particle_filling" in known:
        filling = _section(known["particle_filling"], "particle_filling")
        for key in _known(filling, FILLING, "particle_filling.", notes):
            text = "the inside is found by rays and votes here (docs/theory/solid.md)"
            notes.append(Note(f"particle_filling.{key}", INERT, text))
    name = "additional_material_params"
    known[name] = [
        _known(_section(entry, f"{name}[{i}]"), EXTRA, f"{name}[{i}].", notes)
        for i, entry in enumerate(_entries(known, name))
    ]
    conditions = []
    for i, entry in enumerate(_entries(known, "boundary_conditions")):
        where = f"boundary_conditions[{i}]"
        kind = _section(entry, where).get("type")
        if kind not in BOUNDARIES:
            raise InputError(
                f"{where}.type: unknown boundary condition {short(kind)}", nearest(kind, BOUNDARIES)
            )
        _, _, needed, more = BOUNDARIES[kind]
        conditions.append(_known(entry, ("type", *needed, *more), f"{where}.", notes))
        for key in needed:
            if key not in entry:
                raise InputError(f"{where}.{key} is missing", f"{kind} needs {', '.join(needed)}")
    known["boundary_conditions"] = conditions
    return known, notes


def _known(
    given: Mapping[str, Any], keys: Iterable[str], place: str, notes: list[Note]
) -> dict[str, Any]:
    known = list(keys)
    for key in given:
        if key not in known:
            close = difflib.get_close_matches(key, known, n=1, cutoff=0.4)
            hint = f"; did you mean {close[0]!r}?" if close else ""
            notes.append(Note(f"{place}{key}", UNKNOWN, f"no key of PhysGaussian's configs{hint}"))
    return {key: value for key, value in given.items() if key in known}


def _section(value: Any, place: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise InputError(f"{place} must be a JSON object, got {short(value)}", "correct the config")
    return value


def _entries(values: Mapping[str, Any], name: str) -> list[Any]:
    entries = values.get(name, [])
    if not isinstance(entries, list):
        raise InputError(f"{name} must be a list, got {short(entries)}", "correct the config")
    return entries


def number(values: Mapping[str, Any], key: str, default: float, place: str = "") -> float:
    """A finite number of the config.

    Raises:
        InputError: It is something else.
    """
    value = values.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e300:
        raise InputError(f"{place}{key} must be a number, got {short(value)}", "correct the config")
    return float(value)


def numbers(
    values: Mapping[str, Any], key: str, default: list[float], place: str = "", count: int = 3
) -> list[float]:
    """A list of ``count`` finite numbers of the config.

    Raises:
        InputError: It is something else.
    """
    found = values.get(key, default)
    if not isinstance(found, list) or len(found) != count:
        raise InputError(
            f"{place}{key} must be {count} numbers, got {short(found)}", "correct the config"
        )
    return [number({key: value}, key, 0.0, place) for value in found]
