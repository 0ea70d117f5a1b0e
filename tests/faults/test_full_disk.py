"""A disk that fills up: one error, which says what, where and what to do; nothing half-written."""

from __future__ import annotations

import errno
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from fault_harm import NoDisk, disk_of, little_room
from fault_shot import redone, results, run

from gsfluent.data import Frame, Gaussians
from gsfluent.errors import RunError
from gsfluent.io import load_solid, save_image, save_solid, save_splats, write_json
from gsfluent.io.atomic import write_tensors
from gsfluent.pipeline.render.video import write_video
from gsfluent.results.digests import Journal, write_record
from gsfluent.results.frames import load_frame, save_frame
from gsfluent.results.partition import load_partition, save_partition
from gsfluent.stages import simulate

ROOM = 600  # bytes


def tensors(folder: Path, run: Path) -> None:
    write_tensors(folder / "state.pt", {"a": torch.zeros(1000), "b": torch.zeros(1000)})


def json_file(folder: Path, run: Path) -> None:
    write_json(folder / "a.json", list(range(1000)))


def record(folder: Path, run: Path) -> None:
    write_record(folder / "stage.json", {"report": list(range(1000))})


def frame(folder: Path, run: Path) -> None:
    save_frame(folder, load_frame(run / "stages" / "simulate", 0))


def partition(folder: Path, run: Path) -> None:
    found = load_partition(run / "stages" / "simulate")
    assert found is not None
    save_partition(folder, found)


def splats(folder: Path, run: Path) -> None:
    means = torch.rand(99, 3)
    save_splats(Gaussians.from_colors(means, torch.full((99,), 0.1), means), folder / "a.ply")


def solid(folder: Path, run: Path) -> None:
    save_solid(
        load_solid(run / "stages" / "fill" / "ball.ply").transformed(Frame.identity()),
        folder / "a.ply",
    )


def image(folder: Path, run: Path) -> None:
    save_image(torch.rand(64, 64, 3), folder / "a.png")


def video(folder: Path, run: Path) -> None:
    pictures = np.random.default_rng(0).integers(0, 255, (9, 64, 64, 3)).astype(np.uint8)
    write_video(folder / "a.mp4", pictures, fps=10, size=(64, 64))


WRITERS: list[Callable[[Path, Path], None]] = [
    tensors, json_file, record, frame, partition, splats, solid, image, video,
]  # fmt: skip


@pytest.mark.parametrize("write", WRITERS, ids=lambda write: write.__name__)
def test_whatever_is_written_ends_whole_or_not_at_all(
    write: Callable[[Path, Path], None], finished: Path, tmp_path: Path
) -> None:
    with little_room(ROOM), pytest.raises(RunError) as caught:
        write(tmp_path, finished)
    assert str(tmp_path) in caught.value.what and "space" in caught.value.hint
    assert caught.value.kept and list(tmp_path.iterdir()) == []
    write(tmp_path, finished)
    assert len(list(tmp_path.iterdir())) == (2 if write is solid else 1)


def test_the_list_of_a_stage_takes_a_line_or_none(tmp_path: Path) -> None:
    journal = Journal(tmp_path, tmp_path)
    journal.keep({})
    before = journal.path.read_text()
    (tmp_path / "a").write_text("x")
    with little_room(len(before) + 10), pytest.raises(OSError, match="No space left") as caught:
        journal.note(tmp_path / "a", tmp_path / "a")
    assert caught.value.errno == errno.ENOSPC and journal.path.read_text() == before


def test_a_state_that_does_not_fit_stops_the_run_and_the_next_goes_on(
    finished: Path, shot: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    shutil.copytree(finished, out)
    shutil.rmtree(out / "stages" / "simulate")
    save, calls = torch.save, []

    def filling(values: Any, stream: Any) -> None:
        calls.append(1)
        if len(calls) < 2:
            save(values, stream)
            return
        with little_room(4000):
            save(values, stream)

    monkeypatch.setattr(torch, "save", filling)
    monkeypatch.setattr(simulate, "PATIENCE", 0.0)
    with pytest.raises(RunError, match=r"state\.pt: cannot be written") as caught:
        run(shot, out)
    assert "free space" in caught.value.hint and "enforce" not in str(caught.value)
    assert "state.pt" in (out / "run.json").read_text() and not list(out.rglob("*partial*"))
    monkeypatch.setattr(torch, "save", save)
    assert redone(run(shot, out)) == []
    assert results(out) == results(finished)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[tuple[Path, Callable[[int], None]]]:
    """A file system of its own, of 300 kB, and what makes it larger; only root can make one."""
    try:
        with disk_of(tmp_path / "disk", 300_000) as grow:
            yield tmp_path / "disk", grow
    except NoDisk as error:
        pytest.skip(str(error))


def test_a_run_on_a_full_disk_goes_on_once_there_is_room(
    finished: Path, shot: Path, small_disk: tuple[Path, Callable[[int], None]]
) -> None:
    disk, grow = small_disk
    filler = disk / "filler"
    filler.write_bytes(bytes(200_000))
    out = disk / "out"
    with pytest.raises((RunError, OSError)) as caught:
        run(shot, out)
    assert "space" in str(caught.value).lower() and not list(out.rglob("*partial*"))
    filler.unlink()
    grow(2_000_000)
    assert redone(run(shot, out)) == [] and results(out) == results(finished)
