"""Photographs or a video without poses, given to a run: their poses are found first, and said."""

from __future__ import annotations

import hashlib
import json
import logging
import shutil
from pathlib import Path

from gsfluent.io import write_json
from gsfluent.posing import LEAST, SUFFIXES, find_poses, photographs_in, poses_text
from gsfluent.progress import Progress

_log = logging.getLogger(__name__)

CAPTURE = "capture"
"""Folder of a result that holds the photographs and their poses."""
_SOURCE = "source.json"


def is_photographs(source: Path) -> bool:
    """Whether poses could be found for what a path names: photographs in a folder, or a video."""
    if source.is_file():
        return source.suffix.lower() in SUFFIXES
    return source.is_dir() and len(photographs_in(source)) >= LEAST


def posed(source: Path, out: Path, seed: int, progress: Progress | None = None) -> Path:
    """A capture of photographs without poses, in ``OUT/capture``; found once.

    Args:
        source: Folder of photographs, or a video.
        out: Result folder of the run, which the caller holds.
        seed: Of COLMAP's random choices.
        progress: Called as ``progress(done, total, message)``.

    Returns:
        The folder of the capture.

    Raises:
        InputError: pycolmap is missing, or a photograph cannot be read.
        RunError: No three photographs fit together.
    """
    target = out / CAPTURE
    made_of = {"source": str(source.resolve()), "digest": _digest(source), "seed": seed}
    if (target / _SOURCE).is_file():
        if json.loads((target / _SOURCE).read_text(encoding="utf-8")) == made_of:
            _log.info("poses: of an earlier run, %s", target)
            return target
        shutil.rmtree(target)  # made here, of other photographs
    _log.info("poses: %s has none; they are found first, as gsfluent poses does", source)
    report = find_poses(source, target, seed=seed, progress=progress)
    write_json(target / _SOURCE, made_of)
    _log.info("poses: %s; they lie in %s", poses_text(report), target)
    return target


def _digest(source: Path) -> str:
    """Changes with a photograph: by names, sizes and times."""
    found = hashlib.blake2b(digest_size=16)
    for path in [source] if source.is_file() else photographs_in(source):
        facts = path.stat()
        found.update(f"{path.name} {facts.st_size} {facts.st_mtime_ns}\n".encode())
    return found.hexdigest()
