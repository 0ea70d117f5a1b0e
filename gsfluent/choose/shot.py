"""A shot's solids for the probes, and what the choice leaves: ``chart.json`` and ``chart.png``."""

from __future__ import annotations

import dataclasses
import logging
import math
from pathlib import Path
from typing import Any

import torch

from gsfluent.choose.choose import Probing, choose
from gsfluent.config import Shot
from gsfluent.errors import InputError, MissingPackage
from gsfluent.io import write_json
from gsfluent.plan.proxy import proxy
from gsfluent.progress import LineReporter, Reporter
from gsfluent.results.lock import locked
from gsfluent.results.store import publish
from gsfluent.scene.scene import Scene
from gsfluent.stages.context import RunContext
from gsfluent.stages.simulate import build_scene, moving_settings
from gsfluent.stages.solids import context_of, load_solids, make_solids

_log = logging.getLogger(__name__)
FILE, PICTURE = "chart.json", "chart.png"


def chart_shot(
    shot: Shot,
    bound: float,
    out: Path,
    *,
    probing: Probing | None = None,
    device: torch.device | str = "cpu",
    seed: int = 0,
    reporter: Reporter | None = None,
) -> dict[str, Any]:
    """Choose the cheapest setting that meets an error on a shot.

    Args:
        shot: The shot.
        bound: Largest error, a share.
        out: Folder for ``chart.json`` and ``chart.png``. If it is the folder of a run, the solids
            of its finished stages are probed; else a proxy of the right size.
        probing: How to probe.
        device: Where to compute.
        seed: Seed of everything random.
        reporter: Receives progress; log lines by default.

    Returns:
        The content of ``chart.json``; keys in docs/theory/plan.md.

    Raises:
        InputError: The shot is wrong, or a probe broke off.
    """
    device, reporter = torch.device(device), reporter or LineReporter()
    scene, solid = shot_scene(shot, out, device=device, seed=seed, reporter=reporter)
    result = choose(
        scene, shot, bound, probing=probing, device=device, seed=seed,
        progress=reporter.task("chart"),
    )  # fmt: skip
    result["solid"] = solid
    out.mkdir(parents=True, exist_ok=True)
    drawn = _write(result, out)
    result["outputs"] = {"chart": str(out / FILE)}
    if drawn:
        result["outputs"]["picture"] = str(out / PICTURE)
    return result


def shot_scene(
    shot: Shot,
    out: Path,
    *,
    device: torch.device,
    seed: int = 0,
    reporter: Reporter | None = None,
    make: bool = False,
) -> tuple[Scene, str]:
    """The scene of a shot and what its solids are.

    Args:
        shot: The shot.
        out: Folder of a run; its finished stages are taken up.
        device: Where to compute.
        seed: Seed of everything random.
        reporter: Receives progress; log lines by default.
        make: Do the stages up to the solids where they are not there, instead of a proxy.

    Raises:
        InputError: The shot is wrong.
    """
    if make or (out / "stages" / "texture" / "stage.json").is_file():
        context = context_of(shot, out, device, seed, reporter)
        with locked(out):
            make_solids(context)
        return build_scene(shot, load_solids(context), context.frame), f"the stages in {out}"
    warnings: list[str] = []
    found = proxy(shot, warnings)
    for warning in warnings:
        _log.warning("chart: %s", warning)
    return build_scene(shot, dict(found.solids), found.frame), found.assumed


def _write(result: dict[str, Any], folder: Path) -> bool:
    """Write the choice and draw it; whether it could be drawn."""
    from gsfluent.figure.choice import draw_choice

    write_json(folder / FILE, result)
    try:
        draw_choice(result, folder / PICTURE)
    except MissingPackage as missing:  # the choice is worth having without its picture
        _log.warning("%s is not drawn: %s", PICTURE, missing)
        return False
    return True


def readable(result: dict[str, Any]) -> dict[str, Any]:
    """``chart.json`` for a person: a line per setting worth its time, shares as percentages."""
    chosen = result["chosen"]
    taken = "none meets it" if chosen is None else _words(chosen)
    if chosen is None and result["enough"] is not None:
        taken += f"; {_words(result['enough'])} is as fine as chance lets be seen"
    probe = result["probe"]
    return {
        "asked for": f"{result['bound']:.1%}",
        "chosen": taken,
        "sure": f"{result['sure']:.0%}",
        "reason": result["reason"],
        "settings": [
            {
                "cells": s["cells"],
                "cfl": s["cfl"],
                "seconds": s["seconds"],
                "error": f"{s['error']:.1%}",
                "5 % to 95 %": f"{s['low']:.1%} to {s['high']:.1%}",
                "sure": f"{s['sure']:.0%}",
                "worst": s["worst"],
            }
            for s in _front(result["settings"])
        ],
        "observables": [
            {
                "seen": o["name"],
                "order": o["order"],
                f"error at {probe['cells'][-1]} cells": f"{o['error_finest']:.1%}",
                "run to run": f"{o['band']:.1%}",
                "growth": o["growth"],
                "settles": o["asymptotic"],
            }
            for o in result["observables"]
        ],
        "probed": (
            f"{probe['cells']} cells, {probe['seeds']} seeds, frames {probe['frames'][0]} to "
            f"{probe['frames'][1] - 1} of {probe['of_frames']}, in {probe['seconds']:.0f} s; "
            f"solid: {result['solid']}"
        ),
        "seconds from": result["seconds_from"],
        "outputs": result["outputs"],
    }


def _front(settings: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Settings that no cheaper one equals."""
    best, found = math.inf, []
    for setting in settings:  # cheapest first
        if setting["error"] < best:
            best = setting["error"]
            found.append(setting)
    return found


def _words(setting: dict[str, Any]) -> str:
    return (
        f"{setting['cells']} cells, cfl {setting['cfl']:g}: error {setting['error']:.1%}, "
        f"{setting['seconds']:.3g} s"
    )


def choose_stage(context: RunContext) -> bool:
    """``solve: {error: ...}``: put the chosen cells and step in place of the bound.

    Where chance alone is larger than the bound, the setting beyond which finer cells change less
    than chance does is taken, with a warning; ``run.json`` says so under ``choice``.

    Returns:
        Whether there was something to choose.

    Raises:
        InputError: No setting meets the bound, and it is not for chance.
    """
    shot = context.shot
    if shot.solve.error is None:
        return False
    bound = shot.solve.error

    def work(folder: Path) -> dict[str, Any]:
        scene = build_scene(shot, load_solids(context), context.frame)
        result = choose(
            scene, shot, bound, device=context.device, seed=context.seed,
            progress=context.reporter.task("choose"),
        )  # fmt: skip
        _write(result, folder)
        return result

    result = context.do("choose", work, moving_settings(shot), bound, hands_on=False)
    publish(result, FILE, context.out / FILE)
    if (result.folder / PICTURE).is_file():
        publish(result, PICTURE, context.out / PICTURE)
        context.record.values["outputs"]["chart"] = PICTURE
    found = result.report
    context.record.values["choice"] = {k: v for k, v in found.items() if k != "settings"}
    chosen = found["chosen"]
    if chosen is None and found["floor"] > bound:
        chosen = found["enough"]
    if chosen is None:
        least = found["within"]
        hint = "set solve.quality or solve.cells instead"
        if least is not None:
            hint = f"the least that can be promised is solve.error: {least:.1%}; or {hint[4:]}"
        raise InputError(f"solve.error {bound:.3g} cannot be met: {found['reason']}", hint)
    if found["chosen"] is None:
        _log.warning("solve.error: %s; taken: %d cells", found["reason"], chosen["cells"])
    solve = dataclasses.replace(
        shot.solve, error=None, cells=int(chosen["cells"]), cfl=float(chosen["cfl"])
    )
    context.shot = dataclasses.replace(shot, solve=solve)
    return True
