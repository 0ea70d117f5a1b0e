"""The plan inside a run: made before it, judged and learned from after it.

A first run takes a second's look at the machine for its plan (:mod:`gsfluent.plan.quick`). Only a
shot with a time budget, which cannot be run without, makes the probe run first. A plan that cannot
be made costs no run.
"""

from __future__ import annotations

import dataclasses
import logging
from pathlib import Path
from typing import Any

import torch

from gsfluent.errors import InputError
from gsfluent.hardware import Load
from gsfluent.plan.cost import CostModel
from gsfluent.plan.fact import compare, learn
from gsfluent.results.store import content_digest, fingerprint
from gsfluent.stages.context import RunContext
from gsfluent.stages.known import source_digest

_log = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True)
class Foresight:
    """A plan, and the model it was made with."""

    plan: dict[str, Any]  # From :func:`gsfluent.plan.plan.plan_shot`
    model: CostModel | None  # None when nothing is known of this machine
    began: Load  # How busy the machine was before


def foresee_run(context: RunContext, *, plan: bool = True) -> Foresight | None:
    """Plan a run that is about to start; a time budget is turned into cells in its shot.

    Args:
        context: The run; its ``shot`` is changed where it has a budget.
        plan: Whether a plan is wanted where the shot does not need one.

    Raises:
        InputError: The budget is too small, or the input cannot be read while there is one. Or the
            simulation would take longer than ``solve.max_hours``.
    """
    shot, device = context.shot, context.device
    chosen = None
    if shot.solve.seconds_per_frame is not None:
        chosen = _chosen(context)
        solve = dataclasses.replace(shot.solve, cells=chosen["cells"], seconds_per_frame=None)
        context.shot = shot = dataclasses.replace(shot, solve=solve)
    if not plan:
        return None
    from gsfluent.plan.plan import plan_shot

    try:
        model = CostModel.load(device) or _looked_at(device)
        made = plan_shot(shot, device=device, seed=context.seed, model=model)
    except Exception as error:  # a plan is advice: whatever is wrong, the run itself will say so
        _log.info("no plan: %s", str(error).splitlines()[0] if str(error) else type(error).__name__)
        return None
    if made["refused"]:
        raise InputError(made["refused"], made["hint"])
    if model is None:
        _log.info("plan: no times yet: this run will teach them (gsfluent plan measures them)")
    elif made["seconds"] is not None:
        _log.info("plan: %s", _in_words(made))
    for warning in made["warnings"]:
        _log.warning("%s", warning)
    section = {"calibrated": made["calibrated"], "predicted": predicted_of(made)}
    section |= {"binding": made["binding"], "warnings": made["warnings"]}
    context.record.values["plan"] = section | ({} if chosen is None else {"chosen": chosen})
    return Foresight(made, model, Load.now())


def _looked_at(device: torch.device) -> CostModel | None:
    """A first model of this machine, which is stored; None where none can be had in a second."""
    from gsfluent.plan.quick import quick_model

    model = quick_model(device)
    if model is not None:
        _log.info("this machine is new: a look of %.1f s says what work costs on it, roughly; "
                  "runs teach it, gsfluent plan measures it", model.probe_seconds)  # fmt: skip
        model.save(device)
    return model


def _in_words(plan: dict[str, Any]) -> str:
    """What a run will take, and what of it takes longest."""
    seconds = {name: row["seconds"] for name, row in plan["stages"].items()}
    longest = max(seconds, key=seconds.__getitem__)
    return (
        f"about {plan['seconds']:.3g} s in all, {seconds[longest]:.3g} s of it to {longest}; "
        f"{plan['particles']} points on {plan['cells']} cells, {plan['substeps']} steps"
    )


def predicted_of(plan: dict[str, Any]) -> dict[str, Any]:
    """What of a plan stands in ``run.json`` until there are facts."""
    names = ("dx", "particles", "substeps", "active_blocks", "seconds", "memory_bytes", "stages")
    return {name: plan[name] for name in names}


def judge_plan(context: RunContext, foreseen: Foresight | None) -> None:
    """Put the facts beside the plan, and let the cost model learn from them."""
    if foreseen is None:
        return
    values = context.record.values
    values["stages"] = [stage.summary() for stage in context.store.results]
    section = compare(foreseen.plan, values)
    values["plan"] = {**values["plan"], **section}
    try:
        crowded = foreseen.began.crowded_since()
        learn(foreseen.model, foreseen.plan, values, context.device, crowded=crowded)
    except Exception as error:  # advice again: a finished run does not fail for it
        _log.info("the run taught the plan nothing: %s: %s", type(error).__name__, error)
    took, said = section["actual"]["seconds"], section["predicted"]["seconds"]
    if said and took is not None:
        _log.info("planned %.1f s, took %.1f s", said, took)


def _chosen(context: RunContext) -> dict[str, Any]:
    """What a time budget was turned into.

    It is kept in the result folder, so that a run taken up again goes on with the cells it began
    with, whatever the model has learned since.
    """
    shot = context.shot
    digest = source_digest(shot) if shot.capture is None else content_digest(shot.capture)
    # before any stage: the source of the first one is not known yet
    key = fingerprint("budget", [context.seed, context.device.type, shot.resolved(), digest])

    def work(folder: Path) -> dict[str, Any]:
        from gsfluent.plan.plan import cost_model, plan_shot

        model = cost_model(context.device, progress=context.reporter.task("calibrate"))
        made = plan_shot(shot, device=context.device, seed=context.seed, model=model)
        _log.info("%d cells, dx = %.4g m: %s binds", made["cells"], made["dx"], made["binding"])
        return {
            "seconds_per_frame": shot.solve.seconds_per_frame,
            "predicted_seconds_per_frame": made["simulate_seconds"] / made["frames"],
            "cells": made["cells"],
            "dx": made["dx"],
            "dx_by_formula": made["budget"]["dx_by_formula"],
            "binding": made["binding"],
            "bounds": made["bounds"],
            "calibrated": model.made,
        }

    return dict(context.store.run("budget", key, work).report)
