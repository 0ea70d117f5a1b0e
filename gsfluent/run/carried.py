"""A splat model that another program's points or meshes carry: behind ``gsfluent carry``.

Leaves a folder like that of ``gsfluent run``, so that render, export, view and report read it.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsfluent.config import Shot
from gsfluent.data import Gaussians
from gsfluent.errors import InputError
from gsfluent.io import load_splats
from gsfluent.io.sequences import Sequence, read_sequence
from gsfluent.pipeline.carrying import CarriedFrame, Carry
from gsfluent.progress import LineReporter, Reporter
from gsfluent.results.frames import SavedFrame, save_frame
from gsfluent.results.lock import locked
from gsfluent.results.record import RunRecord
from gsfluent.results.store import StageStore, content_digest
from gsfluent.run.report import REPORT, write_report
from gsfluent.stages.context import RunContext
from gsfluent.stages.show import render_stage

OBJECT = "object"
"""Name of what is carried."""
# What is up in the file; splats have +z up.
_TURNS = {
    "z": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "y": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    "-y": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
}


def carry_to(
    splats: Path,
    by: Path,
    out: Path,
    *,
    device: torch.device,
    fps: float | None = None,
    rest: int = 0,
    up: str = "z",
    scale: float = 1.0,
    floor: bool = False,
    film: bool = True,
    size: tuple[int, int] = (640, 480),
    camera: str = "orbit",
    force: bool = False,
    reporter: Reporter | None = None,
) -> dict[str, Any]:
    """Carry a splat file by a sequence into a folder, and make its film.

    Args:
        splats: Any splat file.
        by: See :func:`gsfluent.io.sequences.read_sequence`.
        out: Folder for the results.
        device: Where to compute.
        fps: Frames per second where the sequence has no times.
        rest: Frame in which the carriers are where the splats lie.
        up: Axis of the sequence that is +z of the splats.
        scale: Units of the splats in a unit of the sequence.
        floor: A studio with its floor at z = 0.
        film: Make ``video.mp4``; it also measures holes.
        size: Of the film.
        camera: As in a shot.
        force: Do all anew.
        reporter: Told of the progress.

    Returns:
        The content of ``run.json``.

    Raises:
        InputError: A file cannot be read, or the splats are not where their carriers are.
        RunError: The disk is full, or another run is at work in the folder.
    """
    if up not in _TURNS:
        raise InputError(f"--up {up}", f"choose from {', '.join(_TURNS)}")
    if not 0.0 < scale < 1e12:
        raise InputError(f"--scale {scale:g}", "give a number above 0")
    model, sequence = load_splats(splats), read_sequence(by, fps)
    sequence = sequence.placed(np.asarray(_TURNS[up], np.float64), scale)
    if len(sequence) > 1:
        fps = round((len(sequence) - 1) / float(sequence.times[-1] - sequence.times[0]), 6)
    shot = Shot.from_dict(
        {
            "splats": str(splats.resolve()),
            "objects": {OBJECT: {"material": "plaster"}},
            "floor": "none" if not floor else 0.0,
            "output": {
                "fps": min(max(fps or 24.0, 1.0), 1000.0),
                "seconds": max(float(sequence.times[-1] - sequence.times[0]), 1e-3),
                "size": list(size),
                "camera": camera,
            },
        }
    )
    with locked(out):
        store = StageStore(out / "stages", force=force)
        record = RunRecord(out / "run.json", shot.resolved(), device, 0)
        context = RunContext(shot, out, device, 0, store, record, reporter or LineReporter())
        _frames(
            context, model, sequence, rest, [content_digest(splats), content_digest(by)], up, scale
        )
        if film:
            render_stage(context)
        record.values["outputs"]["report"] = REPORT
        values = record.finish(store.results)
        write_report(out, values)
    return values


def _frames(
    context: RunContext,
    model: Gaussians,
    sequence: Sequence,
    rest: int,
    files: list[str],
    up: str,
    scale: float,
) -> None:
    """``stages/simulate/frame_0001.npz`` and so on, as a simulation writes them."""

    def work(folder: Path) -> dict[str, Any]:
        begun = time.process_time()
        stage, before = Carry(rest=rest, device=context.device), None
        for frame in stage(model, sequence, progress=context.reporter.task("carry")):
            saved = _saved(frame, stage.report["spacing"], before)
            save_frame(folder, saved)
            before = saved
        report = stage.report
        report["notes"] = _notes(report)
        report["verdict"], report["reason"] = "clean", "carried"
        report["cpu_seconds"] = time.process_time() - begun
        return report

    clock = [float(t) for t in sequence.times]
    context.do("simulate", work, files, clock, rest, up, scale, section="simulation")


def _notes(report: dict[str, Any]) -> list[str]:
    """What a person should know."""
    notes, count, frames = [], report["splats"], report["per_frame"]
    if report["far"]:
        notes.append(f"{report['far']} of {count} splats are more than 3 spacings from a carrier")
    for key, words in (("torn", "where carriers part, which may be a hole"), ("gone", "gone")):
        most = int(np.argmax(frames[key]))
        if frames[key][most] > 0.0:
            share, when = frames[key][most], frames["time"][most]
            notes.append(f"up to {share:.2%} of the splats are {words} (at {when:.3g} s)")
    return notes


def _saved(frame: CarriedFrame, spacing: float, before: SavedFrame | None) -> SavedFrame:
    """As a simulation leaves it; carriers that are not there lie where they were last."""
    there = torch.isfinite(frame.carriers).all(dim=1)
    places = frame.carriers.float()
    last = torch.zeros_like(places) if before is None else before.positions
    places = torch.where(there[:, None], places, last)
    speed = torch.zeros_like(places)
    if before is not None and frame.time > before.time:
        speed = (places - before.positions) / (frame.time - before.time)
    points, count = places.shape[0], frame.gaussians.count
    whole = torch.zeros(points, dtype=torch.int32, device=places.device)
    none = torch.full((count,), -1, dtype=torch.int32, device=places.device)
    return SavedFrame(
        index=frame.index,
        time=frame.time,
        gaussians=frame.gaussians,
        groups=none,
        carried=count,
        ids=torch.arange(count, device=places.device),
        anchor=frame.anchor.to(torch.int32),
        positions=places,
        volumes=torch.full_like(places[:, 0], max(spacing, 1e-9) ** 3),
        damage=torch.zeros_like(places[:, 0]),
        fragments=whole,
        velocity=speed,
        body=whole,
        material=whole,
        facts={"fragments": 1, "energy": {}, "bodies": [[OBJECT, "plaster"]]},
    )
