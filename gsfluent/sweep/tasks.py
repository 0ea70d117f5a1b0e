"""The shots of a sweep: read, drawn, looked through before any begins, named by what goes in."""

# ruff: noqa: RUF009 - key() makes a dataclass field, not a shared default

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from gsfluent.config import Shot
from gsfluent.config.read import (
    Place,
    choice,
    existing_path,
    key,
    nested,
    number,
    optional,
    section,
    whole,
)
from gsfluent.config.yaml_file import read_yaml
from gsfluent.errors import InputError
from gsfluent.io import write_json
from gsfluent.io.checked.files import read_json
from gsfluent.io.solid import volume_path
from gsfluent.progress import Progress, report_progress
from gsfluent.results.store import content_digest, fingerprint
from gsfluent.spatial.mesh_file import mesh_files
from gsfluent.stages.known import is_solid
from gsfluent.sweep.axes import MOST, SAMPLES, SEED, Axis, changed, draw, read_axes
from gsfluent.sweep.engine import TRIES

_log = logging.getLogger(__name__)
FILE = "tasks.json"
"""The list of the shots of a sweep, so that one that goes on need not look through them again."""
_ID = 16


@dataclasses.dataclass(frozen=True)
class Each:
    """``each:`` - what one shot may take."""

    cpus: int = key(whole(1, 4096), "Threads of a shot.", "2", default=1)
    gpu: float | None = optional(
        number(0.0, 1.0, above=0.0), "Part of a GPU; by its memory when absent.", "0.25"
    )
    minutes: float | None = optional(number(above=0.0), "Longest time of a shot [min].", "30")
    tries: int = key(
        whole(1, 100), "Tries of a shot that was killed or ran out of memory.", "3", default=TRIES
    )


@dataclasses.dataclass(frozen=True)
class Sweep:
    """A sweep file."""

    shot: Path = key(existing_path, "The shot that all others are made from.", "melon.yaml")
    vary: tuple[Axis, ...] = key(read_axes, "What differs, by key.", "{seed: {range: [0, 9]}}")
    sample: str = key(choice(*SAMPLES), "How values are drawn.", "sobol", default="grid")
    count: int | None = optional(whole(1, MOST), "How many shots; of a grid all.", "200")
    keep: str = key(
        choice("all", "film"), "What stays of a shot: all, or film and figures.", "film",
        default="all",
    )  # fmt: skip
    each: Each = key(nested(Each), "What one shot may take.", "{cpus: 2}", default=Each())


def read_sweep(path: Path, vary: Mapping[str, list[Any]], seeds: int | None) -> Sweep:
    """Read a sweep file, or make a sweep of a shot and what the command line says.

    Args:
        path: A file with the key ``shot``; or a shot.
        vary: Values by key, for a shot.
        seeds: How many seeds, for a shot.

    Raises:
        InputError: Not such a file, or a key or value of it is wrong.
    """
    values = read_yaml(path)
    folder = path.resolve().parent
    if isinstance(values, Mapping) and "shot" in values:
        if vary or seeds is not None:
            raise InputError(
                f"--vary and --seeds are for a shot, {path} is a sweep file", "write them there"
            )
        try:
            return section(Sweep, values, Place("", folder))
        except InputError as error:
            raise InputError(f"{path}: {error.what}", error.hint) from error
    axes: dict[str, Any] = {name: {"grid": items} for name, items in vary.items()}
    if seeds is not None:
        axes[SEED] = {"range": [0, seeds]}
    if not axes:
        raise InputError(f"{path}: nothing differs", "say --vary KEY=A,B,C or --seeds 10")
    return section(Sweep, {"shot": path.name, "vary": axes}, Place("", folder))


@dataclasses.dataclass(frozen=True)
class Common:
    """What all shots of a sweep have in common."""

    shot: dict[str, Any]  # As in the shot file
    folder: Path  # Where its relative paths start
    device: str  # Where the work is done
    solids_seed: int  # Seed of reconstruction, fill and texture
    shared: Path  # Solids by fingerprint
    keep: str  # ``all`` or ``film``


@dataclasses.dataclass(frozen=True)
class Task:
    """One shot of a sweep."""

    id: str  # Digest of all that goes in
    index: int  # Number of its draw
    changes: dict[str, Any]  # Values by key
    seed: int  # Of what moves
    object: str  # Digest of the object that it is of
    solids: str  # The same for shots with the same solids, as far as can be seen beforehand
    common: Common

    def shot(self) -> Shot:
        """The shot."""
        return Shot.from_dict(changed(self.common.shot, self.changes), self.common.folder)


def tasks_of(
    sweep: Sweep, out: Path, *, device: str, seed: int, progress: Progress | None = None
) -> list[Task]:
    """Draw the shots of a sweep and look through all of them, or find that done.

    Args:
        sweep: What differs.
        out: Folder of the sweep.
        device: Where the work will be done.
        seed: Of the draws, of the solids, and of shots that have none of their own.
        progress: Called while shots are looked through.

    Raises:
        InputError: A shot cannot be; the message says which.
    """
    values = read_yaml(sweep.shot)
    if not isinstance(values, Mapping):
        raise InputError(f"{sweep.shot}: must be a YAML mapping", "see docs/guide/shot-keys.md")
    folder = sweep.shot.resolve().parent
    common = Common(dict(values), folder, device, seed, out / "stages", sweep.keep)
    draws = draw(sweep.vary, sweep.sample, sweep.count, seed)
    wanted = fingerprint("tasks", values, str(folder), draws, device, seed, sweep.keep)
    found = _known(out / FILE, wanted)
    if found is None:
        digests: dict[str, str] = {}
        found = []
        for index, (changes, own) in enumerate(draws):
            try:
                shot = Shot.from_dict(changed(values, changes), folder)
            except InputError as error:
                what = ", ".join(f"{name} {value}" for name, value in changes.items())
                raise InputError(f"shot {index} ({what}): {error.what}", error.hint) from error
            own_seed = seed if own is None else own
            where = [seed, device.partition(":")[0], sweep.keep]
            found.append([index, own_seed, *_digests(shot, own_seed, where, digests)])
            report_progress(progress, index + 1, len(draws), "looked through")
        write_json(out / FILE, {"key": wanted, "inputs": digests, "tasks": found})
    tasks: dict[str, Task] = {}
    for index, own_seed, name, thing, solids in found:
        task = Task(name, index, draws[index][0], own_seed, thing, solids, common)
        tasks.setdefault(name, task)
    if len(tasks) < len(found):
        _log.info("%d draws are the same as others and are done once", len(found) - len(tasks))
    return list(tasks.values())


def _known(path: Path, wanted: str) -> list[Any] | None:
    """The list of an earlier call, if nothing that goes in has changed."""
    if not path.is_file():
        return None
    known = read_json(path, "remove it; it is made again")
    if not isinstance(known, dict) or known.get("key") != wanted:
        return None
    for name, digest in dict(known["inputs"]).items():
        if not Path(name).exists() or content_digest(Path(name)) != digest:
            return None
    return list(known["tasks"])


def _digests(
    shot: Shot, seed: int, where: list[Any], known: dict[str, str]
) -> tuple[str, str, str]:
    """Names of a shot, of its object and of its solids; the content of files, not their paths."""
    source = _source(shot)
    for path in [*source, *_paths(shot)]:
        if str(path) not in known:
            known[str(path)] = content_digest(path)
    thing = fingerprint([known[str(path)] for path in source])[:_ID]
    values = _by_content(shot.resolved(), known)
    where = [thing, *where]
    name = fingerprint("shot", values, seed, where)[:_ID]
    solids = {key: values.get(key) for key in _OF_SOLIDS}
    objects = {
        key: [item["select"], item["material"], [p["where"] for p in item.get("parts") or ()]]
        for key, item in values["objects"].items()
    }
    more = [values["solve"]["quality"], values["output"]["backdrop"], where]
    return name, thing, fingerprint("solids", solids, objects, more)[:_ID]


_OF_SOLIDS = (
    "scale", "size", "up", "front", "floor", "origin", "reconstruct", "fill", "texture",
)  # fmt: skip


def _source(shot: Shot) -> list[Path]:
    """All files that the object of a shot is read from."""
    if shot.mesh is not None:
        return list(mesh_files(shot.mesh))
    if shot.splats is None:
        assert shot.capture is not None  # a shot has one of the three
        return [shot.capture]
    return [shot.splats, *([volume_path(shot.splats)] if is_solid(shot.splats) else [])]


def _by_content(value: Any, known: Mapping[str, str]) -> Any:
    """Plain values with the digests of files for their paths."""
    if isinstance(value, dict):
        return {name: _by_content(item, known) for name, item in value.items()}
    if isinstance(value, list):
        return [_by_content(item, known) for item in value]
    return known.get(value, value) if isinstance(value, str) else value


def _paths(value: Any) -> Iterator[Path]:
    """All files and folders that settings name."""
    if isinstance(value, Path):
        yield value
    elif dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            yield from _paths(getattr(value, field.name))
    elif isinstance(value, Mapping | list | tuple):
        for item in value.values() if isinstance(value, Mapping) else value:
            yield from _paths(item)
