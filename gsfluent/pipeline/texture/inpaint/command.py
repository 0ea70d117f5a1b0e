"""Any model in a process of its own: pictures in a folder, a command, pictures back.

For models that cannot share this environment. MVInpainter (Cao et al., NeurIPS 2024) is one: it
pins Python 3.8, torch 2.1 and patched extensions, and takes a stack of frames whose first is the
finished reference. The same folder serves any other program.
"""

from __future__ import annotations

import hashlib
import json
import logging
import shlex
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from gsfluent.errors import InputError, RunError
from gsfluent.io.atomic import write_json
from gsfluent.pipeline.texture.inpaint.inpainter import (
    Inpainter,
    Job,
    MaskedInpainter,
    combined_seed,
)

logger = logging.getLogger(__name__)


class CommandInpainter(MaskedInpainter):
    """Slices to a command and back, in overlapping windows.

    For each window a folder is written::

        images/0000.png ...   the slices, RGB, 8 bits
        masks/0000.png ...    white is to be painted
        inpainted/0000.png    the reference: first slice of the window, finished (where there is)
        prompt.txt            what a slice shows
        meta.json             frames, size, axis, offsets, strength, seed, reference, window

    The command then runs with ``{folder}`` replaced by that folder and ``{prompt}`` by the prompt;
    it writes ``out/0000.png`` and so on, of the same number and size. Known pixels are put back
    here. The first window's reference comes from ``first`` (any other inpainter); later windows
    repeat the last ``overlap`` slices of the window before, and the first of these, already
    painted, is their reference.

    Args:
        command: For example ``"/envs/mv/bin/python infer.py --folder {folder}"``.
        window: Slices per run (MVInpainter: 8 to 24).
        overlap: Slices shared by neighbouring windows.
        first: Inpainter of the very first slice; None leaves it to the command.
        folder: Where to work; finished windows are found again there. None: a temporary folder.
        timeout: Seconds one window may take; None waits.

    Raises:
        InputError: The command is empty or names no ``{folder}``, or window and overlap do not fit.
    """

    name = "command"
    sequential = True

    def __init__(
        self,
        command: str,
        *,
        window: int = 24,
        overlap: int = 4,
        first: Inpainter | None = None,
        folder: str | Path | None = None,
        timeout: float | None = None,
    ) -> None:
        if "{folder}" not in command:
            raise InputError(
                f"inpaint: the command names no {{folder}}: {command!r}",
                hint='write it like "python infer.py --folder {folder}"',
            )
        if not 0 <= overlap < window:
            raise InputError(
                f"inpaint: overlap must be from 0 to below window, got {overlap} and {window}",
                hint="24 and 4 are usual",
            )
        self.command = command
        self.window = int(window)
        self.overlap = int(overlap)
        self.first = first
        self.folder = None if folder is None else Path(folder)
        self.timeout = timeout
        self.runs = 0

    def paint(self, job: Job) -> np.ndarray:
        """Run the command over all windows."""
        made, hole = job.slices.copy(), job.mask.copy()
        reference = False
        if self.first is not None:
            one = job.take([0])
            made[:1] = self.first(
                one.slices,
                one.mask,
                prompt=one.prompt,
                exemplar=one.exemplar,
                strength=one.strength,
                seeds=one.seeds,
                context=one.context,
            )
            reference = True
        start = 0
        while True:
            stop = min(start + self.window, len(made))
            if reference:
                hole[start] = False
            if hole[start:stop].any():
                window = replace(job, slices=made, mask=hole).take(range(start, stop))
                out = self._window(window, reference)
                made[start:stop] = np.where(hole[start:stop][..., None], out, made[start:stop])
                hole[start:stop] = False
            if stop == len(made):
                return made
            # the overlap is known in the next window: its first slice is the reference
            start = stop - self.overlap
            reference = self.overlap > 0

    def _window(self, job: Job, reference: bool) -> np.ndarray:
        """One run of the command."""
        meta = {
            "frames": len(job.slices),
            "height": int(job.slices.shape[1]),
            "width": int(job.slices.shape[2]),
            "axis": "xyz"[job.context.axis],
            "offsets": list(job.context.offsets),
            "pitch": job.context.pitch,
            "strength": job.strength,
            "seed": combined_seed(job.seeds),
            "reference": reference,
        }
        digest = hashlib.sha256(json.dumps([self.command, job.prompt, meta]).encode())
        digest.update(np.ascontiguousarray(job.slices).tobytes())
        digest.update(np.ascontiguousarray(job.mask).tobytes())
        key = digest.hexdigest()[:16]
        if self.folder is not None:
            return self._in_folder(self.folder / key, job, meta)
        with tempfile.TemporaryDirectory(prefix="gsfluent-inpaint-") as temporary:
            return self._in_folder(Path(temporary) / key, job, meta)

    def _in_folder(self, folder: Path, job: Job, meta: dict[str, object]) -> np.ndarray:
        done = folder / "done.json"
        if not done.is_file():
            try:
                for name in ("images", "masks", "inpainted", "out"):
                    (folder / name).mkdir(parents=True, exist_ok=True)
                for stale in (folder / "out").glob("*.png"):
                    stale.unlink()
                for k, (picture, open_) in enumerate(zip(job.slices, job.mask, strict=True)):
                    _write(folder / "images" / f"{k:04d}.png", picture)
                    _write(folder / "masks" / f"{k:04d}.png", open_.astype(np.float32))
                if meta["reference"]:
                    _write(folder / "inpainted" / "0000.png", job.slices[0])
                (folder / "prompt.txt").write_text(job.prompt + "\n", encoding="utf-8")
                write_json(folder / "meta.json", meta)
            except OSError as error:
                raise InputError(
                    f"{folder}: slices cannot be written ({error})",
                    hint="choose a writable folder",
                ) from error
            self._run(folder, job.prompt)
        made = _read_all(folder / "out", job.slices.shape)
        write_json(done, {"frames": len(job.slices)})
        return made

    def _run(self, folder: Path, prompt: str) -> None:
        # replaced after splitting: a prompt or path with spaces or quotes stays one argument
        parts = shlex.split(self.command)
        words = [w.replace("{folder}", str(folder)).replace("{prompt}", prompt) for w in parts]
        self.runs += 1
        try:
            done = subprocess.run(
                words, capture_output=True, text=True, timeout=self.timeout, check=False
            )
        except (FileNotFoundError, PermissionError) as error:
            missing = isinstance(error, FileNotFoundError)
            what = "not found" if missing else "cannot be run"
            hint = "give the full path of the program" if missing else "make it executable"
            raise InputError(f"inpaint: command {what}: {words[0]}", hint) from error
        except subprocess.TimeoutExpired as error:
            raise RunError(
                f"inpaint: the command took longer than {self.timeout:g} s",
                kept=f"windows finished before, in {folder.parent}",
                hint="raise timeout, or use a smaller window",
            ) from error
        if done.returncode != 0:
            last = (done.stderr or done.stdout).strip().splitlines()[-3:]
            raise RunError(
                f"inpaint: the command ended with status {done.returncode}: {' | '.join(last)}",
                kept=f"windows finished before, in {folder.parent}",
                hint=f"run it by hand: {shlex.join(words)}",
            )


def _write(path: Path, picture: np.ndarray) -> None:
    from PIL import Image

    Image.fromarray((picture.clip(0, 1) * 255).round().astype(np.uint8)).save(path)


def _read_all(folder: Path, shape: Sequence[int]) -> np.ndarray:
    """All frames of ``out/``, checked for number and size."""
    from PIL import Image

    count, height, width = (int(s) for s in shape[:3])
    found = sorted(p.name for p in folder.glob("*.png"))
    wanted = [f"{k:04d}.png" for k in range(count)]
    if found != wanted:
        missing = sorted(set(wanted) - set(found))
        raise RunError(
            f"{folder}: {len(found)} pictures for {count} slices"
            + (f"; {missing[0]} is missing" if missing else f"; {found[-1]} is one too many"),
            hint="the command must write out/0000.png, 0001.png, ... one per slice",
        )
    frames = np.empty((count, height, width, 3), np.float32)
    for k, name in enumerate(wanted):
        try:
            with Image.open(folder / name) as opened:
                pixels = np.asarray(opened.convert("RGB"))
        except OSError as error:
            raise RunError(f"{folder / name}: not a picture ({error})") from error
        if pixels.shape[:2] != (height, width):
            raise RunError(
                f"{folder / name}: {pixels.shape[1]} x {pixels.shape[0]} pixels for a slice of "
                f"{width} x {height}",
                hint="the command must give the size back that it was given",
            )
        frames[k] = pixels.astype(np.float32) / 255.0
    return frames
