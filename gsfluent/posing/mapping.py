"""COLMAP at work, in a process of its own: what a hostile photograph makes of it ends there.

``python -m gsfluent.posing.mapping WORK`` takes ``task.json`` and ``images/`` of that folder, says
how far it is in lines of JSON on stdout, and leaves ``found.json`` and the largest model in
``sparse/0``.
"""

from __future__ import annotations

import contextlib
import json
import sqlite3
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from gsfluent.process import repeated

FOUND = "found.json"
_MAX_SIDE = 1600  # pixels at which features are sought; more costs time and finds hardly more
_ALL_PAIRS = 200  # photographs up to which each is compared with each
_LOOK = 1.0  # seconds between two looks at how far the work is


def main(work: Path) -> None:
    """Features, matches and models of ``WORK/images``; the largest model is written."""
    import pycolmap

    colmap: Any = pycolmap
    task = json.loads((work / "task.json").read_text(encoding="utf-8"))
    seed, database, images = task["seed"], work / "database.db", work / "images"
    count = sum(1 for _ in images.iterdir())
    colmap.logging.minloglevel = 3  # what COLMAP prints is for its developers
    colmap.set_random_seed(seed)
    extraction = colmap.FeatureExtractionOptions()
    extraction.max_image_size = _MAX_SIDE
    mode = colmap.CameraMode.SINGLE if task["one_camera"] else colmap.CameraMode.PER_IMAGE
    with _told(lambda: _rows(database, "keypoints"), count, "features"):
        colmap.extract_features(
            database, images, camera_mode=mode, extraction_options=extraction
        )  # fmt: skip
    pairing = colmap.SequentialPairingOptions()
    near = task["in_order"] and count > _ALL_PAIRS
    pairs = count * pairing.overlap if near else count * (count - 1) // 2
    with _told(lambda: _rows(database, "two_view_geometries"), pairs, "pairs"):
        if near:
            colmap.match_sequential(database, pairing_options=pairing)
        else:
            colmap.match_exhaustive(database)
    options = colmap.IncrementalPipelineOptions()
    options.random_seed = seed
    placed: list[None] = []
    (work / "models").mkdir()
    with _told(lambda: len(placed), count, "poses"):
        models = colmap.incremental_mapping(
            database, images, work / "models", options,
            next_image_callback=lambda: placed.append(None),
        )  # fmt: skip
    best = max(models.values(), key=lambda model: model.num_reg_images(), default=None)
    found = {"models": len(models), "placed": [], "points": 0, "error": 0.0}
    if best is not None:
        (work / "sparse" / "0").mkdir(parents=True)
        best.write_binary(work / "sparse" / "0")
        found["placed"] = sorted(best.image(number).name for number in best.reg_image_ids())
        found["points"] = int(best.num_points3D())
        found["error"] = float(best.compute_mean_reprojection_error())
    (work / FOUND).write_text(json.dumps(found), encoding="utf-8")


@contextlib.contextmanager
def _told(rows: Callable[[], int], total: int, text: str) -> Any:
    """Says each second how far the work within is."""
    _say(0, total, text)
    with repeated(_LOOK, lambda: _say(min(rows(), total - 1), total, text)):
        yield
    _say(total, total, text)


def _say(done: int, total: int, text: str) -> None:
    sys.stdout.write(json.dumps([done, total, text]) + "\n")
    sys.stdout.flush()


def _rows(database: Path, table: str) -> int:
    with contextlib.suppress(sqlite3.Error):
        with contextlib.closing(sqlite3.connect(f"file:{database}?mode=ro", uri=True)) as found:
            return int(found.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0])
    return 0


if __name__ == "__main__":
    main(Path(sys.argv[1]))
