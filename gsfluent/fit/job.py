"""A shot and what was seen of its motion, to ``fit.json``, ``fitted.yaml`` and a page.

Searches go through :func:`gsfluent.sweep.map`: in processes, each once, taken up again.
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch
import yaml

from gsfluent.choose.shot import shot_scene
from gsfluent.config import Shot
from gsfluent.errors import InputError, MissingPackage
from gsfluent.figure.page import Page
from gsfluent.figure.series import Panel, curves
from gsfluent.fit.read import read_target
from gsfluent.io import atomic_path, write_json
from gsfluent.pipeline.fit import Fit, Found, Task, run_task
from gsfluent.progress import LineReporter, Reporter
from gsfluent.results.store import content_digest, fingerprint
from gsfluent.sweep.engine import map as sweep_map
from gsfluent.sweep.engine import required

FILES = {"fit": "fit.json", "shot": "fitted.yaml", "report": "fit.html"}


def fit_to(
    shot: Shot,
    out: Path,
    learn: Sequence[str],
    *,
    points: Path | None = None,
    clouds: Path | None = None,
    force: Path | None = None,
    sigma: float | None = None,
    fps: float | None = None,
    starts: int = 4,
    cells: int = 8,
    grids: int = 2,
    jobs: int | None = None,
    on: str = "local",
    seed: int = 0,
    device: torch.device | str = "cpu",
    reporter: Reporter | None = None,
) -> dict[str, Any]:
    """Learn numbers of a shot from what was seen.

    Args:
        shot: Where the search starts, and what is believed.
        out: Folder for the results.
        learn: ``OBJECT.NUMBER`` each.
        points: Tracks (see :func:`gsfluent.fit.read.read_target`); or
        clouds: a cloud per frame; or
        force: a table of displacement and force.
        sigma: Standard deviation of what was seen [m, N].
        fps: Frames per second of files without times.
        starts: How many, see :class:`gsfluent.pipeline.Fit`.
        cells: Along the longest side of the largest body.
        grids: 1 or 2.
        seed: Of the starts, and of solids.
        jobs: Searches at a time.
        on: Where searches run, see :func:`gsfluent.sweep.map`.
        device: Where solids are made; the searches are done on the CPU, in float64.
        reporter: Told of the progress.

    Returns:
        The content of ``fit.json``.

    Raises:
        InputError: A file or a name is wrong.
        RunError: No search could be done.
        KeyboardInterrupt: The same command goes on.
    """
    reporter = reporter or LineReporter()
    given = {"points": points, "clouds": clouds, "force": force}
    named = {kind: path for kind, path in given.items() if path is not None}
    if len(named) != 1:
        got = " and ".join(f"--{kind}" for kind in named) or "none"
        raise InputError(f"fit: needs one of --points, --clouds and --force, got {got}", "give one")
    ((kind, path),) = named.items()
    target = read_target(kind, path, sigma=sigma, fps=fps, shot=shot)
    scene, _ = shot_scene(
        shot, out, device=torch.device(device), seed=seed, reporter=reporter, make=True
    )
    base = fingerprint(shot.resolved(), list(learn), kind, content_digest(path), sigma, fps, seed)
    runner = functools.partial(_through_sweep, out / "search", base, jobs, on)
    stage = Fit(list(learn), starts=starts, cells=cells, grids=grids, seed=seed, runner=runner)
    found = stage(scene, target, progress=reporter.task("fit"))
    values = {"target": kind, **found.report, "outputs": dict(FILES)}
    write_json(out / FILES["fit"], values)
    with atomic_path(out / FILES["shot"]) as part:
        part.write_text(yaml.safe_dump(fitted(shot, found), sort_keys=False), encoding="utf-8")
    page(out, values, target.times).write(out / FILES["report"])
    return values


def search_task(task: Task, folder: Path) -> dict[str, Any]:
    """One search, as a task of a sweep."""
    return run_task(task)


def _through_sweep(
    folder: Path,
    base: str,
    jobs: int | None,
    on: str,
    function: Callable[[Any], Any],
    items: Iterable[Task],
) -> list[dict[str, Any]]:
    """Do searches, each once; those of another shot or target have other names."""
    tasks = list(items)
    ids = [fingerprint(base, t.start, t.dx, list(t.shares), t.grids) for t in tasks]
    unlike = dict(zip(ids, tasks, strict=True))
    outcomes = sweep_map(
        search_task, unlike.values(), folder, ids=list(unlike), jobs=jobs, on=on, retry=True
    )
    done = {o.id: o.value for o in required(outcomes, "searches failed", folder)}
    return [done[name] for name in ids]


def fitted(shot: Shot, found: Found) -> dict[str, Any]:
    """The shot with what was learnt; what was not identified stays as it was."""
    values = copy.deepcopy(shot.resolved())
    thrown: dict[str, dict[str, Any]] = {}
    for key, value in found.values.items():
        name, _, field = key.partition(".")
        if name not in values["objects"] or key in found.unidentified:
            continue
        if field in ("velocity", "angular_velocity"):
            event = thrown.setdefault(name, {"type": "throw", "object": name})
            event["velocity" if field == "velocity" else "spin"] = value
        else:
            values["objects"][name][field] = value
    for body in found.scene.bodies:
        if body.name in thrown:  # the event says both
            thrown[body.name].setdefault("velocity", list(body.velocity))
            thrown[body.name].setdefault("spin", list(body.angular_velocity))
    kept = [e for e in values["events"] if e["type"] != "throw" or e.get("at") or not thrown]
    values["events"] = [*kept, *thrown.values()]
    return values


def page(out: Path, values: Mapping[str, Any], times: Sequence[float]) -> Page:
    """The page of a fit."""
    made = Page(out.resolve().name, f"learnt from {values['target']}")
    rows = []
    for key, number in values["parameters"].items():
        bound = values["unidentified"].get(key)
        shown = f"unidentified: {bound}" if bound else _shown(number["value"])
        share = f"{number['prior_share']:.0%}"
        rows.append([key, shown, _shown(number["sd"]), _shown(number["grid"]), share])
    made.heading("Found")
    made.table(["number", "value", "sd", "of the grid", "prior's share"], rows)
    for heading, items in (
        ("Warnings", values["warnings"]),
        ("Least informed", values["least_informed"]),
        ("Correlated", [f"{a} and {b}: {c:.2f}" for a, b, c in values["correlated"]]),
    ):
        if items:
            made.heading(heading).listing(items)
    series = {"residual": list(values["per_frame"])}
    with suppress(MissingPackage):  # of the extra `figures`
        drawn = curves(list(times), "t [s]", [Panel("root mean square residual", "sd", series)])
        made.heading("Residual by frame").svg(drawn)
    return made


def _shown(value: Any) -> str:
    return ", ".join(f"{v:.4g}" for v in (value if isinstance(value, list) else [value]))
