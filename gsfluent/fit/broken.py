"""A shot and the pieces that were found, to the numbers that break so: ``fit.json`` and others."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsfluent.choose.shot import shot_scene
from gsfluent.config import Shot
from gsfluent.errors import InputError
from gsfluent.fit.job import UNSEEN, each_once, left
from gsfluent.io.checked.files import read_text
from gsfluent.pipeline.fit import Break, FitPieces, run_break
from gsfluent.progress import LineReporter, Reporter
from gsfluent.results.store import content_digest, fingerprint
from gsfluent.targets.pieces import Pieces


def pieces_to(
    shot: Shot,
    out: Path,
    learn: Sequence[str],
    pieces: Path,
    *,
    dust: float | None = None,
    seeds: int = 8,
    rounds: int = 12,
    cells: int = 16,
    jobs: int | None = None,
    on: str = "local",
    seed: int = 0,
    device: torch.device | str = "cpu",
    reporter: Reporter | None = None,
) -> dict[str, Any]:
    """Learn numbers of a shot from its pieces, see :class:`gsfluent.pipeline.FitPieces`.

    Args:
        shot: Where the search starts; it is run as long as its film.
        out: Folder for the results.
        learn: ``OBJECT.NUMBER`` or ``OBJECT/PART.NUMBER`` each.
        pieces: A table with a column ``mass``, and perhaps ``x``, ``y`` and ``z``; a line for each.
        dust: Share of the mass that belongs to none.
        seeds: Simulations of each candidate.
        rounds: Generations.
        cells: Along the longest side of the largest body.
        jobs: Simulations at a time.
        on: Where they run, see :func:`gsfluent.sweep.map`.
        seed: Of the candidates, and of solids.
        device: Where solids are made and simulations run.
        reporter: Told of the progress.

    Returns:
        The content of ``fit.json``.

    Raises:
        InputError: A file or a name is wrong.
    """
    reporter = reporter or LineReporter()
    masses, places = read_pieces(pieces)
    target = Pieces(masses, places=places, broken=dust, time=shot.output.seconds)
    scene, _ = shot_scene(
        shot, out, device=torch.device(device), seed=seed, reporter=reporter, make=True
    )
    base = fingerprint(shot.resolved(), list(learn), content_digest(pieces), seed, str(device))
    runner = functools.partial(_through_sweep, out / "search", base, jobs, on)
    stage = FitPieces(
        learn, seeds=seeds, rounds=rounds, cells=cells, device=device, seed=seed, runner=runner
    )
    found = stage(scene, target, progress=reporter.task("fit"))
    return left(shot, out, found, UNSEEN, target="pieces")


def break_task(task: Break, folder: Path) -> dict[str, list[float]]:
    """One simulation, as a task of a sweep."""
    return run_break(task)


def _through_sweep(
    folder: Path,
    base: str,
    jobs: int | None,
    on: str,
    function: Callable[[Any], Any],
    items: Iterable[Break],
) -> list[dict[str, Any]]:
    """Do simulations, each once."""
    tasks = list(items)
    matter = [repr([(b.material, b.parts) for b in t.scene.bodies]) for t in tasks]
    ids = [fingerprint(base, m, t.dx, t.time, t.seed) for m, t in zip(matter, tasks, strict=True)]
    return each_once(break_task, tasks, ids, folder, jobs, on, "simulations failed")


def read_pieces(path: Path) -> tuple[list[float], list[list[float]] | None]:
    """Masses and places of a table.

    Raises:
        InputError: No such columns, or no numbers.
    """
    lines = [line for line in read_text(path, noun="table").splitlines() if line.strip()]
    head = [word.strip().lower() for word in lines[0].split(",")] if lines else []
    try:
        rows = [[float(word) for word in line.split(",")] for line in lines[1:]]
        masses = [row[head.index("mass")] for row in rows]
        columns = [head.index(axis) for axis in "xyz" if axis in head]
        places = [[row[c] for c in columns] for row in rows] if columns else None
        if not np.isfinite(masses).all() or len(columns) not in (0, 3):
            raise ValueError("not finite, or not all of x, y, z")
        return masses, places
    except (ValueError, IndexError) as error:
        raise InputError(
            f"{path}: no table of pieces ({error})",
            "a first line mass or mass,x,y,z, then numbers in kilograms and metres",
        ) from error
