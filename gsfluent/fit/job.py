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
from gsfluent.fit.read import read_masks, read_target
from gsfluent.io import atomic_path, write_json
from gsfluent.materials.laws import HANDBOOK, PARAMETERS
from gsfluent.materials.material import Material
from gsfluent.pipeline.fit import Fit, Found, Task, plain, run_task
from gsfluent.pipeline.matter.points import body_frame
from gsfluent.progress import LineReporter, Reporter
from gsfluent.results.store import content_digest, fingerprint
from gsfluent.scene.scene import Part
from gsfluent.sweep.engine import map as sweep_map
from gsfluent.sweep.engine import required
from gsfluent.targets.target import Target

FILES = {"fit": "fit.json", "shot": "fitted.yaml", "report": "fit.html"}
UNSEEN = {key: FILES[key] for key in ("fit", "shot")}
"""Of a fit to no motion, which has no curves to show."""


def fit_to(
    shot: Shot,
    out: Path,
    learn: Sequence[str] = (),
    *,
    laws: Sequence[str] = (),
    points: Path | None = None,
    clouds: Path | None = None,
    force: Path | None = None,
    masks: Path | None = None,
    cameras: Path | None = None,
    colors: bool = False,
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
        learn: ``OBJECT.NUMBER`` or ``OBJECT/PART.NUMBER`` each.
        laws: Tried for every object and part, see :class:`gsfluent.pipeline.Fit`.
        points: Tracks (see :func:`gsfluent.fit.read.read_target`); or
        clouds: a cloud per frame; or
        force: a table of displacement and force; or
        masks: films of masks, with
        cameras: their cameras (see :func:`gsfluent.fit.read.read_masks`), in the frame of the
            splats of the first object, where it is in frame 0.
        colors: Of masks: their pictures have the object's colours, which count at the end.
        sigma: Standard deviation of what was seen [m, N, none].
        fps: Frames per second of files without times.
        starts: How many, see :class:`gsfluent.pipeline.Fit`.
        cells: Along the longest side of the largest body.
        grids: 1 or 2.
        seed: Of the starts, and of solids.
        jobs: Searches at a time.
        on: Where searches run, see :func:`gsfluent.sweep.map`.
        device: Where solids are made and the solver runs, in float64.
        reporter: Told of the progress.

    Returns:
        The content of ``fit.json``.

    Raises:
        InputError: A file or a name is wrong.
        RunError: No search could be done.
        KeyboardInterrupt: The same command goes on.
    """
    reporter = reporter or LineReporter()
    given = {"points": points, "clouds": clouds, "force": force, "masks": masks}
    named = {kind: path for kind, path in given.items() if path is not None}
    if len(named) != 1:
        got = " and ".join(f"--{kind}" for kind in named) or "none"
        kinds = "--points, --clouds, --force and --masks"
        raise InputError(f"fit: needs one of {kinds}, got {got}", "give one")
    ((kind, path),) = named.items()
    if (kind == "masks") != (cameras is not None):
        raise InputError("fit: --masks and --cameras go together", "give both, or neither")
    target: Target
    if kind != "masks":
        target = read_target(kind, path, sigma=sigma, fps=fps, shot=shot)
    scene, _ = shot_scene(
        shot, out, device=torch.device(device), seed=seed, reporter=reporter, make=True
    )
    if colors and kind != "masks":
        raise InputError("fit: --colors belongs to --masks", "leave it out")
    digests = [content_digest(path)]
    if cameras is not None:
        frame = body_frame(scene.bodies[0], scene)
        target = read_masks(path, cameras, frame, sigma=sigma, fps=fps, colors=colors)
        digests.append(content_digest(cameras))
    base = fingerprint(
        shot.resolved(), list(learn), list(laws), kind, *digests, sigma, fps, seed, colors
    )
    runner = functools.partial(_through_sweep, out / "search", base, jobs, on)
    stage = Fit(
        list(learn), laws=laws, starts=starts, cells=cells, grids=grids, seed=seed, runner=runner,
        device=device,
    )  # fmt: skip
    found = stage(scene, target, progress=reporter.task("fit"))
    values = left(shot, out, found, FILES, target=kind)
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
    ids = [
        fingerprint(base, t.start, t.dx, list(t.shares), t.grids, t.judge, t.name, t.device)
        for t in tasks
    ]
    return each_once(search_task, tasks, ids, folder, jobs, on, "searches failed")


def each_once(
    function: Callable[[Any, Path], Any],
    tasks: Sequence[Any],
    ids: Sequence[str],
    folder: Path,
    jobs: int | None,
    on: str,
    failed: str,
) -> list[Any]:
    """What a sweep finds for tasks, in their order; those with the same id are done once."""
    unlike = dict(zip(ids, tasks, strict=True))
    outcomes = sweep_map(
        function, unlike.values(), folder, ids=list(unlike), jobs=jobs, on=on, retry=True
    )
    done = {o.id: o.value for o in required(outcomes, failed, folder)}
    return [done[name] for name in ids]


def left(
    shot: Shot, out: Path, found: Found, outputs: Mapping[str, str], **said: Any
) -> dict[str, Any]:
    """Leave ``fit.json`` and ``fitted.yaml``, and return the content of the first."""
    values = {**said, **found.report, "outputs": dict(outputs)}
    write_json(out / FILES["fit"], values)
    with atomic_path(out / FILES["shot"]) as part:
        part.write_text(yaml.safe_dump(fitted(shot, found), sort_keys=False), encoding="utf-8")
    return values


def fitted(shot: Shot, found: Found) -> dict[str, Any]:
    """The shot with what was learnt; what was not identified stays as it was."""
    values = copy.deepcopy(shot.resolved())
    entries = values["objects"]
    made = {body.name: body for body in found.scene.bodies}
    for place in {**found.laws, **{key.partition(".")[0]: "" for key in found.values}}:
        name, _, part = place.partition("/")
        if part and not entries[name].get("parts"):  # the preset's own
            entries[name]["parts"] = [
                {"name": p.name, "where": dict(p.where), **_written(p)} for p in made[name].parts
            ]
    if found.laws:
        for name, body in made.items():
            _relay(entries[name], body.material)
            for part, entry in zip(body.parts, entries[name].get("parts", []), strict=False):
                _relay(entry, part.material(body.material))
    thrown: dict[str, dict[str, Any]] = {}
    for key, value in found.values.items():
        place, _, field = key.partition(".")
        name, _, part = place.partition("/")
        if name not in entries or key in found.unidentified:
            continue
        if field in ("velocity", "angular_velocity"):
            event = thrown.setdefault(name, {"type": "throw", "object": name})
            event["velocity" if field == "velocity" else "spin"] = value
        elif part:
            next(p for p in entries[name]["parts"] if p.get("name") == part)[field] = value
        else:
            entries[name][field] = value
    for body in found.scene.bodies:
        if body.name in thrown:  # the event says both
            thrown[body.name].setdefault("velocity", list(body.velocity))
            thrown[body.name].setdefault("spin", list(body.angular_velocity))
    kept = [e for e in values["events"] if e["type"] != "throw" or e.get("at") or not thrown]
    values["events"] = [*kept, *thrown.values()]
    return values


def _written(part: Part) -> dict[str, Any]:
    """What a shot can say of a part: no matter that only this scene has."""
    return {k: v for k, v in part.overrides.items() if not isinstance(v, Material)}


def _relay(entry: dict[str, Any], material: Material) -> None:
    """Give an object or a part of a shot another law, and drop what that law does not read."""
    for field in (*PARAMETERS, *HANDBOOK):
        if field not in material.reads:
            entry.pop(field, None)
    entry.pop("softening", None)
    entry |= {k: v for k, v in plain(material).items() if isinstance(v, int | float | str)}


def page(out: Path, values: Mapping[str, Any], times: Sequence[float]) -> Page:
    """The page of a fit."""
    made = Page(out.resolve().name, f"learnt from {values['target']}")
    rows = []
    for key, number in values["parameters"].items():
        bound = values["unidentified"].get(key)
        shown = f"unidentified: {bound}" if bound else _shown(number["value"])
        share = f"{number['prior_share']:.0%}"
        rows.append([key, shown, _shown(number["sd"]), _shown(number["grid"]), share])
    for place, facts in values.get("laws", {}).items():
        tried = sorted(facts["tried"].items(), key=lambda item: item[1]["held_out"])
        rows_of = [
            [law, _shown(f["held_out"]), _shown(f["seen"]), _mark(law, facts)] for law, f in tried
        ]
        made.heading(f"Law of {place}").table(
            ["law", "error on frames not seen, sd", "on frames seen, sd", ""], rows_of
        )
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


def _mark(law: str, facts: Mapping[str, Any]) -> str:
    return "taken" if law == facts["taken"] else "as good" if law in facts["alike"] else ""


def _shown(value: Any) -> str:
    return ", ".join(f"{v:.4g}" for v in (value if isinstance(value, list) else [value]))
