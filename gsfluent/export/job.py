"""What one export is asked to do: which frames, where to, with which options."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from gsfluent.export.frames import FrameSequence, Moment
from gsfluent.io import write_json
from gsfluent.progress import Progress, report_progress
from gsfluent.results.store import content_digest, fingerprint


@dataclass(frozen=True)
class ExportOptions:
    """How the formats are written; each reads what concerns it."""

    # Which frames, as in Python (``12``, ``10:40``, ``::2``); all by default.
    frames: str | None = None
    sh: int = 0  # Highest SH degree to keep
    up: str = "z"  # Axis that points up where the format leaves it open: ``z``, ``y`` or ``-y``
    constant: bool = False  # The same number and order of splats in every frame
    compressed: bool = False  # SuperSplat's compressed layout for PLY
    attributes: bool = False  # Properties ``fragment`` and ``material`` in PLY
    spz_version: int = 3  # 2 or 3
    usd_ending: str = "usdc"  # ``usdc``, ``usda`` or ``usdz``
    # Some of ``splats``, ``particles``, ``meshes``.
    usd_parts: tuple[str, ...] = ("splats", "particles")
    mesh_ending: str = "ply"  # ``ply``, ``obj`` or ``glb``
    mesh_blur: float = 1.0  # Point spacings over which fragments' surfaces are smoothed
    key_every: int = 30  # Frames from one key frame to the next of a delta file
    camera: str | None = None  # Camera or camera path of pictures; the shot's own by default
    # (width, height) of pictures [px]; the shot's own by default.
    size: tuple[int, int] | None = None
    fps: float | None = None  # Pictures or time codes per second; the shot's own by default
    alpha: bool = False  # Pictures with a transparent background instead of the studio
    relit: bool = False  # Bake the light into the colours of splats and meshes
    # Toward the key light (``x,y,z``), or a YAML file with a ``light:`` section.
    light: str | None = None
    lamps: tuple[str, ...] = ()  # More lamps
    environment: str | None = None  # An equirectangular picture, ``sky`` or ``none``


@dataclass(frozen=True, eq=False)
class Job:
    """One export."""

    out: Path  # Folder of the run
    folder: Path  # Where the files go
    sequence: FrameSequence  # The chosen frames
    options: ExportOptions  # How
    fps: float  # Frames per second of the simulation's frames
    device: torch.device  # Where pictures are rendered
    progress: Progress | None = None  # Called per frame

    def report(self, done: int, total: int, note: str) -> None:
        """Tell whoever listens."""
        report_progress(self.progress, done, total, note)

    def write_each(
        self,
        kind: str,
        folder: str,
        name: str,
        write: Callable[[Path, Moment], None],
        *,
        frames: Iterable[Moment] | None = None,
    ) -> list[str]:
        """Write one file per frame, leaving alone what an interrupted export has finished.

        Args:
            kind: Shown with the progress.
            folder: Below the export's folder.
            name: Of the files, with a field for the frame's number from 1.
            write: Writes one file, atomically.
            frames: The frames, where they are not simply those of the sequence.

        Returns:
            The names of the files.
        """
        target = self.folder / folder
        target.mkdir(parents=True, exist_ok=True)
        names = [name.format(index + 1) for index in self.sequence.indices]
        done = self._finished(target, kind)
        moments = None if frames is None else iter(frames)
        for place, file in enumerate(names):
            moment = None if moments is None else next(moments)
            if not (done and (target / file).is_file()):
                write(target / file, moment or self.sequence.moment(place))
            self.report(place + 1, len(names), kind)
        self._forget_stale(target, name)
        return names

    def _finished(self, target: Path, kind: str) -> bool:
        """Whether files in the folder are of this very export; notes down that they will be."""
        source = self.sequence.source()
        known = content_digest(source) if source.is_file() else None
        wanted = repr(replace(self.options, frames=None))
        key = fingerprint("export", kind, wanted, known, self._light())
        # beside the folder: a player that is given the folder must find frames only
        note = self.folder / ".gsfluent-export.json"
        try:
            notes = dict(json.loads(note.read_text(encoding="utf-8")))
        except (OSError, ValueError, TypeError):
            notes = {}
        same = known is not None and notes.get(target.name) == key
        if not same:
            write_json(note, notes | {target.name: key})
        return same

    def _light(self) -> list[str]:
        """Digests of the files that say what light is baked in."""
        if not self.options.relit:
            return []
        given = (self.out / "run.json", self.options.light, self.options.environment)
        files = [Path(name) for name in given if name is not None]
        return [content_digest(file) for file in files if file.is_file()]

    def _forget_stale(self, target: Path, name: str) -> None:
        """Remove files beyond the run's last frame: an older, longer run's, which would play on."""
        number = self.sequence.total + 1
        while (stale := target / name.format(number)).is_file():
            stale.unlink()
            number += 1


def span(folder: str, names: Sequence[str]) -> str:
    """What was written, in words: the first and the last file."""
    if len(names) == 1:
        return f"{folder}/{names[0]}"
    return f"{folder}/{names[0]} to {names[-1]}"
