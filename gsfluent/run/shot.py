"""Everything a shot asks for, in order, resumable: the orchestrator behind ``gsfluent run``.

Each stage is looked up by the fingerprint of what goes into it and only done when that changed.
Whatever happens, ``run.json`` says so: it is written when the run ends, when it fails, and when it
is interrupted.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch

from gsfluent.choose.shot import choose_stage
from gsfluent.config import Shot
from gsfluent.errors import GsfluentError, RunError
from gsfluent.plan.fact import seconds_left
from gsfluent.plan.in_run import foresee_run, judge_plan
from gsfluent.progress import LineReporter, Reporter, heard_warnings, heartbeat
from gsfluent.results.behind import Behind
from gsfluent.results.lock import locked
from gsfluent.results.record import RunRecord
from gsfluent.results.store import StageResult, StageStore
from gsfluent.run.report import REPORT, write_report
from gsfluent.stages.chain import run_stages
from gsfluent.stages.check import check_shot
from gsfluent.stages.context import RunContext
from gsfluent.stages.findings import THIN

_log = logging.getLogger(__name__)

Aside = Callable[[RunContext], dict[str, Any]]


def run_shot(
    shot: Shot,
    out: Path,
    *,
    device: torch.device | str = "cpu",
    seed: int = 0,
    force: bool = False,
    reporter: Reporter | None = None,
    before: StageResult | None = None,
    aside: Aside | None = None,
    facts: Mapping[str, Any] | None = None,
    plan: bool = True,
    unlock: bool = False,
    shared: Path | None = None,
    solids_seed: int | None = None,
    report: bool = True,
) -> dict[str, Any]:
    """Run a shot into a folder.

    Args:
        shot: What to do, see :mod:`gsfluent.config`.
        out: Folder for the results; made when missing.
        device: Where the heavy work runs.
        seed: Seed of everything random.
        force: Redo finished stages.
        reporter: Receives progress; log lines by default.
        before: A stage done already, to stand first in ``run.json``.
        aside: Called when the solids are there, in a thread beside the stages that follow; what it
            returns is added to ``run.json``.
        facts: What is known before and belongs into ``run.json``.
        plan: Plan the run first, and put plan and fact beside each other into ``run.json``.
        unlock: Take the folder although a run on another machine has not given it back.
        shared: Folder of solids that many runs share, see
            :class:`gsfluent.results.store.StageStore`.
        solids_seed: Seed of the solids, so that runs with other seeds share them; ``seed`` when
            absent.
        report: Leave ``report.html``.

    Returns:
        The content of ``run.json``.

    Raises:
        InputError: The shot or a file it names is wrong.
        RunError: A stage failed; finished stages are kept. Or another run is at work in the
            folder; nothing is touched.
        KeyboardInterrupt: Interrupted; finished stages and frames are kept.
    """
    with locked(out, unlock=unlock):
        return run_in(
            shot, out, device=device, seed=seed, force=force, reporter=reporter, before=before,
            aside=aside, facts=facts, plan=plan, shared=shared, solids_seed=solids_seed,
            report=report,
        )  # fmt: skip


def run_in(
    shot: Shot,
    out: Path,
    *,
    device: torch.device | str,
    seed: int,
    force: bool,
    reporter: Reporter | None,
    before: StageResult | None = None,
    aside: Aside | None = None,
    facts: Mapping[str, Any] | None = None,
    plan: bool = True,
    shared: Path | None = None,
    solids_seed: int | None = None,
    report: bool = True,
) -> dict[str, Any]:
    """:func:`run_shot` in a folder that is locked already."""
    device = torch.device(device)
    store = StageStore(out / "stages", force=force, shared=shared)
    if before is not None:
        store.results.append(before)
    record = RunRecord(out / "run.json", shot.resolved(), device, seed)
    record.values.update(facts or {})
    first = seed if solids_seed is None else solids_seed
    context = RunContext(shot, out, device, first, store, record, reporter or LineReporter())
    start = time.perf_counter()

    foreseen, told = None, dict[str, Any]()

    def settle(context: RunContext) -> None:
        nonlocal foreseen
        if aside is not None:
            beside.do(lambda: told.update(aside(context)))
        context.seed, store.shared = seed, None
        if choose_stage(context):  # the plan was made with other cells
            foreseen = foresee_run(context, plan=plan)

    done: dict[str, float] = {}  # shares of the stages
    begun = start

    def left() -> str:
        if foreseen is None or not store.results:
            return ""
        at = store.results[-1].name
        ended = {one.name: one.seconds for one in store.results[:-1] if not one.resumed}
        elapsed = max(time.perf_counter() - begun - sum(ended.values()), 0.0)
        planned = {name: row["seconds"] for name, row in foreseen.plan["stages"].items()}
        seconds = seconds_left(planned, ended, at, elapsed, done.get(at, 0.0))
        return "" if seconds is None else f"about {seconds:.0f} s left"

    def at_work() -> str:
        took = time.perf_counter() - start
        stage = store.results[-1].name if store.results else "plan"
        return ", ".join(said for said in (
            f"{stage}: at work", f"{took:.0f} s since the start", left()
        ) if said)  # fmt: skip

    def progressed(name: str, part: int, total: int) -> str:
        done[name] = part / total if total > 0 else 0.0
        return left()

    try:
        check_shot(shot)
        with (
            heard_warnings("gsfluent") as heard,
            heartbeat("gsfluent", at_work, adds=progressed) as watched,
            Behind(device=device, threads=1) as beside,
        ):
            context.reporter = watched(context.reporter)
            foreseen = foresee_run(context, plan=plan)
            begun = time.perf_counter()
            run_stages(context, settle)
        record.values.update(told)
        judge_plan(context, foreseen)
    except BaseException as error:
        _withdraw_film(context)
        _record_failure(record, error, store)
        if isinstance(error, KeyboardInterrupt):
            raise KeyboardInterrupt(_resume_text(error, out, store)) from error
        if isinstance(error, GsfluentError | OSError) or not isinstance(error, Exception):
            raise
        at = store.results[-1].name if store.results else "start"
        raise RunError(
            f"{at}: {type(error).__name__}: {error}",
            _kept(out, store),
            "run the same command again to go on; GSFLUENT_DEBUG=1 shows the traceback",
        ) from error
    if report:
        record.values["outputs"]["report"] = REPORT
    record.values["warnings"] = _warnings(shot, record.values, heard)
    values = record.finish(store.results)
    if report:
        write_report(out, values)
    reason = (values["simulation"] or {}).get("reason") or values["reason"].split("; ")[0]
    _log.info("%s in %.1f s: %s (%s)", out, time.perf_counter() - start, values["verdict"], reason)
    for warning in values["warnings"]:
        _log.info("  ! %s", warning)
    if values["verdict"] == "failed":
        raise RunError(
            values["reason"], _kept(out, store), "try solve.quality: hero, or softer material"
        )
    return values


def _warnings(shot: Shot, values: Mapping[str, Any], heard: list[str]) -> list[str]:
    """All that was warned of, each matter once: what was found counts, not what was foreseen."""
    notes = list((values["simulation"] or {}).get("notes") or [])
    foreseen = set((values.get("plan") or {}).get("warnings") or [])
    # of the objects the simulation has told what became of them
    bodies = (*(f"{name}: " for name in shot.objects), THIN)
    kept = [said for said in heard if not (said in foreseen and said.startswith(bodies))]
    return [*(said for said in kept if said not in notes), *notes]


def _withdraw_film(context: RunContext) -> None:
    """Leave no film of an earlier run beside the record of one that has made none.

    The render stage keeps its own; where it still holds, the next run shows it again.
    """
    for key, name in (("video", "video.mp4"), ("poster", "poster.png")):
        if key not in context.record.values["outputs"]:
            with suppress(OSError):
                (context.out / name).unlink(missing_ok=True)


def _record_failure(record: RunRecord, error: BaseException, store: StageStore) -> None:
    """Write run.json; where even that cannot be (full disk) the error still reaches the user."""
    with suppress(RunError, OSError):
        record.fail(error, store.results)


def _kept(out: Path, store: StageStore) -> str:
    done = [r.name for r in store.results if (r.folder / "stage.json").is_file()]
    return f"{out}/stages with {', '.join(done)}" if done else "nothing yet"


def _resume_text(error: KeyboardInterrupt, out: Path, store: StageStore) -> str:
    cause = str(error) or "interrupted by Ctrl-C"
    return (
        f"{cause}\n  kept: {_kept(out, store)}\n  resume: run the same command again;"
        " finished stages are not redone, nor frames but for the last seconds' work"
    )
