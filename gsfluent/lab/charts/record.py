"""One JSON line per run: what every chart and table of the lab is drawn from."""

from __future__ import annotations

import dataclasses
import datetime
import functools
import json
import math
import os
import statistics
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from gsfluent.errors import InputError
from gsfluent.fracturebench.registry import Case, judge
from gsfluent.fracturebench.run import Measure, Run
from gsfluent.fracturebench.scene import Scene
from gsfluent.hardware import processor


@dataclasses.dataclass(frozen=True)
class Record:
    """A run of one case by one method at one setting, repeated."""

    case: str  # name of the case
    kind: str  # elastic, contact or fracture; other charts have kinds of their own
    method: str  # who computed it, such as gsfluent, textbook or physgaussian
    variant: str  # what differs from the method's defaults, in words; part of the key
    settings: Mapping[str, Any]  # dx, cfl, dt, ppc, dtype, engine, fields, ...
    device: str  # cpu or cuda
    machine: str  # processor and cores, or the GPU
    points: int  # material points
    steps: int  # steps taken
    simulated_seconds: float  # [s]
    wall_seconds: Sequence[float]  # of every repeat, the steps only [s]
    wall_per_simulated: float  # median wall time over simulated time
    ns_per_point_step: float  # median wall time over points and steps [ns]
    error: float  # first measure of the case; infinite for a run that broke off
    measures: Sequence[Mapping[str, Any]] = ()  # all measures, as plain values
    failed: str = ""  # why it broke off, or empty
    commit: str = ""  # of gsfluent, or version of the method
    date: str = ""  # ISO 8601, UTC

    @property
    def ok(self) -> bool:
        """Whether it went through and has an error and a time."""
        return (
            not self.failed
            and math.isfinite(self.error)
            and math.isfinite(self.wall_per_simulated)
            and self.wall_per_simulated > 0.0
        )

    @property
    def key(self) -> str:
        """What makes a run the same run: it is not done again when a chart is resumed."""
        dx = self.settings.get("dx")
        rung = f"{float(dx):.5g}" if isinstance(dx, int | float) else ""
        return "|".join((self.case, self.method, self.variant, rung, self.device.split(":")[0]))

    def line(self) -> str:
        """The record as one line of strict JSON, with its end; infinity and NaN become null."""
        return json.dumps(_plain(dataclasses.asdict(self)), allow_nan=False) + "\n"


_NAMES = tuple(f.name for f in dataclasses.fields(Record))
_MUST = _NAMES[: _NAMES.index("measures")]
_REALS = ("simulated_seconds", "wall_per_simulated", "ns_per_point_step", "error")


def _plain(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if hasattr(value, "item"):  # a number of NumPy
        return _plain(value.item())
    return value


def read(path: str | Path) -> list[Record]:
    """Records of a file, in the order of writing; of equal keys the last one counts.

    A last line that was cut off (the machine went down while it was written) is left out. Keys that
    are not a record's are left out too, so that a line may carry more.

    Raises:
        InputError: The file cannot be read, or a line is no record.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read ({error})", "give a .jsonl of records") from error
    found: dict[str, Record] = {}
    for number, line in enumerate(text.splitlines(keepends=True), 1):
        if not line.endswith("\n") or not line.strip():
            continue
        record = record_of(line, f"{path}, line {number}")
        found.pop(record.key, None)
        found[record.key] = record
    return list(found.values())


def record_of(line: str, where: str) -> Record:
    """The record that a line holds; ``where`` names it in the error.

    Raises:
        InputError: It holds none.
    """
    try:
        data = json.loads(line)
        given = {name: data[name] for name in _NAMES if name in data}
        for name in _REALS:
            given[name] = math.inf if given[name] is None else float(given[name])
        given["wall_seconds"] = [math.inf if w is None else float(w) for w in data["wall_seconds"]]
        given["settings"] = dict(given["settings"])
        return Record(**given)
    except (ValueError, TypeError, KeyError) as error:
        raise InputError(
            f"{where}: not a record ({type(error).__name__}: {error})",
            f"a line holds at least {', '.join(_MUST)}; remove it, or make the file anew",
        ) from error


def append(path: str | Path, record: Record) -> None:
    """Add a record to a file, made if missing; what was cut off at its end is removed first.

    The line goes out in one write and is on the disk when this returns, so that whatever happens
    next the file holds whole lines, and at most one that is cut off.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a+b") as file:
        file.seek(0, os.SEEK_END)
        size = file.tell()
        if size:
            file.seek(0)
            whole = file.read().rfind(b"\n") + 1
            if whole < size:
                file.truncate(whole)
        file.write(record.line().encode())
        file.flush()
        os.fsync(file.fileno())


def of_run(
    case: Case,
    scene: Scene,
    runs: Run | Iterable[Run],
    *,
    variant: str = "",
    wall: Sequence[float] | None = None,
    steps: int | None = None,
    machine: str | None = None,
    commit: str | None = None,
    **settings: Any,
) -> Record:
    """Judge the repeats of one run.

    Args:
        case: The case.
        scene: What was run.
        runs: One run, or its repeats by one method at one setting.
        variant: What differs from the method's defaults.
        wall: Seconds of separate runs that went to the last time without a stop; default: those of
            the runs given, which also stopped at every time asked for.
        steps: Steps of one of these; default: of the run that is judged.
        machine: Where; default: this one.
        commit: Of what; default: of gsfluent.
        **settings: Added to those of the run; ``points`` counts where it is not the scene's.

    Returns:
        The median of the times, and the error and measures of the repeat of median error; if any
        repeat broke off, an infinite error and the first reason.

    Raises:
        ValueError: No runs.
        SceneError: A run does not answer the scene.
    """
    repeats = [runs] if isinstance(runs, Run) else list(runs)
    if not repeats:
        raise ValueError("of_run: needs at least one run")
    first = repeats[0]
    judged = [judge(scene, run) for run in repeats]
    broken = [i for i, run in enumerate(repeats) if not run.finite]
    order = sorted(range(len(repeats)), key=lambda i: judged[i][0].error)
    chosen = broken[0] if broken else order[(len(order) - 1) // 2]
    measures: list[Measure] = judged[chosen]
    failed = (repeats[chosen].failed or "a number is not finite") if broken else ""
    wall = [float(run.wall_seconds) for run in repeats] if not wall else [float(w) for w in wall]
    middle = statistics.median(wall)
    steps = repeats[chosen].steps if steps is None else steps
    points = int(settings.get("points", scene.count))
    per_cell = round(scene.dx**3 / sorted(scene.volume)[scene.count // 2], 3)
    known = {"dx": scene.dx, "ppc": per_cell, **first.settings, **settings}
    if len(repeats) > 1 and (judged[order[-1]][0].error > judged[order[0]][0].error):
        known["errors"] = [m[0].error for m in judged]
    return Record(
        case=case.name, kind=case.kind, method=first.method, variant=variant, settings=known,
        device=first.device, machine=_machine(first.device) if machine is None else machine,
        points=points, steps=steps, simulated_seconds=scene.seconds, wall_seconds=wall,
        wall_per_simulated=middle / scene.seconds,
        ns_per_point_step=1e9 * middle / (points * max(1, steps)),
        error=math.inf if broken else float(measures[0].error),
        measures=[dataclasses.asdict(m) for m in measures], failed=failed,
        commit=_commit() if commit is None else commit, date=now(),
    )  # fmt: skip


@functools.cache
def machine(device: str) -> str:
    """Name of a device: the GPU, or the processor with the cores this process may use."""
    if device.startswith("cuda"):
        import torch

        return torch.cuda.get_device_name(torch.device(device))
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    threads = os.environ.get("OMP_NUM_THREADS", "")
    return f"{processor()}, {threads or cores} of {cores} cores"


@functools.cache
def commit() -> str:
    """Short commit of the checkout that gsfluent is imported from, else its version."""
    import gsfluent

    folder = Path(gsfluent.__file__).resolve().parents[1]
    try:
        done = subprocess.run(
            ["git", "rev-parse", "--short", "HEAD"], cwd=folder, capture_output=True, text=True,
            timeout=10, check=True,
        )  # fmt: skip
        return done.stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return f"gsfluent {gsfluent.__version__}"


def now() -> str:
    """The date of a record: ISO 8601 in UTC, to the second."""
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")


# the names that of_run's arguments hide
_machine, _commit = machine, commit
