"""``run.json``: verdict and every figure the stages know, written atomically, also on failure."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

import gsfluent
from gsfluent.config import Shot
from gsfluent.data import Frame
from gsfluent.errors import GsfluentError, InputError
from gsfluent.io import write_json
from gsfluent.io.checked.files import read_json
from gsfluent.results.store import StageResult

CLEAN, FAILED = "clean", "failed"


class RunRecord:
    """Collects the figures and writes the file."""

    def __init__(self, path: Path, shot: dict[str, Any], device: torch.device, seed: int) -> None:
        self.path = path
        self.values: dict[str, Any] = {
            "version": gsfluent.__version__,
            "verdict": FAILED,
            "reason": "the run has not finished",
            "device": describe_device(device),
            "seed": seed,
            "shot": shot,
            "stages": [],
            **dict.fromkeys(("reconstruction", "fill", "texture", "simulation", "render")),
            "outputs": {},
        }

    def finish(self, stages: list[StageResult]) -> dict[str, Any]:
        """Set the verdict of a run that went through and write the file."""
        simulation = self.values["simulation"] or {}
        verdict = simulation.get("verdict", CLEAN)
        reason = simulation.get("reason") or "every stage finished, nothing had to be healed"
        # sound, and still not what was wanted: whoever reads the verdict reads that too
        redone = [f"{s.name} was done anew: {s.redone}" for s in stages if s.redone]
        reason = "; ".join([reason, *redone, *(simulation.get("notes") or [])])
        return self._write(verdict, reason, stages)

    def fail(self, error: BaseException, stages: list[StageResult]) -> dict[str, Any]:
        """Write the file for a run that stopped."""
        at = f" during {stages[-1].name}" if stages else ""
        if isinstance(error, KeyboardInterrupt):
            reason = f"{str(error) or 'interrupted by Ctrl-C'}{at}"
        elif isinstance(error, GsfluentError):
            reason = f"{error}{at}"
        else:
            reason = f"{type(error).__name__}: {error}{at}"
        return self._write(FAILED, reason, stages)

    def _write(self, verdict: str, reason: str, stages: list[StageResult]) -> dict[str, Any]:
        self.values["verdict"], self.values["reason"] = verdict, reason
        self.values["stages"] = [stage.summary() for stage in stages]
        write_json(self.path, self.values)
        return self.values


def describe_device(device: torch.device) -> str:
    """``cpu`` or ``cuda:0 (NAME)``."""
    if device.type == "cuda":
        return f"{device} ({torch.cuda.get_device_name(device)})"
    return str(device)


def shot_of(out: Path) -> Shot:
    """The resolved shot of a run, from its ``run.json``.

    Raises:
        InputError: There is none, or it is damaged.
    """
    path = out / "run.json"
    try:
        values = read_json(path)["shot"]
    except (LookupError, TypeError, ValueError) as error:
        raise InputError(
            f"{path}: not the record of a run ({error})", "run the shot first"
        ) from error
    try:
        return Shot.from_dict(values, out)
    except InputError as error:
        raise InputError(f"{path}: shot: {error.what}", error.hint) from error


def read_frame(folder: Path) -> Frame:
    """World-to-scene frame that the isolate stage wrote; the floor, if any, is at z = 0.

    Raises:
        InputError: It is missing or damaged.
    """
    path, hint = folder / "frame.json", "run the shot again with --force"
    values = read_json(path, hint)
    try:
        return Frame.from_dict(values)
    except (LookupError, TypeError, ValueError, OverflowError, RuntimeError) as error:
        raise InputError(f"{path}: no frame ({error})", hint) from error
