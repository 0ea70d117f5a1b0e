"""Where the viewer's frames come from: a folder that a run writes, finished or not.

Anything with the five members of :class:`Source` can be viewed; a live session is one, too.
"""

from __future__ import annotations

import logging
import re
import time
from pathlib import Path
from typing import Any, Protocol

from gsfluent.config import Shot
from gsfluent.errors import GsfluentError, InputError
from gsfluent.io.checked.files import read_json
from gsfluent.results.frames import SavedFrame, frame_head, frame_path, load_frame
from gsfluent.results.record import shot_of
from gsfluent.viewer.model.still import still_frame

_log = logging.getLogger(__name__)
_NUMBER = re.compile(r"frame_(\d+)\.npz$")
_QUIET = 60.0  # seconds without a new frame after which a run may have been killed
_SOLIDS = ("texture", "fill")  # stages that leave solids, the best first


class Source(Protocol):
    """A growing list of frames."""

    title: str  # Short name for the page
    # The shot, where it is known: its light, floor and backdrop are the viewer's first.
    shot: Shot | None

    def count(self) -> int:
        """Number of frames so far; asked about once a second, and cheap."""
        ...

    def frame(self, index: int) -> SavedFrame:
        """Frame ``index`` on any device.

        Raises:
            RunError: It is missing or damaged.
        """
        ...

    def facts(self, index: int) -> dict[str, Any]:
        """Plain figures of frame ``index`` for the plots, ``time`` [s] among them.

        Without reading the rest of the frame, and empty where there are none. Known names are those
        of ``run.json``'s ``per_frame``, and ``holes``, the hole fraction after repair.
        """
        ...

    @property
    def running(self) -> bool:
        """Whether more frames are to be expected."""
        ...

    @property
    def revision(self) -> str:
        """Changes when frames that were already handed out are no longer true."""
        ...

    def state(self) -> str:
        """One line for the head of the page: finished, running, what is missing."""
        ...


class RunSource:
    """The folder of a run, ``gsfluent run -o OUT``.

    While no frame is simulated yet, the solid of the fill or texture stage is the only frame.

    Raises:
        InputError: It is not a run, or nothing in it can be seen yet.
    """

    def __init__(self, out: Path) -> None:
        self.out = out
        self.title = out.resolve().name
        self.folder = out / "stages" / "simulate"
        self._record: dict[str, Any] = {}
        self._record_stamp = -1.0
        if not (out / "stages").is_dir():
            raise InputError(
                f"OUT: {out} is not the folder of a run (no {out / 'stages'})",
                "give the folder that `gsfluent run SHOT.yaml -o OUT` writes",
            )
        if self.count() == 0:
            raise InputError(
                f"OUT: {out} has neither simulated frames nor a filled solid yet",
                "wait until the fill stage is done, or look at `gsfluent run`'s messages",
            )
        self.shot: Shot | None = None
        try:
            self.shot = shot_of(out)
        except GsfluentError:
            _log.debug("%s: no run.json yet; light and floor are the usual ones", out)

    def count(self) -> int:
        """Highest frame number on disk; 1 while there is only a solid."""
        simulated = self._simulated()
        return simulated[-1] if simulated else int(bool(self._solids()))

    def frame(self, index: int) -> SavedFrame:
        """A simulated frame, or the solid."""
        if not self._simulated():
            return still_frame(self.out / "stages" / "isolate", self._solids())
        return load_frame(self.folder, index)

    def facts(self, index: int) -> dict[str, Any]:
        """Figures of a frame, from its head only; empty where it cannot be read."""
        try:
            head = frame_head(frame_path(self.folder, index))
            facts = dict(head["facts"]) | {"time": float(head["time"])}
        except (LookupError, ValueError, TypeError, RecursionError):
            return {}
        holes = (self._read_record().get("render") or {}).get("hole_fraction") or []
        if index < len(holes) and holes[index] is not None and not self.running:
            facts["holes"] = holes[index]
        return facts

    @property
    def running(self) -> bool:
        """Whether the run is, by all signs, still at work."""
        return self._unfinished() and self._age() < _QUIET

    @property
    def revision(self) -> str:
        """Fingerprint of the simulation, and whether there is one."""
        return f"{self._marker().get('fingerprint')} {bool(self._simulated())}"

    def state(self) -> str:
        """What has been found, in words."""
        simulated = self._simulated()
        if not simulated:
            what = "the filled solid; nothing is simulated yet."
            return f"**Running:** {what}" if self.running else f"**Only** {what}"
        count = f"{len(simulated)} frame{'s' * (len(simulated) != 1)}"
        missing = sorted(set(range(1, simulated[-1] + 1)) - set(simulated))
        gaps = ""
        if missing:
            gaps = f" Missing: {', '.join(map(str, missing[:8]))}{' ...' * (len(missing) > 8)}."
        complete = bool(self._marker().get("complete"))
        if self.running:
            doing = "; all simulated, the film is being made" if complete else " so far"
            return f"**Running:** {count}{doing}.{gaps}"
        if self._unfinished() and not complete:
            return f"**Stopped:** {count}; no new one for {_span(self._age())}.{gaps}"
        record = self._read_record()
        verdict = str(record.get("verdict", "finished"))
        notes = (record.get("simulation") or {}).get("notes") or []
        return f"**{verdict.capitalize()}:** {count}.{gaps}" + "".join(f" {n}." for n in notes)

    def _simulated(self) -> list[int]:
        """Numbers of the frames on disk, from 1, ascending."""
        names = (_NUMBER.match(path.name) for path in self.folder.glob("frame_*.npz"))
        return sorted(int(name.group(1)) for name in names if name)

    def _solids(self) -> list[Path]:
        for stage in _SOLIDS:
            found = sorted((self.out / "stages" / stage).glob("*.volume.npz"))
            plys = [path.with_name(path.name.replace(".volume.npz", ".ply")) for path in found]
            if plys and all(path.is_file() for path in plys):
                return plys
        return []

    def _unfinished(self) -> bool:
        """Whether some stage has written after the last ``run.json``."""
        record = self.out / "run.json"
        newest = max((p.stat().st_mtime for p in self._signs() if p.is_file()), default=0.0)
        return not record.is_file() or record.stat().st_mtime < newest

    def _signs(self) -> list[Path]:
        """Files that a run at work touches: markers of the stages and the newest frame."""
        signs = list((self.out / "stages").glob("*/stage.json"))
        simulated = self._simulated()
        if simulated:
            signs.append(frame_path(self.folder, simulated[-1] - 1))
        return signs

    def _age(self) -> float:
        """Seconds since the run last wrote something."""
        stamps = [path.stat().st_mtime for path in self._signs() if path.is_file()]
        return time.time() - max(stamps, default=0.0)

    def _marker(self) -> dict[str, Any]:
        return _read_json(self.folder / "stage.json")

    def _read_record(self) -> dict[str, Any]:
        """``run.json``, read again only when it has changed."""
        path = self.out / "run.json"
        stamp = path.stat().st_mtime if path.is_file() else -1.0
        if stamp != self._record_stamp:
            self._record, self._record_stamp = _read_json(path), stamp
        return self._record


def _read_json(path: Path) -> dict[str, Any]:
    try:
        value = read_json(path)
    except InputError:
        return {}
    return value if isinstance(value, dict) else {}


def _span(seconds: float) -> str:
    if seconds < 120.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200.0 else f"{seconds / 3600:.0f} h"
