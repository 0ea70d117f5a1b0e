"""A recording: what happened in a live session, as an ordinary run folder and a shot."""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import Any

from gsfluent.config import Shot
from gsfluent.errors import InputError
from gsfluent.io import atomic_path
from gsfluent.live.session import LiveSession
from gsfluent.results.digests import Journal
from gsfluent.results.frames import SavedFrame, save_frame
from gsfluent.results.record import RunRecord
from gsfluent.results.store import StageResult, fingerprint


class Recording:
    """Writes the frames of a session from its reset on.

    Args:
        out: Folder of the new run.
        session: The session, just reset; its frame is the first one.
        shot: The shot of the scene; pokes become its events.

    Raises:
        InputError: The folder holds something already.
    """

    def __init__(self, out: Path, session: LiveSession, shot: Shot) -> None:
        if out.exists() and (not out.is_dir() or any(out.iterdir())):
            raise InputError(f"record: {out} is there already", hint="name a new folder")
        if session.pokes:
            raise InputError("record: a recording begins at rest", hint="reset() first")
        self.out, self.session, self.shot = out, session, shot
        self.folder = out / "stages" / "simulate"
        self.folder.mkdir(parents=True, exist_ok=True)
        self.frames: list[dict[str, Any]] = []
        self._start, self._clock = session.time, time.perf_counter()
        self._slow = session.slow
        self.add(session.frame())

    def add(self, frame: SavedFrame) -> None:
        """Write the next frame; its number and time count from the recording's first.

        Raises:
            RunError: The disk is full.
        """
        number, at = len(self.frames), frame.time - self._start
        facts = dict(frame.facts) | {"time": at}
        save_frame(self.folder, dataclasses.replace(frame, index=number, time=at, facts=facts))
        self.frames.append({k: v for k, v in facts.items() if k != "energy"})

    def close(self) -> Path:
        """Write ``shot.yaml`` and ``run.json``; returns the folder.

        Raises:
            RunError: The disk is full.
        """
        import yaml

        session, count = self.session, len(self.frames)
        shot = self._as_shot(count)
        values = shot.resolved()
        with atomic_path(self.out / "shot.yaml") as part:
            part.write_text(yaml.safe_dump(values, sort_keys=False), encoding="utf-8")
        report = session.run.report() | session.report() | {"frames": count}
        keys = self.frames[0]
        report["per_frame"] = {key: [row.get(key) for row in self.frames] for key in keys}
        seconds = time.perf_counter() - self._clock
        result = StageResult(
            "simulate", self.folder, fingerprint("live", values), report, seconds=seconds
        )
        result.files = Journal(self.folder, self.out).files()
        result.save()
        record = RunRecord(self.out / "run.json", values, session.device, session.seed)
        record.values["simulation"] = report
        record.values["live"] = {"pokes": len(session.pokes), "from": self._start}
        record.finish([result])
        return self.out

    def _as_shot(self, count: int) -> Shot:
        """The shot that would show this: the pokes at the times of the recording."""
        session = self.session
        events = [poke | {"at": poke["at"] - self._start} for poke in session.pokes]
        values = self.shot.resolved() | {"events": events}
        values["solve"] = dict(values["solve"]) | {
            "cells": session.cells,
            "standing": True,
        }
        fps = session.fps * self._slow
        values["output"] = dict(values["output"]) | {
            "fps": fps, "seconds": count / fps, "slow": self._slow, "cracks": session.cracks,
        }  # fmt: skip
        if not isinstance(values["output"].get("camera"), str):
            values["output"]["camera"] = "orbit"
        values["output"]["backdrop"] = "studio"
        return Shot.from_dict(values, self.out)
