"""A sweep of shots: solids once, then every shot in a process, then table and contact sheet."""

from __future__ import annotations

import json
import logging
import os
import shutil
from collections import Counter
from pathlib import Path
from typing import Any

import torch

from gsfluent.errors import InputError, RunError
from gsfluent.hardware import graphics_cards, part_of_gpu
from gsfluent.io import atomic_path
from gsfluent.io.checked.files import read_json
from gsfluent.plan.cost import CostModel
from gsfluent.plan.plan import plan_shot
from gsfluent.progress import Reporter
from gsfluent.run.shot import run_shot
from gsfluent.stages.solids import context_of, make_solids
from gsfluent.sweep.bucket import SweepBucket, opened
from gsfluent.sweep.engine import Outcome, map
from gsfluent.sweep.folder import SweepFolder
from gsfluent.sweep.pool import environment
from gsfluent.sweep.table import write_sheet, write_table
from gsfluent.sweep.tasks import Sweep, Task, tasks_of

_log = logging.getLogger(__name__)
_PLANNED = 5
_LOOKED_AT = 100
REFUSED = "refused"
"""Verdict of a shot whose input cannot be."""


def run_sweep(
    sweep: Sweep,
    out: str | Path,
    *,
    device: torch.device,
    seed: int = 0,
    jobs: int | None = None,
    retry: bool = False,
    on: str = "local",
    reporter: Reporter,
) -> dict[str, Any]:
    """Run every shot of a sweep that is not done yet.

    Args:
        sweep: What differs.
        out: Folder of the results, made when missing. Or ``s3://BUCKET/PLACE`` for shots, table
            and failures; solids are then made once on every machine, and stay there.
        device: Where the work is done.
        seed: Of the draws, of the solids, and of shots that have none of their own.
        jobs: Shots at a time; as many as there are cores for when absent.
        retry: Try again what has failed.
        on: See :func:`gsfluent.sweep.map`.
        reporter: Receives progress.

    Returns:
        Counts, and the files that were written.

    Raises:
        InputError: A shot cannot be; nothing has begun.
        KeyboardInterrupt: With what is kept.
    """
    place = opened(out)
    tasks = tasks_of(
        sweep, place.root, device=device.type, seed=seed, progress=reporter.task("look")
    )
    place.make()
    each = sweep.each
    if jobs is None and not on.startswith("ray"):  # which knows the processors of its machines
        jobs = max((os.cpu_count() or 1) // each.cpus, 1)
    done = place.done()
    gpu = 0.0
    if device.type == "cuda":
        gpu = each.gpu or _part(device, place, [task for task in tasks if task.id not in done])
    settings: dict[str, Any] = {"jobs": jobs, "threads": each.cpus, "on": on, "retry": retry}
    settings["gpu"] = gpu
    first = {task.solids: task for task in tasks if task.id not in done}
    alone = None if device.index is None else graphics_cards()[device.index]
    with environment({} if alone is None else {"CUDA_VISIBLE_DEVICES": alone}):
        # before all others, so that none of them waits for what another makes
        map(
            make_shared_solids, first.values(), f"{place.address}/solids", ids=list(first),
            tries=each.tries, progress=reporter.task("solids"), **settings,
        )  # fmt: skip
        outcomes = map(
            run_task, tasks, place.address, ids=[task.id for task in tasks], tries=each.tries,
            minutes=each.minutes, progress=reporter.task("shots"), **settings,
        )  # fmt: skip
    return _summary(place, tasks, outcomes)


def _part(device: torch.device, place: SweepFolder, left: list[Task]) -> float:
    """Part of a GPU that a shot takes: by the peaks of shots that are done, else by a few plans."""
    rows = place.rows(sorted(place.done())[:_LOOKED_AT]).values()
    peaks = [row["value"]["figures"].get("peak_device_memory_bytes") or 0 for row in rows]
    if not any(peaks):
        model = CostModel.load(device)
        plans = [plan_shot(t.shot(), device=device, seed=t.seed, model=model) for t in _some(left)]
        peaks = [plan["memory_bytes"] for plan in plans]
    total = torch.cuda.get_device_properties(device).total_memory
    part = part_of_gpu(max(peaks, default=0), total)
    _log.info("%d shots share a GPU: one takes %.2g GB", int(1 / part), max(peaks, default=0) / 1e9)
    return part


def _some(tasks: list[Task]) -> list[Task]:
    """A few of many, from the first to the last."""
    return tasks[:: max(len(tasks) // _PLANNED, 1)][:_PLANNED]


def make_shared_solids(task: Task, folder: Path) -> dict[str, Any]:
    """Make the solids of a shot, where all shots of a sweep find them."""
    common = task.common
    torch.manual_seed(common.solids_seed)
    context = context_of(task.shot(), folder, common.device, common.solids_seed)
    context.store.shared = common.shared
    try:
        make_solids(context)
    except InputError as error:  # every shot with these solids will say so
        return {"refused": str(error)}
    shutil.rmtree(folder / "stages")  # they lie among the shared ones
    return {}


def run_task(task: Task, folder: Path) -> dict[str, Any]:
    """Run a shot of a sweep; returns its line of the table.

    Raises:
        RunError: A stage failed otherwise than by the verdict on its simulation.
    """
    common = task.common
    torch.manual_seed(task.seed)
    reason = ""
    try:
        run_shot(
            task.shot(), folder, device=common.device, seed=task.seed, plan=False,
            shared=common.shared, solids_seed=common.solids_seed,
            facts={"sweep": {"changes": task.changes, "solids_seed": common.solids_seed}},
            report=False,  # half a second of a processor; `gsfluent report` makes it of any
        )  # fmt: skip
    except InputError as error:
        reason = str(error)
    except RunError:
        simulation = read_json(folder / "run.json").get("simulation") or {}
        if simulation.get("verdict") != "failed":
            raise
    if common.keep == "film":
        shutil.rmtree(folder / "stages", ignore_errors=True)
    line = {
        "index": task.index,
        "seed": task.seed,
        "object": task.object,
        "changes": task.changes,
    }
    if reason:
        return line | {"verdict": REFUSED, "reason": reason, "figures": {}}
    record = read_json(folder / "run.json")
    return line | {
        "verdict": record["verdict"],
        "reason": record["reason"],
        "figures": figures_of(record),
    }


_OF_SIMULATION = (
    "frames", "substeps", "rollbacks", "dx", "particles", "momentum_error", "guarded_points",
)  # fmt: skip
_AT_THE_END = (
    "fragments", "fragments_over_3_percent", "largest_fragment", "pieces", "pieces_over_1_percent",
    "broken_fraction", "loose_fraction", "kinetic", "dissipated",
)  # fmt: skip


def figures_of(record: dict[str, Any]) -> dict[str, Any]:
    """Figures of a ``run.json`` that stand in a table: of the simulation, and of its last frame."""
    simulation = record.get("simulation") or {}
    frames = simulation.get("per_frame") or {}
    found = {name: simulation.get(name) for name in _OF_SIMULATION}
    found |= {name: frames[name][-1] for name in _AT_THE_END if frames.get(name)}
    stages = [stage for stage in record["stages"] if not stage["resumed"]]
    found["stage_seconds"] = sum(stage["seconds"] for stage in stages)
    for name in ("peak_memory_bytes", "peak_device_memory_bytes"):
        found[name] = max((s.get(name) or 0 for s in stages), default=0)
    return found


def _summary(place: SweepFolder, tasks: list[Task], outcomes: list[Outcome]) -> dict[str, Any]:
    """Write table, sheet and failures; say what came out."""
    out = place.root
    failures = [outcome.failure for outcome in outcomes if outcome.failure is not None]
    with atomic_path(out / "failures.jsonl") as part:
        part.write_text("".join(json.dumps(failure) + "\n" for failure in failures))
    done = [outcome for outcome in outcomes if outcome.failure is None]
    tables = write_table(out, done)
    sheet = {}
    if isinstance(place, SweepBucket):
        place.leave([*tables, out / "failures.jsonl"])
    else:  # a page needs its pictures beside it
        sheet = {"sheet": str(write_sheet(out, done, failures))}
    verdicts = Counter(str(outcome.value["verdict"]) for outcome in done)
    for failure in failures[:5]:
        _log.warning("%s failed: %s", failure["id"], str(failure["message"]).splitlines()[0])
    return {
        "ok": not failures,
        "shots": len(tasks),
        "solids": len({task.solids for task in tasks}),
        "verdicts": dict(verdicts),
        "failed": len(failures),
        "out": str(place.address),
        "tables": [f"{place.address}/{path.name}" for path in tables],
        **sheet,
        "failures": f"{place.address}/failures.jsonl",
    }


def plan_sweep(
    sweep: Sweep, out: str | Path, *, device: torch.device, seed: int = 0, jobs: int | None = None
) -> dict[str, Any]:
    """What a sweep will cost, by the plans of a few of its shots.

    Returns:
        ``shots``, ``solids``, ``done``, ``planned`` (how many were), ``jobs``, ``hours`` (None
        where this machine has not been measured) and ``memory_bytes`` of all jobs together.

    Raises:
        InputError: A shot cannot be.
    """
    place = opened(out)
    tasks = tasks_of(sweep, place.root, device=device.type, seed=seed)
    jobs = jobs or max((os.cpu_count() or 1) // sweep.each.cpus, 1)
    done = place.done()
    left = [task for task in tasks if task.id not in done]
    some = _some(left)
    model = CostModel.load(device)
    plans = [plan_shot(task.shot(), device=device, seed=task.seed, model=model) for task in some]
    solids = len({task.solids for task in left})
    hours: float | None = 0.0
    for plan in plans:
        if plan["seconds"] is None or hours is None:
            hours = None
            continue
        moved = sum(plan["stages"][name]["seconds"] for name in _MOVED if name in plan["stages"])
        seconds = moved * len(left) + (plan["seconds"] - moved) * solids
        hours += seconds / len(plans) / min(jobs, len(left)) / 3600.0
    return {
        "shots": len(tasks),
        "done": len(tasks) - len(left),
        "solids": solids,
        "planned": len(plans),
        "jobs": jobs,
        "hours": hours,
        "memory_bytes": max((plan["memory_bytes"] for plan in plans), default=0) * jobs,
    }


_MOVED = ("simulate", "render", "export")
