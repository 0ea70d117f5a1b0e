"""Poses by pycolmap: features, matches, incremental mapping; what was found is said in numbers.

Schoenberger and Frahm 2016, "Structure-from-Motion Revisited".
"""

from __future__ import annotations

import contextlib
import json
import logging
import math
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from gsfluent.errors import InputError, RunError, need
from gsfluent.io.atomic import write_json
from gsfluent.io.images import IMAGE_SUFFIXES, image_size
from gsfluent.posing.frames import SUFFIXES, take_frames
from gsfluent.posing.mapping import FOUND
from gsfluent.progress import Progress, report_progress

_log = logging.getLogger(__name__)

LEAST = 3
"""Photographs between which poses can be found."""
_GOOD_ERROR = 1.5  # pixels of reprojection error that a still object in focus keeps to
_MOST = 0.8  # share of the photographs that a good capture places
_MENDS = (
    "take 40 to 80 sharp photographs all around, neighbours overlapping by two thirds; put plain "
    "or shining things on something printed, such as a newspaper, and leave them where they are"
)


def find_poses(
    photographs: Path,
    out: Path,
    *,
    frames: int = 120,
    seed: int = 0,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Find where photographs were taken from, and leave a capture that ``gsfluent run`` takes.

    Writes ``images/``, ``sparse/0`` (a COLMAP model; scale and up are free) and ``poses.json``.

    Args:
        photographs: Folder of photographs, or a video.
        out: Folder of the capture; it must not hold one.
        frames: How many frames are taken of a video.
        seed: Seed of COLMAP's random choices.
        progress: Called as ``progress(done, total, message)``.

    Returns:
        What stands in ``poses.json``: ``images``, ``registered``, ``missing`` (their names),
        ``models`` (groups that do not hang together), ``points``, ``reprojection_error`` [px],
        ``advice``, ``output``.

    Raises:
        InputError: pycolmap or photographs are missing, or ``out`` holds a capture already.
        RunError: No three photographs fit together, or COLMAP failed.
    """
    need("pycolmap", "poses", "finding the poses of photographs")
    if (out / "sparse").exists() or (out / "images").exists():
        raise InputError(f"{out}: holds images or poses already", "name another folder for -o")
    video = photographs.is_file()
    found = [] if video else _photographs(photographs)
    if video and photographs.suffix.lower() not in SUFFIXES:
        raise InputError(
            f"{photographs}: neither a folder nor a video", f"give one of {', '.join(SUFFIXES)}"
        )
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".poses-", dir=out) as made:
        work = Path(made)
        images = work / "images"
        images.mkdir()
        if video:
            found = take_frames(photographs, images, frames, progress)
        else:
            for path in found:
                _link(path, images / path.name)
        task = {"one_camera": _one_size(found), "in_order": video, "seed": seed}
        model = _map(work, len(found), task, progress)
        if len(model["placed"]) < LEAST:
            raise RunError(f"{photographs}: no three of {len(found)} photographs fit together",
                           hint=_MENDS)  # fmt: skip
        report = _report(model, [path.name for path in found], out)
        (work / "images").replace(out / "images")
        (work / "sparse").replace(out / "sparse")
    write_json(out / "poses.json", report)
    return report


def photographs_in(folder: Path) -> list[Path]:
    """The photographs of a folder, or of ``images/`` in it, by name."""
    place = folder / "images" if (folder / "images").is_dir() else folder
    return sorted(p for p in place.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES)


def poses_text(report: dict[str, Any]) -> str:
    """How many photographs have found their place, from what :func:`find_poses` returns."""
    return (
        f"{report['registered']} of {report['images']} photographs have poses, "
        f"{report['points']} points, reprojection error {report['reprojection_error']:.2f} px"
    )


def _photographs(folder: Path) -> list[Path]:
    found = photographs_in(folder)
    if len(found) < LEAST:
        raise InputError(f"{folder}: {len(found)} photographs", "three are the least, 40 are good")
    return found


def _link(path: Path, to: Path) -> None:
    """A second name for a photograph, or a copy where the file system has none."""
    try:
        os.link(path, to)
    except OSError:
        shutil.copyfile(path, to)


def _one_size(found: list[Path]) -> bool:
    """Whether one lens took them all, as far as their sizes say."""
    return len({image_size(path) for path in found}) == 1


def _map(work: Path, count: int, task: dict[str, Any], progress: Progress | None) -> dict[str, Any]:
    """Features, matches and models, found in a process of its own; what it says of the largest."""
    (work / "task.json").write_text(json.dumps(task), encoding="utf-8")
    command = [sys.executable, "-m", "gsfluent.posing.mapping", str(work)]
    paths = [str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")]
    said, at = work / "said", "the start"
    with said.open("wb") as errors:
        child = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=errors, text=True, errors="replace",
            env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths))},
        )  # fmt: skip
        try:
            for line in child.stdout or ():
                with contextlib.suppress(ValueError):  # a line of COLMAP's own
                    done, total, at = json.loads(line)
                    report_progress(progress, done, total, at)
            code = child.wait()
        finally:
            child.kill()
            child.wait()
    if code != 0:
        words = said.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        why = words[-1] if words and code > 0 else f"its process ended with {code}"
        raise RunError(f"COLMAP failed at {at} of {count} photographs ({why})", hint=_MENDS)
    found: dict[str, Any] = json.loads((work / FOUND).read_text(encoding="utf-8"))
    return found


def _report(found: dict[str, Any], names: list[str], out: Path) -> dict[str, Any]:
    placed, error = set(found["placed"]), found["error"]
    missing = [name for name in names if name not in placed]
    advice = []
    if len(placed) < _MOST * len(names):
        advice.append(f"{len(missing)} of {len(names)} photographs found no place: {_MENDS}")
    if found["models"] > 1:
        advice.append(
            f"the photographs fall into {found['models']} groups that nothing links; the largest "
            "was taken: photograph the way from one to the other"
        )
    if not math.isfinite(error) or error > _GOOD_ERROR:
        advice.append(
            f"points are seen {error:.1f} pixels from where they should be: was it moved, or the "
            "zoom?"
        )
    for line in advice:
        _log.warning("poses: %s", line)
    return {
        "images": len(names), "registered": len(placed), "missing": missing,
        "models": found["models"], "points": found["points"], "reprojection_error": error,
        "advice": advice, "output": str(out),
    }  # fmt: skip
