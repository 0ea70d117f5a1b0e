"""Poses by pycolmap: features, matches, incremental mapping; what was found is said in numbers.

Schoenberger and Frahm 2016, "Structure-from-Motion Revisited".
"""

from __future__ import annotations

import contextlib
import logging
import math
import os
import shutil
import sqlite3
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from gsfluent.errors import InputError, RunError, need
from gsfluent.io.atomic import write_json
from gsfluent.io.images import IMAGE_SUFFIXES, image_size
from gsfluent.posing.frames import SUFFIXES, take_frames
from gsfluent.progress import Progress, report_progress

_log = logging.getLogger(__name__)

LEAST = 3
"""Photographs between which poses can be found."""
_MAX_SIDE = 1600  # pixels at which features are sought; more costs time and finds hardly more
_ALL_PAIRS = 200  # photographs up to which each is compared with each
_LOOK = 1.0  # seconds between two looks at how far the work is
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
        RunError: No two photographs could be related.
    """
    colmap: Any = need("pycolmap", "poses", "finding the poses of photographs")
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
        models = _map(colmap, work, len(found), one_camera=_one_size(found), seed=seed,
                      in_order=video, progress=progress)  # fmt: skip
        best = max(models.values(), key=lambda model: model.num_reg_images(), default=None)
        if best is None or best.num_reg_images() < LEAST:
            raise RunError(f"{photographs}: no three of {len(found)} photographs fit together",
                           hint=_MENDS)  # fmt: skip
        (work / "sparse" / "0").mkdir(parents=True)
        best.write_binary(work / "sparse" / "0")
        report = _report(best, models, [path.name for path in found], out)
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


def _map(
    colmap: Any,
    work: Path,
    count: int,
    *,
    one_camera: bool,
    seed: int,
    in_order: bool,
    progress: Progress | None,
) -> dict[int, Any]:
    """Features, matches, models; the models by number."""
    database, images, models = work / "database.db", work / "images", work / "models"
    models.mkdir()
    colmap.logging.minloglevel = 3  # what COLMAP prints is for its developers
    colmap.set_random_seed(seed)
    mode = colmap.CameraMode.SINGLE if one_camera else colmap.CameraMode.PER_IMAGE
    extraction = colmap.FeatureExtractionOptions()
    extraction.max_image_size = _MAX_SIDE
    cancel = colmap.CancellationToken()
    watch = _Watch(database, cancel, progress)
    watch.run(
        lambda: colmap.extract_features(
            database, images, camera_mode=mode, extraction_options=extraction,
            cancellation_token=cancel,
        ), "keypoints", count, "features",
    )  # fmt: skip
    if in_order and count > _ALL_PAIRS:
        pairs = colmap.SequentialPairingOptions()
        watch.run(
            lambda: colmap.match_sequential(
                database, pairing_options=pairs, cancellation_token=cancel
            ), "two_view_geometries", count * pairs.overlap, "pairs",
        )  # fmt: skip
    else:
        watch.run(
            lambda: colmap.match_exhaustive(database, cancellation_token=cancel),
            "two_view_geometries", count * (count - 1) // 2, "pairs",
        )  # fmt: skip
    options = colmap.IncrementalPipelineOptions()
    options.random_seed = seed
    placed = [0]

    def one_more() -> None:
        placed[0] += 1

    found: dict[int, Any] = {}

    def work_out() -> None:
        found.update(
            colmap.incremental_mapping(
                database, images, models, options,
                next_image_callback=one_more, cancellation_token=cancel,
            )
        )  # fmt: skip

    watch.run(work_out, placed, count, "poses")
    return found


class _Watch:
    """Runs COLMAP's calls beside a look at their progress each second; Ctrl-C ends them."""

    def __init__(self, database: Path, cancel: Any, progress: Progress | None) -> None:
        self._database, self._cancel, self._progress = database, cancel, progress

    def run(self, work: Callable[[], Any], counted: str | list[int], total: int, text: str) -> None:
        """Do one piece of work.

        Args:
            work: The call; it lets other threads run.
            counted: Table of the database whose rows say how far it is, or a counter.
            total: Rows at the end.
            text: What is counted.
        """
        failed: list[BaseException] = []

        def body() -> None:
            try:
                work()
            except BaseException as error:
                failed.append(error)

        thread = threading.Thread(target=body, daemon=True)
        thread.start()
        try:
            while thread.is_alive():
                thread.join(_LOOK)
                done = self._rows(counted) if isinstance(counted, str) else counted[0]
                report_progress(self._progress, min(done, total - 1), total, text)
        except KeyboardInterrupt:
            self._cancel.cancel()
            thread.join()
            raise
        if failed:
            raise RunError(f"COLMAP failed at {text} ({failed[0]})", hint=_MENDS) from failed[0]
        report_progress(self._progress, total, total, text)

    def _rows(self, table: str) -> int:
        with contextlib.suppress(sqlite3.Error):
            with contextlib.closing(
                sqlite3.connect(f"file:{self._database}?mode=ro", uri=True)
            ) as found:
                return int(found.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0])
        return 0


def _report(best: Any, models: dict[int, Any], names: list[str], out: Path) -> dict[str, Any]:
    placed = {best.image(number).name for number in best.reg_image_ids()}
    missing = [name for name in names if name not in placed]
    error = float(best.compute_mean_reprojection_error())
    advice = []
    if len(placed) < _MOST * len(names):
        advice.append(f"{len(missing)} of {len(names)} photographs found no place: {_MENDS}")
    if len(models) > 1:
        advice.append(
            f"the photographs fall into {len(models)} groups that nothing links; the largest was "
            "taken: photograph the way from one to the other"
        )
    if not math.isfinite(error) or error > _GOOD_ERROR:
        advice.append(
            f"points are seen {error:.1f} pixels from where they should be: was it moved, or the "
            "zoom?"
        )
    for line in advice:
        _log.warning("poses: %s", line)
    return {
        "images": len(names), "registered": len(placed), "missing": missing, "models": len(models),
        "points": int(best.num_points3D()), "reprojection_error": error, "advice": advice,
        "output": str(out),
    }  # fmt: skip
