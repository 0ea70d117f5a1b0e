"""Error against time of the stages around the simulation: rendering, reconstruction, texturing.

A job is one setting of one case; what it leaves is a :class:`gsfluent.lab.charts.record.Record`
like
those of the solver, with these differences: ``simulated_seconds`` is 1 (a picture, a training, a
texture), so ``wall_per_simulated`` is its time in seconds, and ``points`` counts Gaussians or
voxels. Fronts, figure and tables are those of the solver's chart.
"""

from __future__ import annotations

import dataclasses
import importlib
import math
import shutil
import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from gsfluent.errors import GsfluentError, InputError
from gsfluent.figure.page import Page, markdown_table
from gsfluent.figure.pareto import Dot, Panel, draw
from gsfluent.figure.style import save_png, to_svg
from gsfluent.io.atomic import atomic_path
from gsfluent.lab.charts.front import cases, counted, front
from gsfluent.lab.charts.record import Record, append, commit, machine, now, read, record_of
from gsfluent.progress import Progress, report_progress
from gsfluent.results.store import fingerprint
from gsfluent.sweep.engine import map, required

KINDS = ("rendering", "reconstruction", "texturing")
_METHOD = "gsfluent"


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What a job found."""

    error: float  # below 1; 1 is as wrong as no answer
    wall_seconds: Sequence[float]  # of every repeat [s]
    count: int  # gaussians or voxels
    measures: Mapping[str, float]  # more figures
    # what another, equally good truth would have as its error; None for none
    band: float | None = None
    # what was found out about the setting
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class Job:
    """One setting of one case."""

    case: str  # what is rendered, learned or textured
    variant: str  # the setting in words; empty for the default
    settings: Mapping[str, Any]  # the setting in values
    work: Callable[[int], Outcome]  # does it, with so many timed repeats

    def key(self, device: str) -> str:
        """As :attr:`Record.key`."""
        return "|".join((self.case, _METHOD, self.variant, "", device.split(":")[0]))


def timed(work: Callable[[], Any], repeat: int, device: torch.device) -> tuple[Any, list[float]]:
    """Do something once to warm up, then so often on the clock; last result and seconds of each."""
    import time

    result, found = work(), []
    for _ in range(repeat):
        _wait(device)
        start = time.perf_counter()
        result = work()
        _wait(device)
        found.append(time.perf_counter() - start)
    return result, found


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def run_jobs(
    kind: str,
    jobs: Sequence[Job],
    lines: Path,
    *,
    device: torch.device,
    repeat: int = 3,
    progress: Progress | None = None,
) -> list[Record]:
    """Do what has no line yet, in order.

    Returns:
        The records of these jobs.
    """
    known = {r.key: r for r in read(lines)} if lines.is_file() else {}
    where, version = machine(str(device)), commit()
    found = []
    for number, job in enumerate(jobs, 1):
        record = known.get(job.key(str(device)))
        if record is None:
            record = _record(kind, job, repeat, str(device), where, version)
            append(lines, record)
        found.append(record)
        report_progress(progress, number, len(jobs), f"{job.case}: {job.variant or 'as it is'}")
    return found


def _record(kind: str, job: Job, repeat: int, device: str, where: str, version: str) -> Record:
    failed = ""
    try:
        out = job.work(repeat)
    except GsfluentError as error:
        failed = str(error).splitlines()[0]
        out = Outcome(math.inf, [math.inf], 0, {})
    wall = statistics.median(out.wall_seconds)
    settings = {**job.settings, **out.settings}
    if out.band is not None:
        settings["band"] = out.band
    return Record(
        case=job.case, kind=kind, method=_METHOD, variant=job.variant, settings=settings,
        device=device, machine=where, points=out.count, steps=int(settings.get("steps", 1)),
        simulated_seconds=1.0, wall_seconds=list(out.wall_seconds), wall_per_simulated=wall,
        ns_per_point_step=1e9 * wall / max(1, out.count), error=out.error,
        measures=[{"quantity": name, "value": value} for name, value in out.measures.items()],
        failed=failed, commit=version, date=now(),
    )  # fmt: skip


def chart_quality(
    of: str,
    out: Path,
    *,
    device: torch.device,
    quick: bool = False,
    repeat: int = 3,
    jobs: int = 1,
    on: str = "local",
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Chart rendering, reconstruction or texturing.

    Args:
        of: Which.
        out: Folder of the results.
        device: Where.
        quick: A small ladder.
        repeat: Timed runs of each setting.
        jobs: Settings at a time. More share memory and caches: their times are not those of one.
        on: See :func:`gsfluent.sweep.map`.
        progress: Called per setting.

    Raises:
        InputError: An unknown kind.
    """
    ladder = _module(of).jobs(device=device, quick=quick)
    name = f"{of}_quick" if quick else of  # other sizes: their lines do not mix
    lines = out / f"{name}.jsonl"
    if jobs > 1 or on != "local":
        have = {r.key for r in read(lines)} if lines.is_file() else set()
        left = [n for n, job in enumerate(ladder) if job.key(str(device)) not in have]
        outcomes = map(
            run_task, [(of, str(device), quick, n, repeat) for n in left], folder := out / "tasks",
            ids=[fingerprint(of, ladder[n].key(str(device)), quick, repeat) for n in left],
            jobs=jobs, on=on, retry=True, progress=progress,
        )  # fmt: skip
        for outcome in required(outcomes, "settings failed", folder):
            append(lines, record_of(outcome.value, f"{folder}, {outcome.id}"))
        shutil.rmtree(folder, ignore_errors=True)  # all of it is in the file
    records = run_jobs(of, ladder, lines, device=device, repeat=repeat, progress=progress)
    return {"lines": lines, **_written(of, records, out, name)}


def run_task(item: tuple[str, str, bool, int, int], folder: Path) -> str:
    """The line of a job of a ladder, by its number, as a task of a sweep."""
    of, device, quick, number, repeat = item
    job = _module(of).jobs(device=torch.device(device), quick=quick)[number]
    return _record(of, job, repeat, device, machine(device), commit()).line()


def gathered(of: str, files: Iterable[Path], out: Path) -> dict[str, Any]:
    """Draw recorded lines of one kind.

    Raises:
        InputError: A file cannot be read, or holds no line of this kind.
    """
    _module(of)
    found = {r.key: r for path in files for r in read(path) if r.kind == of}
    if not found:
        raise InputError(f"no records of {of}", f"give files of `gsfluent chart --of {of}`")
    result: dict[str, Any] = {}
    for device in dict.fromkeys(r.device.split(":")[0] for r in found.values()):
        mine = [r for r in found.values() if r.device.split(":")[0] == device]
        result[device] = _written(of, mine, out, f"{of}_{device}")
    return result


def _module(of: str) -> Any:
    if of not in KINDS:
        raise InputError(f"chart: unknown kind {of!r}", f"known: {', '.join(KINDS)}")
    return importlib.import_module(f"gsfluent.lab.charts.{of}")


def _written(of: str, records: Sequence[Record], out: Path, name: str) -> dict[str, Any]:
    out.mkdir(parents=True, exist_ok=True)
    title = f"{of.capitalize()}: error against time, {records[0].machine}"
    xlabel, ylabel = _module(of).XLABEL, _module(of).YLABEL
    panels = [_panel(records, case) for case in cases(records)]
    page = Page(title, f"{len(records)} settings; gsfluent {records[0].commit}")
    above = title if len(panels) > 1 else title.replace(", ", "\n", 1)  # one panel is narrow
    with draw(panels, title=above, xlabel=xlabel, ylabel=ylabel) as figure:
        save_png(figure, out / f"{name}.png")
        page.svg(to_svg(figure), "Every setting a dot; the best as a staircase.")
    head, rows = table(records)
    page.heading("Every setting").table(head, rows)
    page.write(out / f"{name}.html")
    with atomic_path(out / f"{name}.md") as temporary:
        temporary.write_text(f"# {title}\n\n{markdown(records)}", encoding="utf-8")
    best = {
        case: [r.variant or "as it is" for r in front([r for r in records if r.case == case])]
        for case in cases(records)
    }
    return {
        "figure": out / f"{name}.png",
        "page": out / f"{name}.html",
        "tables": out / f"{name}.md",
        "settings": len(records),
        "failed": sum(bool(r.failed) for r in records),
        "front, cheap to good": best,
    }


def _panel(records: Sequence[Record], case: str) -> Panel:
    mine = [r for r in records if r.case == case]
    band = next((float(r.settings["band"]) for r in mine if "band" in r.settings), None)
    return Panel(case, [_dot(r) for r in mine], {_METHOD: [_dot(r) for r in front(mine)]}, band)


def _dot(record: Record) -> Dot:
    return Dot(
        record.method, record.wall_per_simulated, counted(record), record.variant or "as it is",
        failed=bool(record.failed),
    )  # fmt: skip


def table(records: Sequence[Record]) -> tuple[list[str], list[list[Any]]]:
    """Head and rows of all settings, by case and from cheap to dear; ``*`` is on the front."""
    names = list(dict.fromkeys(m["quantity"] for r in records for m in r.measures))
    head = ["case", "setting", "count", "seconds", "error", *names, "front"]
    rows = []
    for case in cases(records):
        mine = [r for r in records if r.case == case]
        best = {id(r) for r in front(mine)}
        for r in sorted(mine, key=lambda r: r.wall_per_simulated):
            values = {m["quantity"]: m["value"] for m in r.measures}
            rows.append([
                case, r.variant or "as it is", r.points, r.wall_per_simulated,
                r.failed or r.error, *(values.get(name, "") for name in names),
                "*" if id(r) in best else "",
            ])  # fmt: skip
    return head, rows


def markdown(records: Sequence[Record]) -> str:
    """The table in Markdown."""
    return markdown_table(*table(records))
