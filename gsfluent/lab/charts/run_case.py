"""From a setting to a record: one sampled run for the error, uninterrupted ones for the time."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import statistics
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsfluent.fracturebench.registry import find
from gsfluent.fracturebench.run import Run
from gsfluent.fracturebench.scene import Scene, SceneError
from gsfluent.fracturebench.scenes.shatter import reference
from gsfluent.fracturebench.statistics import distance, jitter
from gsfluent.lab.charts.carried_splats import CarriedSplats
from gsfluent.lab.charts.ladder import TEXTBOOK, Setting
from gsfluent.lab.charts.record import Record, commit, machine, now, of_run
from gsfluent.lab.frozen.answer import clock, run_case
from gsfluent.lab.world.driver import World

MASS = "mass over pieces, KS"
_SEEDS = 3
"""Runs of a fracture case, moved on the grid; their median error counts."""
_ENOUGH = 6.0
"""Seconds that a setting is timed at least before fewer repeats than asked for have to do."""
Runner = Callable[[Scene], Run]


def measure(setting: Setting, device: str, repeat: int = 3) -> Record:
    """Run a setting and judge it.

    The error is that of a run that stops at every time the case asks for. The times are those of
    runs that go straight to the last one: what a stop costs is the reader's, not the method's. (The
    textbook solver's own steps cost as much as a stop: its time is that of the judged run.)

    Returns:
        The record; a run that raises or runs out of memory is one that failed.
    """
    case = find(setting.case)
    scene: Scene = case.build(setting.dx, setting.ppc)
    seeds = _SEEDS if case.name == "shatter" else 1
    options = dict(setting.options)
    facts: dict[str, Any] = {"knob": setting.knob}
    if not setting.trades:
        facts["trades"] = False
    threads = options.pop("threads", None)
    if "courant" in options:
        options["dt"] = even_dt(scene, options.pop("courant"))
    if "dtype" in options:
        options["dtype"] = getattr(torch, options["dtype"])
    with _threads(threads):
        if not device.startswith("cuda"):
            facts["threads"] = torch.get_num_threads()
        try:
            runs, wall, steps, more = _runs(setting, scene, device, options, repeat, seeds)
            if seeds > 1:
                more["band"] = _band()
            return of_run(
                case, scene, runs, variant=setting.variant, wall=wall, steps=steps, **facts, **more
            )
        except (ArithmeticError, RuntimeError, ValueError, MemoryError) as error:
            return broken(
                setting, device, error, kind=case.kind, points=scene.count, seconds=scene.seconds,
                **facts,
            )  # fmt: skip


def _band() -> float:
    """Run-to-run band of the first measure of ``shatter``."""
    runs = reference()
    return distance(runs, runs[:1])[MASS].band


def _moved(runner: Runner, scene: Scene, seed: int) -> Run:
    """A run of the scene somewhere else on the grid, brought back."""
    there = jitter(scene, seed)
    run = runner(there)
    shift = np.asarray(there.facts.get("shift", (0.0, 0.0, 0.0)))
    return dataclasses.replace(run, x=run.x - shift)


def even_dt(scene: Scene, courant: float) -> float:
    """Largest time step [s] of at most this c dt / dx that meets the times of a scene exactly.

    With another one the solver, which takes whole fixed steps, would be looked at up to half a step
    beside the times that are asked for.
    """
    interval = float(np.diff(scene.times, prepend=0.0).min())
    return interval / math.ceil(interval * scene.wave_speed / (courant * scene.dx))


def _runs(
    setting: Setting, scene: Scene, device: str, options: dict[str, Any], repeat: int, seeds: int
) -> tuple[list[Run], list[float], int, dict[str, Any]]:
    """The judged runs, the times, the steps of a timed run, and facts."""
    below = scene
    more: dict[str, Any] = {}
    splats = None
    if (carried_by := options.pop("carried_by", None)) is not None:
        below = find(setting.case).build(setting.dx, carried_by)
        splats = CarriedSplats(scene, below, device)
        options["deformation"] = True
        more = {"gaussians": scene.count, "points": below.count}
    runner = _runner(setting, device, options)
    if setting.method == TEXTBOOK:  # once, for the kernels of PyTorch to be loaded
        runner(dataclasses.replace(below, times=below.times[:1]))
    run = runner(below) if splats is None else runner(below, watch=splats.watch)
    runs = [run if splats is None else splats.run(run)]
    runs += [_moved(runner, below, seed) for seed in range(1, seeds)]
    last = dataclasses.replace(below, times=below.times[-1:])
    carried = 0.0 if splats is None else float(np.median(splats.seconds)) * scene.times.shape[0]
    steps = run.steps
    wall: list[float] = []
    if run.failed or setting.method == TEXTBOOK:  # its steps are the host's: a stop costs nothing
        return runs, [run.wall_seconds], run.steps, more
    if device.startswith("cuda"):
        runner(last)  # a graph of this length; on a CPU the judged run has warmed everything
    while len(wall) < repeat and (not wall or sum(wall) < _ENOUGH):
        timed = runner(last)
        steps = timed.steps
        wall.append(timed.wall_seconds + carried)
    return runs, wall, steps, more


def _runner(setting: Setting, device: str, options: dict[str, Any]) -> Callable[..., Run]:
    seed = options.pop("shuffle", None)
    single = options.pop("single_steps", False)
    if setting.method == TEXTBOOK:
        from gsfluent.lab.textbook.solver import run_textbook

        return lambda scene: run_textbook(scene, device=device, **options)

    def run(scene: Scene, **more: Any) -> Run:
        with stepwise(single):
            return run_case(scene, device=device, **options, **more)

    return run if seed is None else lambda scene, **more: shuffled(scene, run, seed)


def shuffled(scene: Scene, run: Runner, seed: int) -> Run:
    """Run a scene with its points in another order; the run that comes back has the scene's own."""
    order = np.random.default_rng(seed).permutation(scene.count)
    back = np.argsort(order)
    mixed = {
        name: getattr(scene, name)[order]
        for name in ("x", "v", "volume", "material", "body", "affine")
    }
    drives = tuple(
        {**drive, "points": back[np.asarray(drive["points"], int)].tolist()}
        for drive in scene.drives
    )
    done = run(dataclasses.replace(scene, **mixed, drives=drives))
    kept: dict[str, Any] = {"x": done.x[:, back], "v": done.v[:, back]}
    for name in ("damage", "stress"):
        if (value := getattr(done, name)) is not None:
            kept[name] = value[:, back]
    return dataclasses.replace(done, **kept)


@contextlib.contextmanager
def stepwise(single: bool) -> Iterator[None]:
    """Let every World take its steps in calls of their own."""
    if not single:
        yield
        return
    whole = World.run

    def each(self: World, seconds: float | None = None, steps: int | None = None,
             each: Callable[[World], None] | None = None) -> World:  # fmt: skip
        return whole(self, seconds, steps, each or (lambda world: None))

    World.run = each  # type: ignore[method-assign]
    try:
        yield
    finally:
        World.run = whole  # type: ignore[method-assign]


@contextlib.contextmanager
def _threads(count: int | None) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(count or before)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def broken(
    setting: Setting,
    device: str,
    error: BaseException,
    *,
    kind: str,
    points: int,
    seconds: float,
    **facts: Any,
) -> Record:
    """The record of a setting that raised."""
    words = f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}"
    return Record(
        case=setting.case, kind=kind, method=setting.method, variant=setting.variant,
        settings={"dx": setting.dx, "ppc": setting.ppc, **facts}, device=device,
        machine=machine(device), points=points, steps=0, simulated_seconds=seconds, wall_seconds=[],
        wall_per_simulated=math.inf, ns_per_point_step=math.inf, error=math.inf,
        failed=words.rstrip(": "), commit=commit(), date=now(),
    )  # fmt: skip


ANSWER = "run.npz"
"""What :func:`answer_task` writes."""


@dataclasses.dataclass(frozen=True)
class Question:
    """A frozen scene of FractureBench, and how it is answered."""

    case: str  # name of the case
    ppc: int  # points per cell
    sha256: str  # of the scene
    device: str  # where
    dtype: str  # float32 or float64
    cfl: float  # Courant number
    place: float  # how far points lie off their place on the grid [dx]
    fields: bool  # a velocity field per body
    method: str  # name in the table
    repeat: int  # timed runs
    law: str = "nacc"  # of what breaks
    contact: str = "nodes"  # what colliders and other bodies push


def answer_task(question: Question, folder: Path) -> None:
    """Answer a scene by a file, as a task of a sweep; its time is that of runs without a stop.

    Raises:
        SceneError: Another scene is built here than was frozen.
    """
    case = find(question.case)
    scene = case.build(case.dx, question.ppc)
    if scene.digest() != question.sha256:
        raise SceneError(f"{question.case}: not what was frozen, by its sha256")
    options: dict[str, Any] = {
        "device": question.device, "dtype": getattr(torch, question.dtype), "cfl": question.cfl,
        "fields": question.fields, "place": question.place, "law": question.law,
        "contact": question.contact,
    }  # fmt: skip
    run = run_case(scene, method=question.method, **options)
    wall = run.wall_seconds
    if not run.failed:
        wall = statistics.median(clock(scene, question.repeat, **options))
    settings = {
        **run.settings, "timing": "uninterrupted", "repeat": question.repeat,
        "machine": machine(question.device), "commit": commit(), "sha256": question.sha256,
    }  # fmt: skip
    dataclasses.replace(run, wall_seconds=wall, settings=settings).save(folder / ANSWER)
