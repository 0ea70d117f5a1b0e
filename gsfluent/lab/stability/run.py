"""The list of all maps, and running what is missing of them."""

from __future__ import annotations

import dataclasses
import itertools
import math
import shutil
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gsfluent.errors import InputError
from gsfluent.lab.charts.record import commit, machine, now
from gsfluent.lab.stability import contact, matter, rounding, steps, transfer
from gsfluent.lab.stability.maps import Map, Place, Point, Value, key_of, read
from gsfluent.progress import Progress
from gsfluent.sweep.engine import map as sweep_map
from gsfluent.sweep.engine import required

Task = tuple[str, str, Value, Value, str]
"""Map, variant, x, y and device of a point."""


def all_maps() -> dict[str, Map]:
    """All maps by name, in the order of the page."""
    rooms = (contact, matter, rounding, steps, transfer)
    return {m.name: m for room in rooms for m in vars(room).values() if isinstance(m, Map)}


def chosen(names: Sequence[str] | None = None, *, gpu: bool = False) -> list[Map]:
    """The maps of these names; default: all, or with ``gpu`` those of the GPU's subset.

    Raises:
        InputError: A name that no map has.
    """
    known = all_maps()
    for name in names or ():
        if name not in known:
            raise InputError(f"--maps {name}: no such map", f"take of {', '.join(known)}")
    if names:
        return [known[name] for name in dict.fromkeys(names)]
    return [m for m in known.values() if m.gpu or not gpu]


def points(wanted: Sequence[Map], *, quick: bool = False) -> list[tuple[str, str, Value, Value]]:
    """All (map, variant, x, y) to run; ``quick``: three by three of each map."""
    todo: list[tuple[str, str, Value, Value]] = []
    for m in wanted:
        xs = m.x.coarse() if quick else m.x.values
        ys = m.y.coarse() if quick else m.y.values
        todo += [(m.name, variant, x, y) for variant in m.variants for y in ys for x in xs]
    return todo


def run_point(task: Task) -> Point:
    """Run one point of a map."""
    name, variant, x, y, device = task
    m = all_maps()[name]
    begin = time.perf_counter()
    outcome = m.run(x, y, variant, Place(device))
    seconds = time.perf_counter() - begin
    bad = outcome.violation
    value = bad.value if bad is not None and math.isfinite(bad.value) else None
    return Point(
        map=name, variant=variant, x=x, y=y, limit=outcome.steps,
        step=None if bad is None else bad.step, kind="" if bad is None else bad.kind, value=value,
        note="" if bad is None else bad.note, points=outcome.points, seconds=round(seconds, 4),
        device=device, machine=machine(device), commit=commit(), date=now(),
    )  # fmt: skip


def run_maps(
    wanted: Sequence[Map],
    path: str | Path,
    *,
    device: str = "cpu",
    quick: bool = False,
    jobs: int = 1,
    on: str = "local",
    progress: Progress | None = None,
) -> list[Point]:
    """Run what is missing of these maps; every point is written as soon as it is done.

    With several jobs, or elsewhere than in this process, the rows of the maps are tasks of a sweep
    beside the file: they are kept there until all are done, and then written.

    Args:
        wanted: The maps.
        path: File of the points.
        device: Where.
        quick: Three by three points of each map.
        jobs: Rows at a time.
        on: See :func:`gsfluent.sweep.map`.
        progress: Called per point, or per row.

    Returns:
        The points of these maps, those of the file included.

    Raises:
        InputError: The file holds something else, or jobs is not positive.
    """
    if jobs < 1:
        raise InputError(f"--jobs {jobs}", "give at least 1")
    path = Path(path)
    have = {p.key: p for p in read(path)} if path.is_file() else {}
    tasks = [(*p, device) for p in points(wanted, quick=quick)]
    keys = [key_of(*task) for task in tasks]
    todo = [task for task, key in zip(tasks, keys, strict=True) if key not in have]
    path.parent.mkdir(parents=True, exist_ok=True)
    placed = jobs > 1 or on != "local"
    done = len(tasks) - len(todo)
    fresh = _by_sweep(todo, path.with_suffix(".tasks"), jobs, on, progress) if placed else None
    with path.open("a", encoding="utf-8") as file:
        if path.stat().st_size and not path.read_bytes().endswith(b"\n"):
            file.write("\n")  # what a stopped run left: the half line is skipped when read
        for point in fresh if fresh is not None else map(run_point, todo):
            file.write(point.line())
            file.flush()
            have[point.key] = point
            done += 1
            if progress is not None:
                progress(done, len(tasks), point.map)
    shutil.rmtree(path.with_suffix(".tasks"), ignore_errors=True)  # all of it is in the file
    return [have[key] for key in keys]


def run_row(tasks: Sequence[Task], folder: Path) -> list[dict[str, Any]]:
    """A row of points, as a task of a sweep."""
    return [dataclasses.asdict(run_point(task)) for task in tasks]


def _by_sweep(
    todo: Sequence[Task], folder: Path, jobs: int, on: str, progress: Progress | None
) -> list[Point]:
    """Run points in other processes, a row of a map each: a point alone is too small a task."""
    rows = [list(row) for _, row in itertools.groupby(todo, lambda t: (t[0], t[1], t[3]))]
    outcomes = sweep_map(run_row, rows, folder, jobs=jobs, on=on, retry=True, progress=progress)
    found = required(outcomes, "rows of points failed", folder)
    return [Point(**values) for outcome in found for values in outcome.value]
