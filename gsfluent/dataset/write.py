"""A sweep as training data: samples, split by object, in the layouts that loaders read."""

from __future__ import annotations

import hashlib
import json
import logging
import shutil
import tarfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import torch

from gsfluent.dataset.sample import PARTS, Source, make_sample
from gsfluent.errors import InputError, check_choice
from gsfluent.io import atomic_path
from gsfluent.io.atomic import link_or_copy
from gsfluent.io.checked.files import read_json
from gsfluent.progress import Progress
from gsfluent.sweep.engine import Outcome, map, required
from gsfluent.sweep.folder import SweepFolder

_log = logging.getLogger(__name__)
SPLITS = ("train", "validation", "test")
FORMATS = ("webdataset", "huggingface")
_SHARD = 10**9
"""Bytes from which on a new tar is begun."""


def write_dataset(
    sweep: Path,
    out: Path,
    formats: Sequence[str] = ("webdataset",),
    *,
    device: torch.device,
    shares: Sequence[float] = (0.8, 0.1, 0.1),
    jobs: int | None = None,
    shard: int = _SHARD,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Turn the finished shots of a sweep into a data set; goes on where it was stopped.

    Args:
        sweep: Folder of the sweep.
        out: Folder of the data set; made when missing.
        formats: Some of :data:`FORMATS`, each in a folder of its name.
        device: Where depth, flow and labels are drawn.
        shares: Of the objects that go to train, validation and test; a digest decides, so that
            an object, and all shots of it, stays where it is when others come.
        jobs: Samples at a time; one per core when absent.
        shard: Bytes from which on a new tar is begun.
        progress: Called per sample.

    Returns:
        Counts by split, and the folders.

    Raises:
        InputError: Not a sweep, no shot with frames, or shares that are none.
        RunError: A sample could not be made.
    """
    for name in formats:
        check_choice("--format", name, FORMATS)
    if len(shares) != len(SPLITS) or min(shares) < 0.0 or abs(sum(shares) - 1.0) > 1e-6:
        raise InputError(f"shares: {list(shares)}", "give three of train, validation, test: sum 1")
    sources = list(_sources(sweep, str(device)))
    if not sources:
        raise InputError(
            f"{sweep}: no finished shot with its frames", "run the sweep with keep: all"
        )
    outcomes = map(
        make_sample, sources, out / "samples", ids=[source.id for source in sources], jobs=jobs,
        retry=True, progress=progress,
    )  # fmt: skip
    required(outcomes, "samples could not be made", out / "samples")
    by_split = {
        split: [o for o in outcomes if split_of(o.value["object"], shares) == split]
        for split in SPLITS
    }
    for name in formats:
        folder = out / name
        folder.mkdir(parents=True, exist_ok=True)
        if name == "webdataset":
            for split, some in by_split.items():
                _write_shards(folder, split, some, shard)
        else:
            _write_folder(folder, by_split)
    empty = [s for s, share in zip(SPLITS, shares, strict=True) if share and not by_split[s]]
    if empty:
        _log.warning(
            "no object fell to %s: with few objects choose --shares so that one does",
            " and ".join(empty),
        )
    return {
        "samples": {split: len(some) for split, some in by_split.items()},
        "objects": {s: len({o.value["object"] for o in some}) for s, some in by_split.items()},
        "bytes": sum(outcome.value["bytes"] for outcome in outcomes),
        "folders": [str(out / name) for name in formats],
    }


def split_of(thing: str, shares: Sequence[float]) -> str:
    """The split of an object, by its name alone."""
    digest = hashlib.blake2b(thing.encode(), digest_size=8).digest()
    place, end = int.from_bytes(digest, "big") / 2.0**64, 0.0
    for split, share in zip(SPLITS, shares, strict=True):
        end += share
        if place < end:
            return split
    return [split for split, share in zip(SPLITS, shares, strict=True) if share > 0.0][-1]


def _sources(sweep: Path, device: str) -> Iterator[Source]:
    """The shots that a data set can be made of, in the order of their draws.

    Raises:
        InputError: Not the folder of a sweep.
    """
    place = SweepFolder(sweep)
    if not place.shots.is_dir():
        raise InputError(f"{sweep}: not the folder of a sweep", "run gsfluent sweep first")
    rows = [row for name in place.done() if (row := place.row(name)) is not None]
    without = 0
    for row in sorted(rows, key=lambda row: int(row["value"]["index"])):
        folder = (place.shots / row["id"]).absolute()
        if not (folder / "video.mp4").is_file() or not (folder / "stages" / "simulate").is_dir():
            without += 1
            continue
        yield Source(row["id"], folder, row["value"], device)
    if without:
        _log.info("%d shots without film or frames are left out", without)


def _write_shards(folder: Path, split: str, outcomes: list[Outcome], shard: int) -> None:
    """Tars of whole samples, ``train-000000.tar`` and so on; those of an older, longer set go."""
    number = 0
    while outcomes:
        taken, size = 0, 0
        while taken < len(outcomes) and (taken == 0 or size < shard):
            size += int(outcomes[taken].value["bytes"])
            taken += 1
        with (
            atomic_path(folder / f"{split}-{number:06d}.tar") as part,
            tarfile.open(part, "w", format=tarfile.GNU_FORMAT) as tar,
        ):
            for outcome in outcomes[:taken]:
                for file in _files(outcome):
                    # the same bytes whoever writes it, and when
                    info = tarfile.TarInfo(file.name)
                    info.size = file.stat().st_size
                    with file.open("rb") as stream:
                        tar.addfile(info, stream)
        outcomes, number = outcomes[taken:], number + 1
    while (stale := folder / f"{split}-{number:06d}.tar").is_file():
        stale.unlink()
        number += 1


def _files(outcome: Outcome) -> list[Path]:
    assert outcome.folder is not None  # it is done
    return [outcome.folder / f"{outcome.id}.{part}" for part in PARTS]


def _write_folder(folder: Path, by_split: dict[str, list[Outcome]]) -> None:
    """Films by split with ``metadata.jsonl``, the rest in ``channels``, and the card of them."""
    wanted = {split: outcomes for split, outcomes in by_split.items() if outcomes}
    made = folder / ".partial"
    shutil.rmtree(made, ignore_errors=True)
    # apart from the films: what a loader is is guessed from the files beside them
    (made / _CHANNELS).mkdir(parents=True)
    for split, outcomes in wanted.items():
        (made / split).mkdir()
        with (made / split / "metadata.jsonl").open("w", encoding="utf-8") as stream:
            for outcome in outcomes:
                film, *others = _files(outcome)
                link_or_copy(film, made / split / film.name)
                for file in others:
                    link_or_copy(file, made / _CHANNELS / file.name)
                stream.write(json.dumps(_metadata(outcome)) + "\n")
    for name in (*SPLITS, _CHANNELS):
        shutil.rmtree(folder / name, ignore_errors=True)
        if (made / name).is_dir():
            (made / name).rename(folder / name)
    made.rmdir()
    paths = "".join(f"      - split: {split}\n        path: {split}/*\n" for split in wanted)
    with atomic_path(folder / "README.md") as part:
        part.write_text(_CARD.format(paths=paths), encoding="utf-8")


_CHANNELS = "channels"


def _metadata(outcome: Outcome) -> dict[str, Any]:
    """A film's line."""
    film, *others = _files(outcome)
    known = read_json(others[0])
    return {
        "file_name": film.name,
        **{file.name.split(".")[1]: f"{_CHANNELS}/{file.name}" for file in others},
        **{name: known[name] for name in ("id", "object", "seed", "verdict")},
        "changes": json.dumps(known["changes"]),
        "events": json.dumps(known["events"]),
        **known["figures"],
    }


_CARD = """\
---
configs:
  - config_name: default
    data_files:
{paths}---

Breaking objects, simulated and drawn by gsfluent. With every film `ID.mp4` go, in `channels`:

* `ID.depth.npz`: camera z [m], float16 [T, H, W]
* `ID.flow.npz`: way to the next frame [px], float16 [T, H, W, 2]
* `ID.labels.npz`: which piece, int32 [T, H, W]
* `ID.json`: cameras, events, what the labels are, figures of every frame

No object is in two splits.
"""
