"""Running a ladder into a file of records, resumable and within a budget."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path

import torch

from gsfluent.lab.charts.ladder import OFF_GRID, Setting, work
from gsfluent.lab.charts.off_grid import measure_off_grid
from gsfluent.lab.charts.record import Record, append, commit, machine, now, read
from gsfluent.lab.charts.run_case import measure
from gsfluent.progress import Progress, report_progress

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
    progress: Progress | None = None,
) -> Done:
    """Run what a file does not hold yet; a line is added as soon as its run is done.

    What is expected to pass the budget [s] is left out: time goes with points times steps of
    the last similar one.
    """
    begun = time.monotonic()
    have = {r.key: r for r in read(path)} if path.exists() else {}
    floor = f"copy|torch copy|||{device.split(':')[0]}"
    if floor not in have:
        have[floor] = bandwidth(device)
        append(path, have[floor])
    pace: dict[tuple[str, str, str], float] = {}
    left_out, fresh = [], 0
    total = len(settings)
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
        judge = measure_off_grid if setting.case in OFF_GRID else measure
        have[key] = judge(setting, device, repeat)
        append(path, have[key])
        fresh += 1
        spent = (time.monotonic() - start) / work(setting)
        pace[like[0]] = spent
        pace.setdefault(like[1], spent)
    report_progress(progress, total, total, f"{fresh} run, {len(left_out)} left out")
    wanted = [floor, *(s.key(device) for s in settings)]
    records = [have[k] for k in dict.fromkeys(wanted) if k in have]
    return Done(records, fresh, left_out, time.monotonic() - begun)
