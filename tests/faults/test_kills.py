"""Kills at every write, two runs at once, and what dead runs leave: nothing is lost."""

from __future__ import annotations

import json
import logging
import os
import shutil
import signal
import socket
import time
from pathlib import Path
from typing import Any

import pytest
import torch
from fault_harm import at_once, child_of, die_at, in_child
from fault_shot import results, run

from gsfluent.config import load_shot
from gsfluent.errors import InputError, RunError
from gsfluent.io.atomic import atomic_path, write_json, write_tensors
from gsfluent.process import is_alive
from gsfluent.results.digests import file_digest
from gsfluent.results.lock import LOCK, locked
from gsfluent.results.store import StageStore
from gsfluent.run.shot import run_shot

FRAMES = 4


def simulate(folder: Path) -> dict[str, Any]:
    """What the stage of a simulation does to its folder: a frame, a list, a state, and again."""
    state, done = folder / "state.pt", 0
    if state.is_file():
        done = int(torch.load(state)["done"])
    for index in range(done, FRAMES):
        write_json(folder / f"frame_{index}.json", [index, index**2])
        write_json(folder / "strikes.json", list(range(index + 1)))
        write_tensors(state, {"done": torch.tensor(index + 1), "all": torch.arange(9)})
    return {"began": done}


def stage_of(out: Path) -> Any:
    with locked(out):
        return StageStore(out / "stages").run("simulate", "key", simulate, scratch=("state.pt",))


def files(out: Path) -> dict[str, str]:
    folder = out / "stages" / "simulate"
    return {p.name: file_digest(p) for p in folder.iterdir() if p.name != "stage.json"}


def dies(out: Path, count: int, *, before: bool = True) -> int:
    """Begin the stage in a process that is killed at its n-th file; how that ended."""

    def work() -> int:
        die_at(count, before=before)
        stage_of(out)
        return 0

    return in_child(work)


@pytest.mark.parametrize("before", [True, False], ids=["before", "after"])
def test_a_kill_at_any_file_loses_nothing(before: bool, tmp_path: Path) -> None:
    wanted = tmp_path / "whole"
    stage_of(wanted)
    kills = 0
    for count in range(1, 17):
        out = tmp_path / str(count)
        end = dies(out, count, before=before)
        kills += os.WIFSIGNALED(end)
        state = out / "stages" / "simulate" / "state.pt"
        saved = int(torch.load(state)["done"]) if state.is_file() else 0
        result = stage_of(out)
        assert result.redone == "" and (result.resumed or result.report["began"] == saved)
        assert files(out) == files(wanted)
        assert not list(out.rglob("*partial*")) and not (out / LOCK).exists()
    assert kills >= 3 * FRAMES + 3


def test_a_kill_in_the_middle_of_a_killed_run_loses_nothing(tmp_path: Path) -> None:
    wanted, out = tmp_path / "whole", tmp_path / "out"
    stage_of(wanted)
    for _ in range(3):  # at the state of a frame, before it has its name: twice the same work
        assert os.WIFSIGNALED(dies(out, 8))
    assert stage_of(out).redone == "" and files(out) == files(wanted)


def test_the_second_of_two_runs_touches_nothing(
    finished: Path, shot: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    out = tmp_path / "out"
    shutil.copytree(finished, out)
    told, tell = os.pipe()

    def first() -> int:
        with locked(out):
            os.write(tell, b"!")
            time.sleep(60)
        return 0

    child = child_of(first)
    try:
        assert os.read(told, 1) == b"!"
        state = {p: p.stat().st_mtime_ns for p in out.rglob("*")}
        with pytest.raises(RunError, match=f"process {child} on {socket.gethostname()}") as caught:
            run_shot(load_shot(shot), out, plan=False, unlock=True)
        assert "nothing was touched" in caught.value.kept and "wait" in caught.value.hint
        assert {p: p.stat().st_mtime_ns for p in out.rglob("*")} == state
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
    assert (out / LOCK).is_file()
    with caplog.at_level(logging.WARNING):
        run(shot, out)
    assert f"taken over from process {child}" in caplog.text
    assert not (out / LOCK).exists() and results(out) == results(finished)


def test_of_many_that_start_at_once_one_works_at_a_time(tmp_path: Path) -> None:
    inside = tmp_path / "inside"

    def start() -> int:
        try:
            with locked(tmp_path / "out"):
                os.close(os.open(inside, os.O_CREAT | os.O_EXCL))
                time.sleep(0.005)
                inside.unlink()
        except RunError:
            return 3
        return 0

    for _ in range(5):
        ends = at_once(start, 4, tmp_path / "gate")
        assert set(ends) <= {0, 3} and 0 in ends


def test_a_lock_of_another_machine_is_taken_only_when_told(tmp_path: Path) -> None:
    words = {"process": 1, "host": "far-away", "boot": "x", "started": "yesterday", "seconds": 0}
    (tmp_path / LOCK).write_text(json.dumps(words))
    with pytest.raises(RunError, match="process 1 on far-away, started yesterday") as caught:
        with locked(tmp_path):
            pass
    assert "--unlock" in caught.value.hint
    assert json.loads((tmp_path / LOCK).read_text()) == words
    with locked(tmp_path, unlock=True):
        assert json.loads((tmp_path / LOCK).read_text())["process"] == os.getpid()


def test_a_folder_is_held_once_within_a_process_too(tmp_path: Path) -> None:
    with locked(tmp_path), pytest.raises(RunError, match="another run"), locked(tmp_path):
        pass
    assert not (tmp_path / LOCK).exists()


@pytest.mark.parametrize("words", ["", "{", "[1]", '{"process": "one"}'])
def test_a_lock_without_sense_is_that_of_a_dead_run(words: str, tmp_path: Path) -> None:
    mine = {"host": socket.gethostname(), **(json.loads(words) if "one" in words else {})}
    (tmp_path / LOCK).write_text(json.dumps(mine) if "one" in words else words)
    with locked(tmp_path):
        assert json.loads((tmp_path / LOCK).read_text())["process"] == os.getpid()


def test_what_dead_runs_left_half_written_goes_and_that_of_the_living_stays(
    tmp_path: Path,
) -> None:
    def die() -> int:
        with atomic_path(tmp_path / "stages" / "video.mp4") as part:
            part.write_text("half")
            os.kill(os.getpid(), signal.SIGKILL)
        return 0

    in_child(die)
    living = tmp_path / f".film.{os.getppid()}.partial.mp4"
    living.write_text("at work")
    mine = tmp_path / ".notes.partial.txt"
    mine.write_text("no number: not ours")
    assert len(list(tmp_path.rglob("*.partial*"))) == 3
    with locked(tmp_path):
        assert sorted(tmp_path.rglob("*.partial*")) == sorted([living, mine])


def test_a_number_that_was_given_again_is_another_process() -> None:
    assert is_alive(os.getpid(), time.time())
    assert not is_alive(os.getpid(), 1e9)
    assert not is_alive(2**30, time.time())


def test_inputs_that_are_gone_are_named(finished: Path, shot: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(finished, out)
    text = shot.read_text()
    shutil.copy(shot.parent / "ball.ply", tmp_path / "other.ply")
    (tmp_path / "shot.yaml").write_text(text.replace(str(shot.parent / "ball.ply"), "other.ply"))
    wanted = load_shot(tmp_path / "shot.yaml")
    (tmp_path / "other.ply").unlink()
    with pytest.raises((InputError, FileNotFoundError), match=r"other\.ply"):
        run_shot(wanted, out, plan=False)
    assert "failed" in (out / "run.json").read_text()
