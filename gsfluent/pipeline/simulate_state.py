"""Saving a simulation at a frame and taking it up again."""

from __future__ import annotations

import math
import pickle
from pathlib import Path
from typing import Any

import torch

from gsfluent.errors import InputError
from gsfluent.io.atomic import atomic_path
from gsfluent.pipeline.particles import Matter
from gsfluent.pipeline.simulate_step import State

VERSION = 2
_MOVING = ("position", "velocity", "affine", "strain", "alpha", "deformation")


def save_state(path: str | Path, state: State, matter: Matter, extra: dict[str, Any]) -> None:
    """Write a state atomically: tensors, numbers and strings only.

    Args:
        path: File to write.
        state: State at a frame.
        matter: The points, of which a fingerprint is stored.
        extra: Counters and records, of plain types.
    """
    values: dict[str, Any] = {
        "version": VERSION,
        "fingerprint": _fingerprint(matter),
        "particles": {name: getattr(state.particles, name).cpu() for name in _MOVING},
        "peak": state.peak.cpu(),
        "stress": state.stress.cpu(),
        "impulse": state.impulse.cpu(),
        "stray": state.stray.cpu(),
        "colliders": state.colliders.cpu(),
        "work": state.work.cpu(),
        "time": state.time,
        "step": state.step,
        "landed": list(state.landed),
        "extra": extra,
    }
    with atomic_path(path) as temporary:
        torch.save(values, temporary)


def load_state(path: str | Path, matter: Matter) -> tuple[State, dict[str, Any]]:
    """Read what :func:`save_state` wrote.

    Raises:
        InputError: No such file, a damaged one, or one of another scene.
    """
    try:
        values = torch.load(path, map_location=matter.particles.device, weights_only=True)
    except FileNotFoundError:
        raise InputError(f"resume: no file {path}", mend="start without resume") from None
    except (OSError, RuntimeError, EOFError, pickle.UnpicklingError) as error:
        raise InputError(
            f"resume: {path} cannot be read ({error})", mend="start without resume"
        ) from error
    if not isinstance(values, dict) or values.get("version") != VERSION:
        raise InputError(f"resume: {path} is no state of this version", mend="start without resume")
    mine = _fingerprint(matter)
    theirs = values["fingerprint"]
    if len(theirs) != len(mine) or not all(
        math.isclose(a, b, rel_tol=1e-9) for a, b in zip(theirs, mine, strict=True)
    ):
        raise InputError(
            f"resume: {path} belongs to another scene, quality or seed",
            mend="resume with the settings it was made with, or start without resume",
        )
    particles = matter.particles.replace(**values["particles"])
    state = State(
        particles=particles,
        peak=values["peak"],
        stress=values["stress"],
        time=float(values["time"]),
        step=int(values["step"]),
        landed=tuple(bool(v) for v in values["landed"]),
        impulse=values["impulse"],
        stray=values["stray"],
        colliders=values["colliders"],
        work=values["work"],
    )
    return state, values["extra"]


def _fingerprint(matter: Matter) -> list[float]:
    """Numbers that differ between scenes, qualities and seeds."""
    p = matter.particles
    parts = [p.position, p.velocity, p.alpha, p.mass, p.volume, matter.params]
    sums = [float(v.cpu().double().sum()) for v in parts]
    return [float(p.count), matter.dx, *sums]
