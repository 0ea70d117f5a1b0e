"""Running a ladder into a file of records, resumable and within a budget."""

from __future__ import annotations

import dataclasses
import os
import shutil
import time
from collections.abc import Sequence
from pathlib import Path

import torch

from gsfluent.errors import InputError
from gsfluent.lab.charts.ladder import OFF_GRID, Setting, work
from gsfluent.lab.charts.off_grid import measure_off_grid
from gsfluent.lab.charts.record import Record, append, commit, machine, now, read, record_of
from gsfluent.lab.charts.run_case import measure
from gsfluent.progress import Progress, report_progress
from gsfluent.results.store import fingerprint
from gsfluent.sweep.engine import map, required

BYTES = 208.0
"""What the two passes of the solver read and write of a float32 point in a step
(docs/measured/benchmarks.md); of a NACC point 224."""


@dataclasses.dataclass(frozen=True)
class Done:
    """What came of a ladder."""

    # of all settings that have one, in the order of the ladder, and the machine's
    records: list[Record]
    fresh: int  # how many of them were run now
    left_out: list[Setting]  # settings that did not fit into the budget
    seconds: float  # what it took [s]


def bandwidth(device: str) -> Record:
    """Measure what a plain copy moves, and the floor it sets for a point and a step."""
    source = torch.ones(256 << 18, dtype=torch.float32, device=device)
    target = torch.empty_like(source)
    seconds = []
    for _ in range(6):  # the first one warms up
        start = time.perf_counter()
        target.copy_(source)
        if device.startswith("cuda"):
            torch.cuda.synchronize()
        seconds.append(time.perf_counter() - start)
    moved = 2.0 * source.numel() * source.element_size()
    rate = moved / min(seconds[1:])
    return Record(
        case="copy", kind="machine", method="torch copy", variant="",
        settings={"gigabytes_per_second": rate / 1e9, "bytes_per_point_step": BYTES}, device=device,
        machine=machine(device), points=0, steps=0, simulated_seconds=0.0, wall_seconds=seconds[1:],
        wall_per_simulated=0.0, ns_per_point_step=1e9 * BYTES / rate, error=0.0, commit=commit(),
        date=now(),
    )  # fmt: skip


def run(
    settings: Sequence[Setting],
    path: Path,
    *,
    device: str,
    repeat: int = 3,
    budget: float | None = None,
    jobs: int = 1,
    on: str = "local",
    progress: Progress | None = None,
) -> Done:
    """Run what a file does not hold yet; a line is added as soon as its run is done.

    Args:
        settings: The ladder.
        path: File of the records.
        device: Where.
        repeat: Timed runs of each setting.
        budget: What is expected to pass it [s] is left out: time goes with points times steps of
            the last similar one.
        jobs: Runs at a time. More share memory and caches: their times are not those of one alone.
        on: See :func:`gsfluent.sweep.map`. Runs that are placed are kept beside the file until all
            are done, and have no budget.
        progress: Called per run.

    Raises:
        InputError: A budget for runs that are placed.
    """
    if placed := jobs > 1 or on != "local":
        if budget is not None:
            raise InputError(
                "a budget goes by the times of runs one after the other",
                "give 0, or leave out jobs and on",
            )
    begun = time.monotonic()
    have = {r.key: r for r in read(path)} if path.exists() else {}
    floor = f"copy|torch copy|||{device.split(':')[0]}"
    if floor not in have:
        have[floor] = bandwidth(device)
        append(path, have[floor])
    pace: dict[tuple[str, str, str], float] = {}
    left_out, fresh = [], 0
    total = len(settings)
    if placed:
        todo = [s for s in settings if s.key(device) not in have]
        for record in _by_sweep(
            todo, path.with_suffix(".tasks"), device, repeat, jobs, on, progress
        ):
            have[record.key] = record
            append(path, record)
            fresh += 1
        shutil.rmtree(path.with_suffix(".tasks"), ignore_errors=True)  # all of it is in the file
    for i, setting in enumerate(settings):
        words = f"{setting.case} {setting.method} {setting.variant or f'dx {setting.dx:.3g}'}"
        report_progress(progress, i, total, words)
        key = setting.key(device)
        if key in have:
            continue
        # similar: the same method, and the same variant if that was run before
        like = ((setting.case, setting.method, setting.variant), (setting.case, setting.method, ""))
        expected = next((pace[k] for k in like if k in pace), 0.0) * work(setting)
        if budget is not None and time.monotonic() - begun + expected > budget:
            left_out.append(setting)
            continue
        start = time.monotonic()
        have[key] = _measured(setting, device, repeat)
        append(path, have[key])
        fresh += 1
        spent = (time.monotonic() - start) / work(setting)
        pace[like[0]] = spent
        pace.setdefault(like[1], spent)
    report_progress(progress, total, total, f"{fresh} run, {len(left_out)} left out")
    wanted = [floor, *(s.key(device) for s in settings)]
    records = [have[k] for k in dict.fromkeys(wanted) if k in have]
    return Done(records, fresh, left_out, time.monotonic() - begun)


def _measured(setting: Setting, device: str, repeat: int) -> Record:
    judge = measure_off_grid if setting.case in OFF_GRID else measure
    return judge(setting, device, repeat)


def measure_task(item: tuple[Setting, str, int], folder: Path) -> str:
    """The line of a setting, as a task of a sweep."""
    return _measured(*item).line()


def _by_sweep(
    todo: Sequence[Setting],
    folder: Path,
    device: str,
    repeat: int,
    jobs: int,
    on: str,
    progress: Progress | None,
) -> list[Record]:
    """Measure settings in other processes; one of this machine has an equal share of its cores."""
    threads = max((os.cpu_count() or 1) // jobs, 1) if on == "local" else 1
    outcomes = map(
        measure_task, [(s, device, repeat) for s in todo], folder,
        ids=[fingerprint("chart", s.key(device), repeat) for s in todo], jobs=jobs, threads=threads,
        on=on, retry=True, progress=progress,
    )  # fmt: skip
    found = required(outcomes, "runs failed", folder)
    return [record_of(o.value, f"{folder}, {o.id}") for o in found]
